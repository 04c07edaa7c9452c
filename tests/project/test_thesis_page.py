"""docs/thesis.md: every line of output is what its commands print, and every key is one of a comparison's document."""

import re
import shlex

import pytest
from places import ROOT

from pipeline.records.findings import Optimum
from pipeline.records.models import ComparisonRow
from pipeline.records.results import Answer, ExperimentResult, Prediction, Scores
from pipeline.shell.cli import run

PAGE = (ROOT / "docs" / "thesis.md").read_text(encoding="utf-8")
PAIRS = re.findall(r"```sh\n(.*?)```\n+```text\n(.*?)```", PAGE, re.DOTALL)
RECORDS = {
    "answer": Answer,
    "answer.predicts": Prediction,
    "optimum": Optimum,
    "scores": Scores,
    "tables": ComparisonRow,
}


def words(text):
    return " ".join(text.replace("\N{MINUS SIGN}", "-").split())


@pytest.mark.parametrize(("commands", "output"), PAIRS, ids=[pair[0].splitlines()[0] for pair in PAIRS])
def test_a_command_prints_what_the_page_shows(capsys, commands, output):
    for command in commands.splitlines():
        with pytest.raises(SystemExit) as leaving:
            run(*[shlex.split(command)[1:]])
        assert not leaving.value.code
    printed = words(capsys.readouterr().out)
    for line in output.splitlines():
        assert words(line) in printed, line


def test_the_page_has_a_command_for_each_chapter():
    chapters = re.split(r"\n## ", PAGE)[1:]
    assert [chapter[:9] for chapter in chapters] == ["Chapter 3", "Chapter 4", "Chapter 5", "Chapter 6"]
    assert all("```sh" in chapter for chapter in chapters)


def test_the_keys_that_the_table_names_are_those_of_the_document():
    # behind the head
    rows = [line.split("|")[3] for line in PAGE.splitlines() if line.startswith("| ")][1:]
    assert len(rows) == 14
    for cell in rows:
        for name in re.findall(r"`([a-z_.0-9]+)`", cell):
            head, _, tail = name.rpartition(".")
            if head in RECORDS:
                assert tail in RECORDS[head].model_fields or (head, tail) == ("optimum", "overshoot"), name
            else:
                first = name.split(".")[0]
                known = {*ExperimentResult.model_fields, "tables", "scene"}
                known |= set(ComparisonRow.model_fields) | set(Prediction.model_fields)
                assert first in known, name


def test_the_sections_that_the_table_names_are_those_of_a_report(falcon_outcome):
    page = falcon_outcome.report.read_text(encoding="utf-8")
    for name in ("Does theory predict it?", "within 5 %", "limit over K", "largest stable B", "How sure?"):
        assert name in PAGE
        assert name in page.replace("&nbsp;", " ").replace("\N{NO-BREAK SPACE}", " "), name

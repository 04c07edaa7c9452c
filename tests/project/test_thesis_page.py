"""docs/thesis.md: every line of output is what its commands print, and every key is one of a comparison's document."""

import re
import shlex

import numpy as np
import pytest
from places import ROOT

from pipeline.device_data.published import find, published_deviation
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.findings import Optimum
from pipeline.records.models import ComparisonRow
from pipeline.records.results import Answer, ExperimentResult, Prediction, Scores
from pipeline.shell.cli import run
from pipeline.theory.curves import best_damping
from pipeline.theory.optimum import optimal_point, scaling_factor

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
    chapters = re.split(r"\n## ", PAGE)[1:-1]
    assert [chapter[:9] for chapter in chapters] == ["Chapter 3", "Chapter 4", "Chapter 5", "Chapter 6"]
    assert all("```sh" in chapter for chapter in chapters)


def test_the_keys_that_the_table_names_are_those_of_the_document():
    # behind the head
    rows = [line.split("|")[3] for line in PAGE.split("## Errata")[0].splitlines() if line.startswith("| ")][1:]
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


def jump(criterion, low, high):
    """Stiffness at which the best damping jumps most."""
    while high - low > 1e-6:
        alpha = np.linspace(low, high, 9)
        best = best_damping(NormalisedLoop.ideal(0.0, 0.0, 0.0), criterion, alpha).best
        i = int(np.argmax(np.abs(np.diff(best))))
        low, high = alpha[i], alpha[i + 1]
    return low


def test_errata_of_theory_are_as_computed():
    table = PAGE.split("## Errata")[1]
    assert f"α = {jump('settle_2pct', 0.300, 0.308):.5f}" in table
    assert f"α = {jump('overshoot', 0.300, 0.308):.5f}" in table
    loop = NormalisedLoop.ideal(0.0, 0.0, 0.0)
    for w in range(3):
        points = [optimal_point(loop, f"energy_step_w{w}{end}") for end in ("_discrete", "")]
        assert f"{100 * (points[0].alpha / points[1].alpha - 1):.2f} %" in table
    changes = [
        100 * abs(scaling_factor(name, 10.0) / scaling_factor(name, 8.0) - 1)
        for name in ("pole_radius", "energy_step_w0", "energy_step_w1", "energy_step_w2")
    ]
    assert f"up to {changes[0]:.3f} % (poles), {max(changes[1:]):.3f} % (energies)" in table


def test_errata_of_experiments_are_those_of_the_printed_tables():
    table = PAGE.split("## Errata")[1]
    assert f"{find('D.1', 'overshoot', 'experiment_2').stiffness:,.0f} N/m for experiment 2" in table
    off = published_deviation(find("D.2", "energy_step_w2", "experiment_1"))
    assert f"{-off:.1f} % below (D.2" in table
    theory, measured = (find("D.4", "overshoot", name) for name in ("theory_discrete", "experiment"))
    wrong = [100 * (getattr(theory, name) / getattr(measured, name) - 1) for name in ("damping", "stiffness")]
    assert wrong == [pytest.approx(129.6, abs=0.1), pytest.approx(121.5, abs=0.1)]
    assert f"−{-published_deviation(find('D.6', 'settle_2pct', 'experiment', 6)):.1f} % (32 for 35" in table

"""`pipeline identify` of logs whose drive is switched on late."""

from __future__ import annotations

import json

import pytest
from force_rigs import ForceRig, write_logs
from typer.testing import CliRunner

from pipeline.shell.cli import application
from pipeline.surface.identification_page import idle_sentences


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("late")
    logs = ForceRig(gain=1.0, lag=0.0, idle_rows=300, rows=700, position_noise=1e-5).logs(2)
    write_logs(logs, folder / "logs", with_force=False)
    options = ("--time", "t:s", "--command", "u:N", "--position", "x:m", "--report", folder / "page.html", "--json")
    result = CliRunner().invoke(application("identify"), ["identify", *map(str, (folder / "logs", *options))])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout), (folder / "page.html").read_text(encoding="utf-8")


def test_rows_that_are_left_out_are_stated_in_document_text_and_page(run):
    document, page = run
    starts = document["idle_starts"]
    assert len(starts) == 2
    assert all(
        300 <= each["rows"] < 320 and each["duration_s"] == pytest.approx(1e-3 * each["rows"]) for each in starts
    )
    (sentence,) = idle_sentences(document)
    assert sentence.startswith("The command does not act at the start of 2 logs, such as ")
    assert "These rows are left out." in sentence
    assert "These rows are left out." in page.replace("\N{NO-BREAK SPACE}", " ")
    assert document["replay"]["follows"]


def test_one_log_is_named_alone(run):
    document, _ = run
    (sentence,) = idle_sentences(document | {"idle_starts": document["idle_starts"][:1]})
    assert "run0.csv, first 3" in sentence
    assert idle_sentences(document | {"idle_starts": []}) == []

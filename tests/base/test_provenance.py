"""A stored result is stale after an edit of the folders that make it, and of no other."""

from __future__ import annotations

import shutil

import pytest
from folders import DIRECTLY, MAY_IMPORT

from pipeline import readers
from pipeline.base.provenance import CODE, PACKAGE_FOLDER, code_digest, digest, digest_all
from pipeline.comparison.plan import report_code
from pipeline.intake import ingest
from pipeline.intake.stored_sources import trial_id
from pipeline.measured import thesis
from pipeline.records import models
from pipeline.rendering import labels
from pipeline.shell import cli
from pipeline.theory import optimum

EDITS = [
    (thesis, {"stages", "report"}),
    (optimum, {"theory", "report"}),
    (labels, {"report"}),
    (cli, {"report"}),
    (readers, {"report"}),
    (ingest, {"report"}),
    (models, {"stages", "theory", "report"}),
]


@pytest.mark.parametrize(("module", "stale"), EDITS, ids=[module.__name__ for module, _ in EDITS])
def test_an_edit_makes_stale_what_its_folder_makes(module, stale, edit):
    before = {result: code_digest(result) for result in CODE} | {"report": report_code()}
    edit(module)
    now = {result: code_digest(result) for result in CODE} | {"report": report_code()}
    assert {result for result in CODE if now[result] != before[result]} == stale


@pytest.mark.parametrize("result", sorted(set(CODE) - {"report"}))
def test_a_result_counts_all_that_its_folders_may_import(result):
    assert set(CODE[result]) <= set(DIRECTLY)
    assert set().union(*(MAY_IMPORT[folder] for folder in CODE[result])) == set(CODE[result])


def test_every_file_of_a_page_counts_and_no_bytecode(tmp_path, monkeypatch):
    shutil.copytree(PACKAGE_FOLDER, tmp_path / "pipeline", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr("pipeline.base.provenance.PACKAGE_FOLDER", tmp_path / "pipeline")

    def of_report():
        code_digest.cache_clear()
        return code_digest("report")

    before = of_report()
    for name in ("report.html.j2", "report/trials.js", "vendor/uPlot.iife.min.js"):
        file = tmp_path / "pipeline" / "rendering" / "templates" / name
        content = file.read_bytes()
        file.write_bytes(content + b"\n")
        assert of_report() != before, name
        file.write_bytes(content)
    (tmp_path / "pipeline" / "base" / "errors.cpython-311.pyc").write_bytes(b"compiled")
    assert of_report() == before
    monkeypatch.undo()
    code_digest.cache_clear()


def test_hashes_are_as_long_as_many_results_and_trials_need() -> None:
    """Of 16 hexadecimal digits two are equal among a million trials with a chance of 3e-8."""
    sha = "0123456789abcdef" * 4
    assert len(digest({"a": 1})) == len(digest_all(["a", "b"])) == 16
    assert trial_id(sha, None) == sha[:16]
    assert len(trial_id(sha, "second")) == 16

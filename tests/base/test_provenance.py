"""A stored result is stale after an edit of the folders that make it, and of no other."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from folders import DIRECTLY, MAY_IMPORT

from pipeline import readers
from pipeline.base.provenance import CODE, PACKAGE_FOLDER, code_digest, digest, digest_all, schema_folder
from pipeline.comparison.compare import report_code
from pipeline.intake import ingest
from pipeline.intake.trialstore import trial_id
from pipeline.measured import thesis
from pipeline.measured.stages.stages import STAGES
from pipeline.records import models
from pipeline.rendering import labels
from pipeline.shell import cli
from pipeline.theory import optimum

EDITS = [
    (thesis, {"stages", "report"}),
    (optimum, {"theory", "report"}),
    (labels, {"report"}),
    (cli, {"report"}),
    (readers, {"ingest", "report"}),
    (ingest, {"ingest", "report"}),
    (models, {"stages", "theory", "ingest", "report"}),
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


@pytest.mark.slow
def test_an_installed_copy_computes_again_what_an_edit_can_have_changed(lwr, tmp_path):
    """The copy reuses what the checkout stored; after an edit of measured code all stages run, of theory none."""
    site, processed = tmp_path / "site", tmp_path / "processed"
    shutil.copytree(PACKAGE_FOLDER, site / PACKAGE_FOLDER.name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(schema_folder(), site / PACKAGE_FOLDER.name / "_schemas", dirs_exist_ok=True)
    for stage in STAGES:
        lwr.stages("delay-2").table(stage)
    shutil.copytree(lwr.processed, processed)

    def pipeline(*options):
        command = [sys.executable, "-m", "pipeline", "compare", "--device", "lwr", "--experiment", "delay-2", "--json"]
        command += ["--processed", str(processed), "--report", str(tmp_path / "report.html"), *options]
        command += ["--criteria", "overshoot,energy_step_w0"]
        environment = os.environ | {"PYTHONPATH": str(site)}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    def planned():
        plan = {row["stage"]: row["action"] for row in pipeline("--dry-run")}
        assert {"delay-2: mass", "delay-2: energy"} <= set(plan)
        return {stage.removeprefix("delay-2: ") for stage, action in plan.items() if action == "run"}

    def append(module):
        path = site / Path(module.__file__).relative_to(PACKAGE_FOLDER.parent)
        path.write_text(path.read_text(encoding="utf-8") + "# edited\n", encoding="utf-8")

    assert not planned() & set(STAGES)
    pipeline()
    assert planned() == set()
    append(thesis)
    assert planned() & {"mass", "energy", "overshoot"} == {"mass", "energy", "overshoot"}
    pipeline()
    assert planned() == set()
    append(optimum)
    assert "report" in planned()
    assert not planned() & set(STAGES)


def test_hashes_are_as_long_as_many_results_and_trials_need() -> None:
    """Of 16 hexadecimal digits two are equal among a million trials with a chance of 3e-8."""
    sha = "0123456789abcdef" * 4
    assert len(digest({"a": 1})) == len(digest_all(["a", "b"])) == 16
    assert trial_id(sha, None) == sha[:16]
    assert len(trial_id(sha, "second")) == 16

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from labs import compare
from typer.testing import CliRunner

from pipeline.base.disk import TEMPORARY_ENDING, write_text
from pipeline.base.errors import StoreError
from pipeline.comparison import compare as comparison
from pipeline.comparison.scene.scene import LEAVE_OUT, REUSE, RUN
from pipeline.intake.ingest import ingest
from pipeline.measured.stages import stage_tables
from pipeline.records.results import ComparisonResult
from pipeline.rendering.report.report_parts import CELLS_META, take_apart
from pipeline.shell.cli import app
from pipeline.store.storage import stage_file
from pipeline.theory import predictions

QUICK = ("energy_step_w0", "overshoot")
"""Criteria that need all stages but settling, and little time."""

pytestmark = pytest.mark.usefixtures("one_process")


def files(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(p): (p.stat().st_mtime_ns, p.stat().st_size) for p in folder.rglob("*") if p.is_file()}


def actions(outcome) -> dict[str, str]:
    return {stage: action for stage, action, _ in outcome.stages}


@pytest.fixture
def plain_page(monkeypatch):
    """A report without figures, which take a second: these tests are about what is run and when."""
    monkeypatch.setattr(comparison, "write_page", lambda data, path: write_text(path, data.result.device))
    monkeypatch.setattr(comparison, "map_figures", lambda *_: [])


@pytest.fixture
def own(lwr, lwr_outcome, tmp_path, plain_page):
    """A copy of the sweep with its stages, theory and report, to be changed at will."""
    shutil.copytree(lwr.raw.parent, tmp_path / "lab")
    return tmp_path / "lab"


def run(own, **options):
    return compare(
        "lwr", own / "processed", report=own / "own.html", criteria=options.pop("criteria", QUICK), **options
    )


def add_a_log(own):
    log = sorted((own / "raw/lwr/delay-4").glob("B008*.csv"))[0]
    text = re.sub(r"# stiffness: \S+", "# stiffness: 123", log.read_text(encoding="utf-8"))
    (own / "extra.csv").write_text(text, encoding="utf-8")
    assert ingest([own / "extra.csv"], own / "processed").ingested == 1


def refuse(*_, **__):
    raise AssertionError("was computed again")


@pytest.fixture
def nothing_is_computed(monkeypatch):
    """Call it: from then on reading a log, computing a stage or an optimum, and drawing fail."""

    def forbid():
        monkeypatch.setattr(stage_tables.ExperimentStages, "_computed", refuse)
        monkeypatch.setattr(stage_tables, "load_trials", refuse)
        monkeypatch.setattr(predictions, "optimal_point", refuse)
        monkeypatch.setattr(comparison, "write_page", refuse)
        monkeypatch.setattr(comparison, "write_text", refuse)

    return forbid


# --- the document -----------------------------------------------------------------------------------------------------


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["falcon_outcome", "lwr_outcome", "unknown_outcome"])
def test_document_holds_what_the_design_lists(name, request):
    outcome = request.getfixturevalue(name)
    page = take_apart(outcome.report.read_text(encoding="utf-8"))
    assert page.metas.get(CELLS_META) is not None
    assert len(page.cells) > 50
    text = outcome.report.with_suffix(".json").read_text(encoding="utf-8")
    assert "NaN" not in text
    assert ComparisonResult.model_validate_json(text) == outcome.result
    assert outcome.result.report == str(outcome.report)
    document = json.loads(text)
    assert {"device", "experiments", "tables"} <= set(document)
    for experiment in document["experiments"]:
        assert {"experiment", "trials", "verdicts", "estimates", "boundary", "optimum"} <= set(experiment)
        assert {"delay_samples", "mass", "damping", "boundary_area"} <= set(experiment["estimates"])
        counts = (sum(experiment[name].values()) for name in ("verdicts", "outcomes"))
        assert {*counts, experiment["model_check"]["trials"]} == {experiment["trials"]}
        for best in experiment["estimates"].values():
            for estimate in (best, *best["by_method"].values()):
                assert {"value", "low", "high", "method", "reason", "by_method"} <= set(estimate)
                assert estimate["method"]
                assert estimate["unit"]
                if None in (estimate["value"], estimate["low"], estimate["high"]):
                    assert estimate["reason"]
                else:
                    assert estimate["low"] <= estimate["value"] <= estimate["high"]
            assert best["value"] is None or None not in (best["low"], best["high"])
        for point in experiment["boundary"]:
            assert {"damping", "stable", "unstable", "censored"} <= set(point)
            assert (point["unstable"] is None) == point["censored"]
            assert point["trials"] > 0
            assert point["estimate"] is None or point["low"] <= point["estimate"] <= point["high"]
        for optimum in experiment["optimum"].values():
            assert {"stiffness", "damping", "cost"} <= set(optimum)
    for row in document["tables"]:
        assert {
            *("table", "criterion", "condition", "delay_samples", "stiffness", "damping", "cost"),
            *("published_stiffness", "published_damping", "published_cost", "deviation_percent"),
        } <= set(row)
        if row["condition"].startswith("theory"):
            assert row["deviation_percent"] is None


def test_origin_names_the_command_that_repeats_the_comparison(own):
    command = run(own, experiments=["delay-4"]).result.provenance["command"]
    assert command == (
        f"pipeline compare --device lwr --experiment delay-4 --criteria energy_step_w0,overshoot "
        f"--processed {own / 'processed'}"
    )


# --- what is run again ------------------------------------------------------------------------------------------------


def test_second_run_reuses_the_real_report(falcon, falcon_outcome, nothing_is_computed):
    before = files(falcon.raw.parent)
    nothing_is_computed()
    second = falcon.compare(report=falcon_outcome.report)
    assert actions(second)["report"] == REUSE
    assert second.result == falcon_outcome.result
    assert files(falcon.raw.parent) == before


def test_second_run_reuses_everything_and_touches_nothing(own, nothing_is_computed):
    first = run(own)
    before = files(own)
    nothing_is_computed()
    for dry_run in (False, True):
        second = run(own, dry_run=dry_run)
        assert set(actions(second).values()) <= {REUSE, LEAVE_OUT}
        assert actions(second)["report"] == REUSE
        assert second.result == (None if dry_run else first.result)
        assert files(own) == before


def test_dry_run_writes_nothing_and_tells_the_plan(lwr, tmp_path, nothing_is_computed):
    shutil.copytree(lwr.processed / "trials", tmp_path / "processed/trials")
    before = files(tmp_path)
    nothing_is_computed()
    outcome = compare("lwr", tmp_path / "processed", report=tmp_path / "new/x.html", dry_run=True)
    assert outcome.result is None
    assert files(tmp_path) == before
    assert not (tmp_path / "new").exists()
    plan = actions(outcome)
    assert plan["delay-2: energy"] == plan["delay-4: response"] == plan["theory: optima"] == plan["report"] == RUN
    assert all(reason for _, _, reason in outcome.stages)


@pytest.mark.slow
def test_one_more_log_runs_only_its_experiment(own):
    before = run(own)
    add_a_log(own)
    kept = files(own / "processed/stages/lwr/delay-2")
    after = run(own)
    plan = actions(after)
    assert {action for stage, action in plan.items() if stage.startswith("delay-2")} <= {REUSE, LEAVE_OUT}
    assert {action for stage, action in plan.items() if stage.startswith("delay-4")} <= {RUN, LEAVE_OUT}
    assert plan["theory: optima"] == REUSE
    assert plan["report"] == RUN
    assert files(own / "processed/stages/lwr/delay-2") == kept
    trials = {e.experiment: e.trials for e in after.result.experiments}
    assert trials["delay-4"] == 1 + {e.experiment: e.trials for e in before.result.experiments}["delay-4"]
    assert after.result.experiments[0] == before.result.experiments[0]


@pytest.mark.slow
def test_other_criteria_run_only_what_is_missing(lwr, tmp_path, plain_page):
    shutil.copytree(lwr.processed / "trials", tmp_path / "processed" / "trials")

    def plan(criteria):
        page = tmp_path / "x.html"
        return actions(compare("lwr", tmp_path / "processed", experiments=["delay-4"], criteria=criteria, report=page))

    first = plan(["overshoot"])
    assert {s for s, a in first.items() if a == RUN} >= {"delay-4: response", "delay-4: overshoot", "report"}
    assert {s for s, a in first.items() if a == LEAVE_OUT} >= {
        f"delay-4: {stage}" for stage in ("delay", "model", "mass", "settling", "energy")
    }
    second = plan(["overshoot", "energy_step_w0"])
    assert {s for s, a in second.items() if a == RUN and s.startswith("delay-4")} == {
        f"delay-4: {stage}" for stage in ("parts", "device", "model", "delay", "mass", "energy")
    }
    assert second["report"] == RUN
    third = plan(["overshoot"])  # all is stored, but the report shows other criteria
    run_again = {s for s, a in third.items() if a == RUN and not s.startswith(("figure: ", "table: "))}
    assert run_again == {"theory: boundaries and maps", "report"}


@pytest.mark.slow
def test_criteria_of_the_same_stage_still_change_the_report(own):
    assert run(own, criteria=["energy_step_w0"]).result.criteria == ("energy_step_w0",)
    other = run(own, criteria=["energy_step_w1"])
    assert actions(other)["report"] == RUN
    assert other.result.criteria == ("energy_step_w1",)


@pytest.mark.slow
def test_a_report_is_renewed_where_another_one_already_computed_the_stages(own):
    first = run(own)
    add_a_log(own)
    compare("lwr", own / "processed", criteria=QUICK)  # without a report
    after = run(own)
    assert {action for stage, action in actions(after).items() if stage.startswith("delay")} <= {REUSE, LEAVE_OUT}
    assert actions(after)["report"] == RUN
    assert sum(e.trials for e in after.result.experiments) == 1 + sum(e.trials for e in first.result.experiments)


@pytest.mark.slow
def test_a_lost_stage_file_is_made_again_though_the_report_stands(own):
    run(own)
    path = stage_file(own / "processed", "lwr", "delay-2", "energy")
    path.unlink()
    again = run(own)
    assert {s for s, a in actions(again).items() if a == RUN and s.startswith("delay-2")} == {"delay-2: energy"}
    assert path.is_file()


def test_left_out_estimates_say_so(own):
    result = run(own, criteria=["overshoot"]).result
    for experiment in result.experiments:
        assert experiment.estimates["boundary_area"].value > 0  # it needs nothing but verdicts
        for name in ("delay_samples", "mass", "damping"):
            assert experiment.estimates[name].value is None
            assert experiment.estimates[name].reason.startswith("left out")
        assert set(experiment.estimates) == {"boundary_area", "delay_samples", "mass", "damping"}
    assert not any("estimate" in text for text in result.warnings)


@pytest.mark.sampled
@pytest.mark.parametrize("change", ["", "[]", "{}", '{"provenance": []}', '{"provenance": {"key": "KEY"}}', "\ud800"])
def test_a_damaged_document_beside_the_report_is_written_anew(own, change):
    outcome = run(own)
    path = outcome.report.with_suffix(".json")
    sound = path.read_bytes()
    path.write_bytes(change.replace("KEY", outcome.result.provenance["key"]).encode("utf-8", "surrogatepass"))
    again = run(own)
    assert actions(again)["report"] == RUN
    assert path.read_bytes() == sound


@pytest.mark.slow
def test_a_missing_report_is_written_again_without_computing_stages(own, monkeypatch):
    outcome = run(own)
    outcome.report.unlink()
    monkeypatch.setattr(stage_tables.ExperimentStages, "_computed", refuse)
    monkeypatch.setattr(predictions, "optimal_point", refuse)
    assert actions(run(own))["report"] == RUN
    assert outcome.report.is_file()


@pytest.mark.slow
def test_a_damaged_stage_file_is_made_anew(own):
    expected = run(own).result
    path = stage_file(own / "processed", "lwr", "delay-2", "energy")
    sound = path.read_bytes()
    path.write_bytes(sound[: len(sound) // 2])  # without its end there is no key
    (own / "own.html").unlink()
    again = run(own)
    assert actions(again)["delay-2: energy"] == RUN
    assert again.result == expected
    damaged = bytearray(path.read_bytes())
    damaged[200] ^= 0xFF  # a value; the key stays readable
    path.write_bytes(bytes(damaged))
    (own / "own.html").unlink()
    assert run(own).result == expected


@pytest.mark.slow
@pytest.mark.parametrize("tree", ["trials", pytest.param("stages", marks=pytest.mark.slow)])
def test_a_damaged_experiment_keeps_no_other_from_being_compared(own, tree):
    expected = run(own, experiments=["delay-4"]).result
    for path in (own / "processed" / tree / "lwr" / "delay-2").iterdir():
        path.write_bytes(path.read_bytes()[:-8] + b"no table")
        if tree == "stages":
            path.write_bytes(b"no table")
    shutil.rmtree(own / "processed" / "stages" / "lwr" / "delay-4")
    (own / "own.html").unlink()
    again = run(own, experiments=["delay-4"])
    assert actions(again)["delay-4: response"] == RUN
    assert again.result == expected
    arguments = ["compare", "--device", "lwr", "--processed", str(own / "processed"), "--json"]
    arguments += ["--criteria", "overshoot", "--report", str(own / "named.html")]
    named = CliRunner().invoke(app, [*arguments, "--experiment", "delay-4"])
    assert named.exit_code == 0, named.output
    assert [e["experiment"] for e in json.loads(named.stdout)["experiments"]] == ["delay-4"]
    if tree == "stages":
        return
    # a device with a damaged experiment is refused
    with pytest.raises(StoreError, match=rf"{tree}/lwr/delay-2/.*`pipeline check --repair` saves them"):
        run(own)


# --- the rest ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_unknown_device_is_compared_with_theory_from_its_estimates(unknown_outcome):
    result = unknown_outcome.result
    assert not result.known_device
    (experiment,) = result.experiments
    assert experiment.theory.source == "estimated from the logs"
    assert experiment.theory.loop.mass == pytest.approx(0.58, rel=5e-3)
    assert experiment.theory.loop.damping == pytest.approx(4.0, abs=0.02)
    assert experiment.theory.loop.delay_samples == pytest.approx(4, abs=1e-6)
    assert set(experiment.optimum) == set(result.criteria)
    assert any("no device file" in text for text in result.warnings)
    assert unknown_outcome.report.is_file()


@pytest.mark.slow
def test_stage_files_name_their_origin(own):
    from pipeline.records.table_files import read_metadata

    run(own)
    found = read_metadata(stage_file(own / "processed", "lwr", "delay-2", "energy"))
    assert {"pipeline.version", "pipeline.key", "pipeline.inputs", "pipeline.stage"} <= set(found)
    assert found["pipeline.stage"] == "energy"


def test_no_temporary_files_are_left(own):
    run(own)
    # the lock stays: removing it while another process waits for it would let both in
    known = (".lock", ".last_ingest.json", ".stored.json")
    hidden = [p for p in own.rglob("*") if p.name.startswith(".") and p.name not in known]
    assert not hidden + list(own.rglob(f"*{TEMPORARY_ENDING}"))
    assert np.all([os.access(p, os.R_OK) for p in own.rglob("*.parquet")])

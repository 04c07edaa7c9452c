"""The state of a store is told as it is."""

import os

import pytest
from native_logs import FAULTS, log_text

from pipeline.base import lock
from pipeline.comparison.compare import compare
from pipeline.intake.ingest import ingest
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.shell.status import status
from pipeline.store.storage import read_trials


@pytest.fixture
def lab(tmp_path):
    logs = tmp_path / "logs"
    logs.mkdir()
    for number in range(4):
        (logs / f"{number}.csv").write_text(log_text(float(number), experiment=f"{9 + number % 2}"))
    (logs / "bad.csv").write_text(FAULTS["text cell"][0])
    (logs / "short.csv").write_text(FAULTS["header only"][0])
    ingest([logs], tmp_path / "processed", jobs=1)
    return tmp_path


def test_an_absent_store_is_empty(tmp_path):
    found = status(tmp_path / "nowhere", tmp_path)
    assert (found.trials, found.files, found.bytes, found.experiments, found.lock) == (0, 0, 0, (), None)


def test_counts_are_those_of_the_files(lab):
    processed = lab / "processed"
    found = status(processed)
    files = [path for path in processed.rglob("*") if path.is_file()]
    assert found.bytes == sum(path.stat().st_size for path in files)
    assert found.files == 2
    assert (found.devices, found.trials, found.rows) == (1, 4, 120)
    assert [(e.experiment, e.trials, e.rows, e.batches) for e in found.experiments] == [
        ("9", 2, 60, 1),
        ("10", 2, 60, 1),
    ]
    assert sum(found.quarantined.values()) == 2
    assert set(found.quarantined) <= {"not-a-number", "too-short", "invalid", "empty"}
    assert found.removed == found.changed == found.reports == ()
    assert found.lock is None


def test_sources_that_changed_or_are_gone_are_listed(lab):
    (lab / "logs" / "0.csv").unlink()
    (lab / "logs" / "1.csv").write_text(log_text(1.0, rows=31))
    os.utime(lab / "logs" / "2.csv", ns=(0, 0))
    found = status(lab / "processed")
    assert found.removed == (str(lab / "logs" / "0.csv"),)
    assert found.changed == (str(lab / "logs" / "1.csv"), str(lab / "logs" / "2.csv"))


def test_who_writes_is_named(lab):
    with lock.writing(lab / "processed", 0):
        found = status(lab / "processed")
    assert found.lock is not None
    assert found.lock.pid == os.getpid()


def test_stages_whose_logs_changed_are_stale(lab):
    processed = lab / "processed"
    stages = ExperimentStages(processed, "bench", "9", read_trials(processed, "bench", "9"))
    stages.table("response")
    assert status(processed).experiments[0].stale == ()
    (lab / "logs" / "new.csv").write_text(log_text(50.0, experiment="9"))
    ingest([lab / "logs"], processed, jobs=1)
    assert status(processed).experiments[0].stale == ("response",)
    assert status(processed).experiments[1].stale == ()


def test_reports_are_as_the_plan_says(falcon, tmp_path, one_process):
    report = tmp_path / "falcon.html"
    assert status(falcon.processed, tmp_path).reports == ()
    compare("falcon", falcon.processed, criteria=["overshoot"], report=report)
    (found,) = status(falcon.processed, tmp_path).reports
    assert (found.report, found.device) == (str(report), "falcon")
    assert any(reason.startswith("report: ") for reason in found.stale), "the plan asks for all criteria"

"""What an ingest meets outside a tidy laboratory: limits of the system, bad disks, links, damage, closed outputs."""

import errno
import os
import resource
import shutil
from pathlib import Path

import pytest
from native_logs import HEADER_LINES, log_text, short_log, with_cell
from stored import check_whole

from pipeline.base.errors import StoreError, UsageError
from pipeline.intake.ingest import ingest
from pipeline.shell.watch import Watched, run_pass, status_of
from pipeline.store.storage import list_experiments, read_steadily, read_trials


def test_more_experiments_than_files_may_be_open(logs, processed):
    """A lab may call each recording an experiment of its own; no batch keeps a file open while others are collected."""
    for number in range(40):
        (logs / f"{number}.csv").write_text(short_log(number + 1.0, experiment=f"run {number}"))
    opened = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 64
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (opened + 25, hard))
    try:
        assert ingest([logs], processed, jobs=2).ingested == 40
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert len(list_experiments(processed, "bench")) == 40
    assert check_whole(processed, {}) == {str(path) for path in logs.iterdir()}


@pytest.mark.parametrize(
    ("period", "line", "code"),
    [
        ("1e-320", None, "time-wrong"),
        ("1e300", None, "time-wrong"),
        ("0.001", "1e308,0,0", "out-of-range"),
        ("0.001", "1e99,0,0", "out-of-range"),
    ],
)
def test_a_period_that_cannot_count_the_rows_is_refused(logs, processed, period, line, code):
    """Such a number once ended the ingest of all other logs by an overflow."""
    text = log_text().replace("sampling_period_s: 0.001", f"sampling_period_s: {period}")
    assert period in text
    last = HEADER_LINES + 30
    (logs / "bad.csv").write_text(text if line is None else with_cell(text, last, line))
    (logs / "good.csv").write_text(log_text(200.0))
    report = ingest([logs], processed, jobs=1)
    assert report.ingested == 1
    assert [refusal.code for refusal in report.quarantined] == [code]


def test_the_store_is_left_out_by_whatever_name_it_is_reached(logs, processed, tmp_path):
    (logs / "a.csv").write_text(log_text())
    linked = tmp_path / "linked"
    linked.symlink_to(logs)
    for searched, store in ((logs, linked / "store"), (linked, logs / "store"), (logs, logs / "store")):
        report = ingest([searched], store, jobs=1)
        assert (report.found, report.quarantined) == (1, ())
    with pytest.raises(UsageError, match="the folder of results"):
        ingest([logs / "store" / "trials"], linked / "store")


@pytest.fixture
def store(logs, processed):
    for number in range(3):
        (logs / f"{number}.csv").write_text(short_log(number + 1.0))
    ingest([logs], processed, jobs=1)
    return processed


def test_a_look_at_files_that_move_is_repeated_and_one_at_damage_is_not(store):
    calls = []

    def look():
        calls.append(len(calls))
        (file,) = (store / "trials").rglob("*.parquet")
        if len(calls) < 3:
            file.rename(file.with_name(f"{len(calls)}.parquet"))
            raise FileNotFoundError(file)
        return "seen"

    assert (read_steadily(store, look), calls) == ("seen", [0, 1, 2])

    def damaged():
        calls.append(-1)
        raise StoreError("damaged")

    with pytest.raises(StoreError, match="damaged"):
        read_steadily(store, damaged)
    assert calls.count(-1) == 1


def test_a_pass_on_a_disk_that_takes_nothing_is_told(store, logs, monkeypatch):
    def no_folder(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(store))

    monkeypatch.setattr("pipeline.base.disk.make_folder", no_folder)
    events = []
    events += run_pass(Watched((logs,), store, store.parent / "reports"))
    assert status_of(events) == 1
    assert (events[0]["event"], events[0]["what"]) == ("failed", "ingest")
    assert "Read-only file system" in events[0]["reason"]


def test_trials_of_a_store_are_read_once_when_a_log_stands_under_two_names(store, logs):
    """As after a rename that was interrupted between the new trials and the removal of the former ones."""
    shutil.copy(logs / "0.csv", logs / "9.csv")
    other = store.parent / "other"
    ingest([logs / "9.csv"], other, jobs=1)
    (file,) = (other / "trials").rglob("*.parquet")
    # the modification of the log decides between files of one version
    shutil.copy(file, store / file.relative_to(other))
    paths = [Path(path).name for path in read_trials(store).column("source_path").to_pylist()]
    assert sorted(paths) == ["1.csv", "2.csv", "9.csv"]

"""The note of the last ingest is believed only where nothing that it rests on has changed."""

import os
import time
from pathlib import Path

import pytest
from native_logs import FAULTS, log_text, short_log

from pipeline.base import regular_files
from pipeline.intake import ingest as ingest_module
from pipeline.intake import reading, rerun, sources
from pipeline.intake.ingest import ingest
from pipeline.intake.quarantine import list_quarantine
from pipeline.intake.rerun import NOTE_FILE, Search, recall

LONG_AGO = time.time_ns() - 60 * 10**9


def settle(folder: Path) -> None:
    """Make folders look as if nothing had changed in them for a minute."""
    for here, _, _ in os.walk(folder):
        os.utime(here, ns=(LONG_AGO, LONG_AGO))


@pytest.fixture
def lab(tmp_path):
    logs = tmp_path / "logs"
    (logs / "deep" / "empty").mkdir(parents=True)
    for number in range(4):
        (logs / ("deep" if number % 2 else "") / f"{number}.csv").write_text(log_text(float(number)))
    (logs / "bad.csv").write_text(FAULTS["text cell"][0])
    settle(logs)
    ingest([logs], tmp_path / "processed", jobs=1)
    return tmp_path


def search(lab: Path, profile: str | None = None) -> Search:
    return Search((str(lab / "logs"),), str(lab / "processed"), profile)


def test_the_report_is_that_of_an_ingest_of_nothing_new(lab):
    remembered = recall(search(lab))
    assert remembered is not None
    (lab / "processed" / NOTE_FILE).unlink()
    again = ingest([lab / "logs"], lab / "processed", jobs=1)
    assert remembered == again.model_dump(mode="json")
    assert (again.found, again.ingested, again.skipped, len(again.quarantined)) == (5, 0, 4, 1)
    assert recall(search(lab)) == remembered


CHANGES = {
    "a new log": lambda lab: (lab / "logs" / "new.csv").write_text(log_text(9.0)),
    "a new log in an empty folder": lambda lab: (lab / "logs" / "deep" / "empty" / "new.csv").write_text(log_text(9.0)),
    "a new folder": lambda lab: (lab / "logs" / "deep" / "more").mkdir(),
    "a removed log": lambda lab: (lab / "logs" / "0.csv").unlink(),
    "a renamed log": lambda lab: (lab / "logs" / "0.csv").rename(lab / "logs" / "x.csv"),
    "a longer log": lambda lab: (lab / "logs" / "0.csv").write_text(log_text(0.0, rows=31)),
    "a touched log": lambda lab: os.utime(lab / "logs" / "0.csv"),
    "a repaired log": lambda lab: (lab / "logs" / "bad.csv").write_text(log_text(77.0)),
    "a batch that is gone": lambda lab: next((lab / "processed" / "trials").rglob("*.parquet")).unlink(),
    "a record that is gone": lambda lab: next((lab / "processed" / "quarantine").rglob("reason.json")).unlink(),
    "a damaged note": lambda lab: (lab / "processed" / NOTE_FILE).write_text("{"),
    "a note of another kind": lambda lab: (lab / "processed" / NOTE_FILE).write_text("[]"),
    "no note": lambda lab: (lab / "processed" / NOTE_FILE).unlink(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_changed_is_looked_at(lab, change):
    assert recall(search(lab)) is not None
    CHANGES[change](lab)
    assert recall(search(lab)) is None


def test_another_search_is_done(lab, monkeypatch):
    assert recall(search(lab, "native")) is None
    assert recall(Search((str(lab),), str(lab / "processed"), None)) is None
    monkeypatch.setattr(rerun, "__version__", "other")
    assert recall(search(lab)) is None


def test_a_profile_file_is_part_of_the_search(lab):
    profile = lab / "own.toml"
    profile.write_text('name = "own"\nformat = "native"\nfiles = ["*.csv"]\n')
    ingest([lab / "logs"], lab / "processed", jobs=1, profile=profile)
    assert recall(search(lab, str(profile))) is not None
    profile.write_text('name = "own"\nformat = "native"\nfiles = ["*.csv", "*.log"]\n')
    assert recall(search(lab, str(profile))) is None


def test_a_folder_that_changed_a_moment_ago_is_known_all_the_same(lab):
    (lab / "logs" / "new.csv").write_text(log_text(9.0))
    assert ingest([lab / "logs"], lab / "processed", jobs=1).ingested == 1
    assert recall(search(lab)) is not None


def test_what_could_not_be_read_is_tried_again(lab):
    (lab / "logs" / "gone.csv").symlink_to(lab / "nowhere")
    ingest([lab / "logs"], lab / "processed", jobs=1)
    assert len(list_quarantine(lab / "processed")) == 2
    assert recall(search(lab)) is None


@pytest.fixture
def opened(monkeypatch):
    """Names of the logs that are opened."""
    names = []
    original = reading.open_regular

    def noted(path, within=None):
        names.append(Path(path).name)
        return original(path, within)

    monkeypatch.setattr(reading, "open_regular", noted)
    return names


def test_of_one_more_log_only_that_is_looked_at(lab, opened, monkeypatch):
    made = []
    source = sources._source
    monkeypatch.setattr(sources, "_source", lambda file, *more: made.append(file.name) or source(file, *more))
    (lab / "logs" / "deep" / "new.csv").write_text(log_text(9.0))
    report = ingest([lab / "logs"], lab / "processed", jobs=1)
    assert (report.found, report.ingested, report.skipped, len(report.quarantined)) == (6, 1, 4, 1)
    assert opened == ["new.csv"]
    # what was refused has a record, which is told
    assert sorted(made) == ["bad.csv", "new.csv"]


UNNOTICED = {
    "size": lambda log: log.write_text(log_text(0.0, rows=31)),
    "time": lambda log: (log.write_text(log.read_text().replace("0,", "1,", 1)), os.utime(log, ns=(1, 2))),
    "time that goes back": lambda log: os.utime(log, ns=(1, 1)),
}


@pytest.mark.parametrize("change", UNNOTICED)
def test_a_changed_log_is_opened_among_others(lab, opened, change):
    UNNOTICED[change](lab / "logs" / "0.csv")
    (lab / "logs" / "new.csv").write_text(log_text(9.0))
    ingest([lab / "logs"], lab / "processed", jobs=1)
    assert {"0.csv", "new.csv"} <= set(opened)


def test_content_is_looked_at_when_asked(lab, opened):
    ingest([lab / "logs"], lab / "processed", jobs=1, rehash=True)
    assert sorted(opened) == ["0.csv", "1.csv", "2.csv", "3.csv", "bad.csv"]


def test_a_copy_is_ingested_when_its_original_changes(lab):
    (lab / "logs" / "copy.csv").write_bytes((lab / "logs" / "0.csv").read_bytes())
    assert ingest([lab / "logs"], lab / "processed", jobs=1).ingested == 0
    (lab / "logs" / "0.csv").write_text(log_text(50.0))
    assert ingest([lab / "logs"], lab / "processed", jobs=1).ingested == 2


def test_an_index_of_another_store_is_not_believed(lab, opened):
    next((lab / "processed" / "trials").rglob("*.parquet")).unlink()
    ingest([lab / "logs"], lab / "processed", jobs=1)
    assert sorted(opened) == ["0.csv", "1.csv", "2.csv", "3.csv"]


def test_a_store_that_another_changes_before_the_lock_is_looked_at_again(lab, monkeypatch):
    """Between the search and the lock another command may remove what the index calls stored."""
    held = ingest_module.writing

    def late(*arguments):
        for file in (lab / "processed" / "trials").rglob("*.parquet"):
            file.unlink()
        return held(*arguments)

    monkeypatch.setattr(ingest_module, "writing", late)
    assert ingest([lab / "logs"], lab / "processed", jobs=1).ingested == 4


@pytest.mark.parametrize("text", ["{", "{}\n", "\n\n", "[]\n[]\n", "HEAD\n", "HEAD\n[]\n", "HEAD\n{\n"])
def test_a_damaged_note_costs_time_alone(lab, text):
    note = lab / "processed" / NOTE_FILE
    note.write_text(text.replace("HEAD", note.read_text().split("\n")[0]))
    report = ingest([lab / "logs"], lab / "processed", jobs=1)
    assert (report.found, report.skipped, len(report.quarantined)) == (5, 4, 1)
    assert recall(search(lab)) is not None


def test_logs_given_by_name_know_what_lies_beside(lab):
    log = lab / "logs" / "0.csv"
    ingest([log], lab / "processed", jobs=1)
    given = Search((str(log),), str(lab / "processed"), None)
    assert recall(given) is not None
    (lab / "logs" / "beside.csv").write_text("x")
    assert recall(given) is None


def test_a_dry_run_leaves_the_note(lab):
    before = (lab / "processed" / NOTE_FILE).read_bytes()
    (lab / "logs" / "new.csv").write_text(log_text(9.0))
    ingest([lab / "logs"], lab / "processed", jobs=1, dry_run=True)
    assert (lab / "processed" / NOTE_FILE).read_bytes() == before


def test_removed_and_waiting_sources_are_told(lab):
    (lab / "logs" / "0.csv").unlink()
    settle(lab / "logs")
    report = ingest([lab / "logs"], lab / "processed", jobs=1)
    assert report.removed == (str(lab / "logs" / "0.csv"),)
    remembered = recall(search(lab))
    assert remembered is not None
    assert remembered["removed"] == [str(lab / "logs" / "0.csv")]
    assert ingest([lab / "logs" / "deep"], lab / "processed", jobs=1).removed == ()

    fresh = lab / "logs" / "fresh.csv"
    fresh.write_text(short_log(5.0))
    report = ingest([lab / "logs"], lab / "processed", jobs=1, settle_s=30)
    assert str(fresh) in report.waiting
    assert report.found == report.ingested + report.skipped + len(report.quarantined) == 4 + 1 - len(report.waiting)
    assert recall(search(lab)) is None
    plan = ingest([lab / "logs"], lab / "processed", jobs=1, settle_s=30, dry_run=True).plan
    assert plan is not None
    assert ("wait", "modified less than 30 s ago") in {(source.action, source.reason) for source in plan}
    for path in (lab / "logs").rglob("*.csv"):
        os.utime(path, ns=(LONG_AGO, LONG_AGO))
    assert ingest([lab / "logs"], lab / "processed", jobs=1, settle_s=30).ingested == 1


def test_reasons_of_a_plan(lab):
    profile = lab / "own.toml"
    profile.write_text('name = "own"\nformat = "native"\nfiles = ["*.csv"]\n')
    plan = ingest([lab / "logs"], lab / "processed", jobs=1, profile=profile, dry_run=True).plan
    assert plan is not None
    assert [source.reason for source in plan if source.action == "ingest"] == ["profile changed"] * 4
    os.utime(lab / "logs" / "0.csv")
    plan = ingest([lab / "logs" / "0.csv"], lab / "processed", jobs=1, dry_run=True).plan
    assert plan is not None
    assert [(source.action, source.reason) for source in plan] == [("skip", "unchanged content")]


def test_a_changed_log_that_is_refused_keeps_its_trials(lab):
    (lab / "logs" / "0.csv").write_text("no log")
    for _ in range(2):
        (changed,) = ingest([lab / "logs"], lab / "processed", jobs=1).changed
        assert changed.path == str(lab / "logs" / "0.csv")
        assert changed.outcome == "its new content is refused; the trials of the former one stay stored"
    remembered = recall(search(lab))
    assert remembered is not None
    assert remembered["changed"]


def test_a_change_is_told_once_and_one_that_is_refused_always(lab):
    (lab / "logs" / "0.csv").write_text(log_text(50.0))
    (lab / "logs" / "2.csv").write_text(FAULTS["second value missing"][0])
    settle(lab / "logs")
    told = [ingest([lab / "logs"], lab / "processed", jobs=1).changed]
    remembered = recall(search(lab))
    assert remembered is not None
    (lab / "processed" / NOTE_FILE).unlink()
    again = ingest([lab / "logs"], lab / "processed", jobs=1)
    told.append(again.changed)
    assert [[Path(source.path).name for source in changed] for changed in told] == [["0.csv", "2.csv"], ["2.csv"]]
    assert remembered == again.model_dump(mode="json")


def test_what_may_not_be_looked_at_is_not_gone_and_a_folder_is_no_log(lab, monkeypatch):
    (lab / "logs" / "0.csv").unlink()
    (lab / "logs" / "0.csv").mkdir()
    assert ingest([lab / "logs"], lab / "processed", jobs=1).removed == (str(lab / "logs" / "0.csv"),)
    original = os.lstat

    def closed(path, *arguments, **more):
        if "deep" in os.fspath(path):
            raise PermissionError(13, os.strerror(13), str(path))
        return original(path, *arguments, **more)

    (lab / "logs" / "deep").rename(lab / "elsewhere")
    with monkeypatch.context() as patch:
        patch.setattr(os, "lstat", closed)
        assert [regular_files.is_gone(lab / "logs" / name) for name in ("deep/1.csv", "2.csv", "x")] == [
            False,
            False,
            True,
        ]
        report = ingest([lab / "logs"], lab / "processed", jobs=1)
    assert report.removed == (str(lab / "logs" / "0.csv"),)

"""Logs that are copied, renamed, swapped, touched and changed: each content is stored once, as its log says."""

import hashlib
import random
import shutil
from collections import Counter
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from failing_disk import FailingOs
from native_logs import short_log

from pipeline.base import disk
from pipeline.base.errors import LogError
from pipeline.intake.ingest import ingest
from pipeline.store.storage import read_trials

PROFILE = """
name = "named"
format = "delimited"
files = ["K*_*.csv"]
delimiter = ","
decimal = "."
name_pattern = "^K(?P<stiffness>[0-9.]+)_"
step_at = "command edge"
columns.time = {name = "t", unit = "s"}
columns.command = {name = "f", unit = "N", sign = 1}
columns.position = {name = "x", unit = "m", sign = 1}
constants = {device = "bench", experiment = "1", damping = 2, step = 8, sampling_period_s = 0.001}
"""


def body(number: int) -> str:
    return "t,f,x\n" + "".join(f"{0.001 * k},{8 - k},{number + k}\n" for k in range(5))


class Lab:
    """A folder of logs, native ones or such whose stiffness stands in the name, and a store."""

    def __init__(self, folder: Path, named: bool) -> None:
        self.logs, self.processed = folder / "logs", folder / "processed"
        self.logs.mkdir()
        self.profile = None
        if named:
            self.profile = folder / "named.toml"
            self.profile.write_text(PROFILE)

    def ingest(self, **more):
        report = ingest([self.logs], self.processed, self.profile, jobs=1, **more)
        assert report.found == report.ingested + report.skipped + len(report.quarantined)
        return report

    def rows(self) -> list[tuple[str, float]]:
        """Name of the source and stiffness of every row of every trials file, whatever readers make of it."""
        tables = [pq.read_table(file) for file in sorted(self.processed.glob("trials/**/*.parquet"))]
        pairs = [zip(*(t.column(c).to_pylist() for c in ("source_path", "stiffness")), strict=True) for t in tables]
        return sorted((Path(path).name, stiffness) for rows in pairs for path, stiffness in rows)


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch):
    """No call fails, but none waits for the real disk either."""
    monkeypatch.setattr(disk, "os", FailingOs())


@pytest.fixture
def native(tmp_path):
    return Lab(tmp_path, named=False)


@pytest.fixture
def named(tmp_path):
    return Lab(tmp_path, named=True)


@pytest.mark.parametrize("rehash", [False, True])
def test_a_log_that_becomes_a_copy_of_a_stored_one_is_not_stored_twice(native, rehash):
    for name, stiffness in (("a", 100), ("b", 200), ("c", 300)):
        (native.logs / f"{name}.csv").write_text(short_log(stiffness))
    native.ingest()
    text = (native.logs / "c.csv").read_text()
    (native.logs / "a.csv").write_text(text)
    # the original is looked at again, too: a copy tool touched it, or all are hashed
    (native.logs / "c.csv").write_text(text)
    report = native.ingest(rehash=rehash)
    assert [k for _, k in native.rows()] == [300, 200]
    assert {Path(source.path).name for source in report.changed} == {"a.csv", "c.csv"}
    assert native.ingest(rehash=True).changed == ()
    assert [k for _, k in native.rows()] == [300, 200]


def test_a_corrected_name_gives_its_conditions(named):
    log = named.logs / "K100_a.csv"
    log.write_text(body(1))
    named.ingest()
    (before,) = read_trials(named.processed).column("trial_id").to_pylist()
    corrected = log.rename(named.logs / "K900_a.csv")
    (plan,) = named.ingest(dry_run=True).plan
    assert (plan.action, plan.reason) == ("ingest", f"its name was {log}")
    report = named.ingest()
    assert named.rows() == [("K900_a.csv", 900.0)]
    assert [(source.path, source.outcome) for source in report.changed] == [
        (str(log), f"was renamed to {corrected}; its trials were read again")
    ]
    assert report.removed == ()
    # results that rest on the trial are told apart by its id
    (after,) = read_trials(named.processed).column("trial_id").to_pylist()
    assert after != before
    assert (named.ingest().skipped, named.rows()) == (1, [("K900_a.csv", 900.0)])


def test_a_rename_that_is_interrupted_is_finished(named, monkeypatch):
    def end_when_removing(*_):
        raise KeyboardInterrupt

    log = named.logs / "K100_a.csv"
    log.write_text(body(1))
    named.ingest()
    log.rename(named.logs / "K900_a.csv")
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.store.batch_files.remove_all", end_when_removing)
        with pytest.raises(KeyboardInterrupt):
            named.ingest()
    assert len(named.rows()) == 2, "both files stand there for a moment"
    assert read_trials(named.processed).column("stiffness").to_pylist() == [900.0]
    named.ingest()
    assert named.rows() == [("K900_a.csv", 900.0)]


def test_a_renamed_log_that_is_refused_keeps_its_former_trials(named, monkeypatch):
    log = named.logs / "K100_a.csv"
    log.write_text(body(1))
    named.ingest()
    log.rename(named.logs / "K900_a.csv")

    def refuse(*_):
        raise LogError("its device is another one", code="condition-wrong")

    with monkeypatch.context() as patch:
        patch.setattr("pipeline.intake.stored_sources.motion_of", refuse)
        report = named.ingest()
    assert (len(report.quarantined), report.removed, report.changed) == (1, (str(log),), ())
    assert named.rows() == [("K100_a.csv", 100.0)]
    named.ingest(rehash=True)
    assert named.rows() == [("K900_a.csv", 900.0)]


def test_a_copy_under_another_name_is_another_trial_where_the_name_tells_other_conditions(named):
    (named.logs / "K100_a.csv").write_text(body(1))
    named.ingest()
    shutil.copy(named.logs / "K100_a.csv", named.logs / "K900_a.csv")
    shutil.copy(named.logs / "K100_a.csv", named.logs / "K100_b.csv")
    report = named.ingest()
    assert (report.ingested, report.skipped) == (1, 2)
    assert named.rows() == [("K100_a.csv", 100.0), ("K900_a.csv", 900.0)]
    (warning,) = [one for one in report.warnings if one.code is None]
    assert (Path(warning.path).name, "K100_a.csv" in warning.warning) == ("K100_b.csv", True)


def work(lab: Lab, rng: random.Random, new: int, named: bool) -> None:
    """Do something to the folder that people and their tools do."""
    logs = sorted(lab.logs.iterdir())
    fresh = lab.logs / f"K{100 + new}_{rng.randrange(4)}.csv"
    kind = rng.choice(["write", "copy", "overwrite", "rename", "swap", "touch", "remove", "change"])
    if kind == "write" or len(logs) < 3:
        fresh.write_text(body(new) if named else short_log(100 + new))
        return
    one, other = rng.sample(logs, 2)
    if kind == "copy":
        shutil.copy(one, fresh)
    elif kind == "overwrite":
        shutil.copy(one, other)
    elif kind == "rename":
        one.rename(fresh)
    elif kind == "swap":
        one.rename(lab.logs / "swap")
        other.rename(one)
        (lab.logs / "swap").rename(other)
    elif kind == "touch":
        one.write_bytes(one.read_bytes())
    elif kind == "remove":
        one.unlink()
    else:
        one.write_text(body(1000 + new) if named else short_log(1000 + new))


@pytest.mark.parametrize("is_named", [False, True])
@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_whatever_is_done_to_the_folder_each_log_is_stored_once(tmp_path, seed, is_named):
    lab = Lab(tmp_path, named=is_named)
    rng = random.Random(seed)
    for new in range(15):
        for part in range(rng.randrange(1, 4)):
            work(lab, rng, 3 * new + part, is_named)
        lab.ingest(rehash=rng.random() < 0.3)
        kept = columns(lab, "source_sha256", "stiffness", "source_path")
        # a name that tells no condition makes no other trial of the same bytes
        stored = Counter((sha256, k if is_named else None) for sha256, k, _ in kept)
        assert set(stored.values()) <= {1}
        assert len(lab.rows()) == len(kept)
        present = {(hash_of(f), float(f.name[1:].split("_")[0]) if is_named else None) for f in lab.logs.iterdir()}
        assert present <= set(stored), "what lies in the folder is stored"
        for sha256, k, path in kept:
            if (sha256, k if is_named else None) not in present:
                assert not Path(path).exists(), "only of a removed log the trials stay"


def hash_of(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def columns(lab: Lab, *names: str) -> list[tuple]:
    table = read_trials(lab.processed, columns=list(names))
    return list(zip(*(table.column(name).to_pylist() for name in names), strict=True))

"""Stored rows of stages are reused as long as their trial, its experiment and the code are the same."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from failing_disk import FailingOs
from labs import compare, make_lab
from logged import RIGS, record
from places import ROOT

from pipeline.base import disk
from pipeline.base.disk import write_text
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.measured.cost import costs
from pipeline.measured.identification.noise import Noise
from pipeline.measured.identification.parts import ChosenParts, choose_parts, subset
from pipeline.measured.identification.recordings import LogUnits
from pipeline.measured.stages import stage_device, stage_tables
from pipeline.measured.stages import stage_rows as rows_of
from pipeline.measured.stages.stage_tables import stage_row
from pipeline.measured.stages.stages import STAGES
from pipeline.shell import console
from pipeline.shell.cli import run as run_cli
from pipeline.store.storage import read_trials


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Some 25 noisy trials, a third of them cut to lengths of their own."""
    lab = make_lab(tmp_path_factory.mktemp("groups"), load_device("falcon"), ("1",), seed=23, coarsen=12)
    for number, log in enumerate(sorted(lab.raw.rglob("*.csv"))):
        if number % 3 == 0:
            lines = log.read_text(encoding="utf-8").splitlines(keepends=True)
            log.write_text("".join(lines[: 130 + 9 * number]), encoding="utf-8")
    shutil.rmtree(lab.processed)
    ingest([lab.raw], lab.processed, jobs=1)
    return lab


def test_stored_parts_are_all_that_was_chosen():
    noise, units = Noise(0.1, 0.2, 0.3), LogUnits(1e-3, 2.0, 3.0, 0.5)
    chosen = ChosenParts(
        {"gain": 1.5, "delta": 0.2}, noise, 0.4, units, 7, {"friction": 9.0}, ("constant_force",), {"stiffness": 8.0},
        (1.0, -0.9), ("gain by size",),
    )  # fmt: skip
    assert all(value for name, value in vars(chosen).items() if name != "tried")
    row = stage_device.parts_row(chosen)
    assert vars(stage_device.chosen_by_row(vars(row))) == vars(chosen)


def tables(lab, processed):
    return {stage: lab.stages("1", processed).table(stage) for stage in STAGES}


def copy_store(lab, folder: Path) -> Path:
    for part in ("trials",):
        shutil.copytree(lab.processed / part, folder / part)
    return folder


CHANGES = {
    "one log more": lambda raw, logs: shutil.copy(logs[-1], raw / "more.csv"),
    "a log less": lambda raw, logs: None,
    "a log replaced": lambda raw, logs: (raw / logs[3].name).write_text(
        "".join(logs[3].read_text(encoding="utf-8").splitlines(keepends=True)[:110]), encoding="utf-8"
    ),
}


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("change", CHANGES)
def test_after_a_change_all_is_as_from_scratch_and_little_is_computed(lab, tmp_path, monkeypatch, change):
    logs = sorted(lab.raw.rglob("*.csv"))
    raw, processed = tmp_path / "raw", tmp_path / "processed"
    raw.mkdir()
    for log in logs[:-1]:
        shutil.copy(log, raw / log.name)
    ingest([raw], processed, jobs=1)
    tables(lab, processed)
    CHANGES[change](raw, logs)
    ingest([raw], processed, jobs=1)
    trials = read_trials(processed)
    if change == "a log less":
        trials = trials.slice(1)

    computed = []

    def counting(of, measure, **more):
        computed.append(measure)
        return stage_row(of, measure, **more)

    monkeypatch.setattr(stage_tables, "stage_row", counting)
    of = stage_tables.ExperimentStages(processed, "falcon", "1", trials)
    assert not of.is_stored("model")
    now = {stage: of.table(stage) for stage in STAGES}
    for stage in ("response", "delay"):
        assert computed.count(STAGES[stage].measure) == (change != "a log less"), stage
    fresh = tmp_path / "fresh"
    shutil.copytree(processed, fresh, ignore=shutil.ignore_patterns("stages"))
    order = pa.array(range(trials.num_rows - 1, -1, -1))
    again = stage_tables.ExperimentStages(fresh, "falcon", "1", trials.take(order))
    for stage in STAGES:
        assert now[stage].equals(again.table(stage), check_metadata=True), stage


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("changed", ["code", "given", "samples"])
def test_no_row_outlives_what_it_rests_on(lab, tmp_path, monkeypatch, edit, changed):
    processed = copy_store(lab, tmp_path)
    before = lab.stages("1", processed)
    before.table("settling")
    of = lab.stages("1", processed)
    monkeypatch.setattr(of, "is_stored", lambda stage: stage != "settling")
    if changed == "code":
        edit(costs)
    elif changed == "given":
        monkeypatch.setattr(rows_of, "delay_factor", lambda _: (5, 5, 6))
    else:
        moved = of.samples.position + 1e-9 * (of.samples.position > 0)
        of.__dict__["samples"] = replace(of.samples, position=moved)
    computed = []

    def counting(of, **more):
        computed.append(of.logged.trial_id)
        return stage_row(of, **more)

    monkeypatch.setattr(stage_tables, "stage_row", counting)
    of.table("settling")
    assert sorted(computed) == sorted(of.trials.column("trial_id").to_pylist())


@pytest.mark.slow
def test_one_long_log_costs_as_much_as_itself(lab, tmp_path, monkeypatch):
    rows = 1 << 15
    raw = tmp_path / "raw"
    raw.mkdir()
    settled = [row["trial_id"] for row in lab.stages("1").table("outcome").to_pylist() if row["outcome"] == "settled"]
    sources = {row["trial_id"]: Path(row["source_path"]) for row in read_trials(lab.processed).to_pylist()}
    for trial in settled[:6]:
        shutil.copy(sources[trial], raw)
    ingest([raw], tmp_path / "copy", jobs=1)
    trial = settled[0]
    lines = sources[trial].read_text(encoding="utf-8").splitlines()
    last = lines[-1].split(",")
    more = (f"{float(last[0]) + (k + 1) * 1e-3:.6f},{last[1]},{last[2]}" for k in range(rows))
    (raw / "long.csv").write_text("\n".join([*lines, *more]) + "\n", encoding="utf-8")
    ingest([raw], tmp_path / "processed", jobs=1)
    peaks = []
    for processed in (tmp_path / "copy", tmp_path / "processed"):
        tracemalloc.start()
        tables(lab, processed)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    own = 3 * 8 * rows
    assert peaks[1] <= 1.2 * peaks[0] + 12 * own
    long, short = (lab.stages("1", tmp_path / name).table("settling").to_pylist() for name in ("processed", "copy"))
    by_trial = {row["trial_id"]: row for row in long}
    assert all(by_trial[row["trial_id"]] == row for row in short), "what is said of the others stays the same"
    (added,) = (row for row in long if row["trial_id"] not in {row["trial_id"] for row in short})
    (like,) = (row for row in short if row["trial_id"] == trial)
    assert added["settle_2pct"] == pytest.approx(like["settle_2pct"], rel=0.02)


class ReadOnly(FailingOs):
    """Takes no new file below a folder, as a read-only mount."""

    folder = Path("/nowhere")

    def open(self, path, flags, mode=0o777):
        if flags & os.O_CREAT and self.folder in Path(path).parents:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return os.open(path, flags, mode)

    def mkdir(self, path, mode=0o777):
        if self.folder in (Path(path), *Path(path).parents):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        os.mkdir(path, mode)

    write, fsync, close = staticmethod(os.write), staticmethod(os.fsync), staticmethod(os.close)
    replace, unlink = staticmethod(os.replace), staticmethod(os.unlink)


def test_an_archive_is_compared_without_writing_into_it(lab, tmp_path, monkeypatch, one_process):
    archive = copy_store(lab, tmp_path / "archive")
    report = tmp_path / "report.html"
    with monkeypatch.context() as patch:
        patch.setattr(disk, "os", only := ReadOnly())
        only.folder = archive
        found = compare("falcon", archive, criteria=("overshoot",), report=report).result
    assert report.is_file()
    assert sorted(path.name for path in archive.iterdir()) == ["trials"]
    assert compare("falcon", archive, criteria=("overshoot",)).result.numbers() == found.numbers()
    assert (archive / "stages").is_dir()


def no_space(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_named_by_the_file(lab, tmp_path, monkeypatch, capsys, one_process):
    archive = copy_store(lab, tmp_path / "archive")
    monkeypatch.setattr(disk, "os", full := FailingOs())
    monkeypatch.setattr(full, "write", no_space)
    monkeypatch.setattr(console, "_drop_output", lambda: None)
    with pytest.raises(OSError, match="No space") as caught:
        write_text(tmp_path / "a.json", "{}")
    assert "a.json" in caught.value.filename
    with pytest.raises(SystemExit) as ended:
        run_cli(["compare", "--device", "falcon", "--criteria", "overshoot", "--processed", str(archive)])
    assert ended.value.code == 1
    assert f"Error: {archive}" in (said := capsys.readouterr().err)
    assert "standard output" not in said


COMPARE = """
import os, sys
os.cpu_count = lambda: int(sys.argv[2])
from pathlib import Path
from pipeline.comparison import stage_pool
from labs import compare
stage_pool.LARGE = 20
if __name__ == "__main__":
    compare("falcon", Path(sys.argv[1]), criteria=("overshoot", "energy_step_w0"), report=Path("report.html"))
"""


@pytest.mark.slow
def test_documents_do_not_depend_on_hash_seed_or_workers(lab, tmp_path):
    documents = set()
    (tmp_path / "compare.py").write_text(COMPARE, encoding="utf-8")
    for seed, workers in ((0, 1), (1, 2), (2, 1)):
        folder = tmp_path / f"{seed}"
        copy_store(lab, folder / "processed")
        environment = os.environ | {
            "PYTHONHASHSEED": str(seed),
            "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests' / 'support'}",
        }
        command = [sys.executable, str(tmp_path / "compare.py"), "processed", str(workers)]
        subprocess.run(command, cwd=folder, env=environment, check=True)
        documents.add(tuple((folder / f"report.{kind}").read_bytes() for kind in ("json", "html")))
    assert len(documents) == 1


TRIALS = 4


def test_digests_tell_equal_trials_from_others():
    trials = record(RIGS["falcon"], TRIALS, rows=60)
    assert trials.digests == record(RIGS["falcon"], TRIALS, rows=60).digests
    moved = replace(trials, position=np.nextafter(trials.position, 1.0))
    others = [replace(trials, damping=trials.damping + 1e-9), moved]
    known = {each for one in (trials, *others) for each in one.digests}
    assert len(known) == 3 * TRIALS
    # 64 bits: of a million trials two are alike once in 4e7
    assert {len(each) for each in known} == {16}


def test_parts_are_chosen_once_for_more_logs_than_choose_them(noisy, tmp_path, monkeypatch):
    """One log more, of those that choose no parts, ends at the same device as all logs at once."""
    processed = copy_store(noisy, tmp_path)
    whole = read_trials(processed)
    of = stage_tables.ExperimentStages(processed, "falcon", "1", whole)
    chosen = {each.name for each in subset(of.once(stage_device.recordings_of))}
    ids = whole.column("trial_id").to_pylist()
    other = next(place for place, name in enumerate(ids) if name not in chosen)
    fewer = whole.take([place for place in range(len(ids)) if place != other])
    choices = []

    def counted(recordings):
        choices.append(len(recordings))
        return choose_parts(recordings)

    monkeypatch.setattr(stage_device, "choose_parts", counted)
    stage_tables.ExperimentStages(processed, "falcon", "1", fewer).table("device")
    later = stage_tables.ExperimentStages(processed, "falcon", "1", whole)
    assert not later.is_stored("parts")
    assert later.table("device").to_pylist()[0]["fitted_trials"] != []
    assert len(choices) == 1
    fresh = tmp_path / "fresh"
    shutil.copytree(processed, fresh, ignore=shutil.ignore_patterns("stages"))
    at_once = stage_tables.ExperimentStages(fresh, "falcon", "1", whole)
    for stage in ("parts", "device", "model"):
        assert later.table(stage).equals(at_once.table(stage), check_metadata=True), stage
    assert len(choices) == 2
    # one of those that choose them less: another one takes its place
    first = next(place for place, name in enumerate(ids) if name in chosen)
    without = whole.take([place for place in range(len(ids)) if place != first])
    stage_tables.ExperimentStages(processed, "falcon", "1", without).table("parts")
    assert len(choices) == 3

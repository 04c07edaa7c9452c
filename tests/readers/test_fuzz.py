"""Damaged logs by the hundred, through all of ingest: each is ingested, skipped or quarantined, nothing else."""

import signal
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import foreign_files
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mutations import mutated
from native_logs import GOOD, log_text

from pipeline.base.errors import LogError
from pipeline.intake.ingest import ingest
from pipeline.intake.quarantine import list_quarantine
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.readers import Log, RawLog
from pipeline.readers.formats.native import read
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

CONSTANTS = """
step_at = "command edge"
[constants]
device = "bench"
experiment = "1"
stiffness = 300
damping = 2
step = 8
sampling_period_s = 0.001
"""


def toml(kind: str, ending: str, time: str, command: str, position: str, more: str = "") -> str:
    return f"""
name = "lab"
format = "{kind}"
files = ["*.{ending}"]
{more}
columns.time = {{ name = "{time}", unit = "{"ns" if "stamp" in time else "s"}" }}
columns.command = {{ name = "{command}", unit = "N", sign = 1 }}
columns.position = {{ name = "{position}", unit = "mm", sign = -1 }}
{CONSTANTS}"""


def delimited(rows: int) -> bytes:
    rng = np.random.default_rng(rows)
    cells = np.column_stack([np.arange(rows) / 1000, rng.normal(size=rows), rng.normal(size=rows)])
    lines = [";".join(f"{value:.6f}" for value in row).replace(".", ",") for row in cells]
    return ("Prüfstand 3\nZeit;Kraft;Weg\n" + "\n".join(lines) + "\n").encode()


def foreign(make, rows: int) -> bytes:
    """A log of `foreign_files` with another number of rows."""
    original = foreign_files.samples
    with patch.object(foreign_files, "samples", lambda _=0: original(rows)):
        return make()


def bag(kind: str, packed: str, rows: int) -> bytes:
    return foreign_files.bag_file(kind, partial(foreign_files.joint_log, rows=rows), packed)


HDF5 = partial(foreign, lambda: foreign_files.hdf5_file(foreign_files.hdf5_log))
MAT73 = partial(foreign, lambda: foreign_files.hdf5_file(foreign_files.matlab73_log, 512))
JOINTS = ("/arm/joints.header.stamp", "/arm/joints.position[0]", "/arm/joints.position[1]")
PAIR = ("q[0]", "q[1]")
FORMATS = {
    "native": (None, "csv", lambda rows: log_text(rows=rows).encode()),
    "delimited": (
        toml("delimited", "csv", "Zeit", "Kraft", "Weg", 'delimiter = ";"\ndecimal = ","\nskip_rows = 1'),
        "csv",
        delimited,
    ),
    "json": (toml("json", "json", "t", *PAIR, 'records = "entries"'), "json", partial(foreign, foreign_files.json_log)),
    "parquet": (
        toml("parquet", "parquet", "t", *PAIR),
        "parquet",
        partial(foreign, partial(foreign_files.arrow_log, "parquet")),
    ),
    "feather": (
        toml("feather", "feather", "t", *PAIR),
        "feather",
        partial(foreign, partial(foreign_files.arrow_log, "lz4")),
    ),
    "matlab 5": (
        toml("matlab", "mat", "t", "log.q[0]", "log.q[1]"),
        "mat",
        partial(foreign, partial(foreign_files.matlab5_log, False)),
    ),
    "matlab 5 packed": (
        toml("matlab", "mat", "t", "log.q[0]", "log.q[1]"),
        "mat",
        partial(foreign, partial(foreign_files.matlab5_log, True)),
    ),
    "matlab 7.3": (toml("matlab", "mat", "t", "log.q[0]", "log.q[1]"), "mat", MAT73),
    "hdf5": (toml("hdf5", "h5", "arm/t", "arm/q[0]", "arm/q[1]"), "h5", HDF5),
    "tdms": (
        toml("tdms", "tdms", "@time", "/arm/force", "/arm/count"),
        "tdms",
        partial(foreign, foreign_files.tdms_log),
    ),
    "bag": (toml("rosbag", "bag", *JOINTS), "bag", partial(bag, "bag", "lz4")),
    "db3": (toml("rosbag", "db3", *JOINTS), "db3", partial(bag, "db3", "")),
    "mcap": (toml("mcap", "mcap", *JOINTS), "mcap", partial(bag, "mcap", "zstd")),
}
TEXTS = ("native", "delimited", "json")
GOOD_ROWS = (42, 44, 46)
"""Rows of the right logs among the damaged ones, whose original has 40: none of these is a copy of another."""

SECONDS_FOR_A_FOLDER = 200
"""A folder of 150 takes one to three, eight times that on a busy machine; a library that hangs costs 0.6 s a file."""


@contextmanager
def at_most(seconds: int):
    def give_up(*_):
        raise TimeoutError(f"ingest does not come to an end within {seconds} s")

    former = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


def damage_and_ingest(folder: Path, kind: str, count: int, seed: int) -> tuple[int, int]:
    """Ingest damaged and right logs of one format, check what always holds; returns how many were taken, refused."""
    profile, ending, make = FORMATS[kind]
    logs, processed = folder / "logs", folder / "processed"
    logs.mkdir()
    for rows in GOOD_ROWS:
        # names that sort before, amid and behind the others
        (logs / f"{rows * 100 // 46:03}_good.{ending}").write_bytes(make(rows))
    original = make(40)
    for number in range(count):
        data = mutated(original, f"{kind} {seed} {number}", kind in TEXTS)
        (logs / f"{number:03}.{ending}").write_bytes(data)
    if profile is not None:
        (folder / "lab.toml").write_text(profile)
    with at_most(SECONDS_FOR_A_FOLDER):
        report = ingest([logs], processed, None if profile is None else folder / "lab.toml", jobs=1)
    assert report.found == count + len(GOOD_ROWS)
    assert report.found == report.ingested + report.skipped + len(report.quarantined)
    for refusal in report.quarantined:
        assert refusal.code is not None
        assert refusal.reason
        assert "_good" not in refusal.path, refusal.reason
    assert len(list_quarantine(processed)) == len(report.quarantined)
    trials = read_trials(processed)
    stored = {Path(path).name for path in trials.column("source_path").to_pylist()}
    assert sum("_good" in name for name in stored) == len(GOOD_ROWS), "a right log was not ingested"
    assert len(stored) == report.ingested
    for file in processed.rglob("*.parquet"):
        table = pq.read_table(file)
        table.validate(full=True)
        if "samples" in file.parts:
            for name in ("time_s", "command", "position", "force", "velocity"):
                values = table.column(name)
                assert name in ("force", "velocity") or values.null_count == 0
                assert np.isfinite(values.drop_null().to_numpy()).all(), f"{name} is not finite"
    for experiment in set(trials.column("experiment").to_pylist()):
        load_trials(processed, trials.filter(np.array(trials.column("experiment").to_pylist()) == experiment))
    return report.ingested - len(GOOD_ROWS), len(report.quarantined)


@pytest.mark.parametrize("kind", ["native", "delimited", "json", "parquet", "matlab 7.3", "mcap"])
def test_damaged_logs(tmp_path, kind):
    _, refused = damage_and_ingest(tmp_path, kind, 10, 0)
    assert refused > 2, "the damage is hardly noticed"


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS)
def test_many_damaged_logs_of_each_format(tmp_path, kind):
    _, refused = damage_and_ingest(tmp_path, kind, 400, 0)
    assert refused > 80, "the damage is hardly noticed"


NATIVE = next(profile for profile in shipped_profiles() if profile.format == "native")
LINES = GOOD.split("\n")
PIECES = st.one_of(
    st.text(max_size=30),
    st.sampled_from(LINES),
    st.sampled_from([*"\r\n,#:[]\0", "\ufeff", "nan", "1e999", "\u0661", "time_s,command,position", "# stiffness: 3"]),
    st.floats().map(repr),
    st.lists(st.floats(allow_nan=False), min_size=3, max_size=3).map(lambda row: ",".join(map(repr, row))),
)


@settings(max_examples=100, deadline=None, database=None, derandomize=True)
@given(st.lists(PIECES, max_size=30), st.sampled_from(["", "\n", "\r\n"]), st.integers(0, len(LINES)))
@example(["\ud800"], "\n", 0)
def test_any_text_is_a_native_log_or_refused(pieces, end, kept):
    text = "\n".join(LINES[:kept]) + "\n" + end.join(pieces)
    data = text.encode("utf-8", "surrogatepass")
    (alone,) = read(NATIVE, [RawLog(("log.csv",), (data,))])
    good, beside = read(NATIVE, [RawLog((n,), (d,)) for n, d in (("good.csv", GOOD.encode()), ("log.csv", data))])
    assert isinstance(good, tuple), "a log beside it was refused"
    for outcome in (alone, beside):
        if isinstance(outcome, LogError):
            assert outcome.row is None or 1 <= outcome.row <= data.count(b"\n") + 2
            assert outcome.code
        else:
            (log,) = outcome
            assert isinstance(log, Log)
            assert all(np.isfinite(values).all() for values in (log.time, log.command, log.position))
            assert (np.diff(log.time) > 0).all()
    assert str(alone) == str(beside) or not isinstance(alone, LogError)

"""Damaged, cut, empty and hostile files: a frame or a `LogError` comes out, whatever the bytes."""

import random
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import misbehaving
import numpy as np
import pytest
from foreign_files import (
    arrow_log,
    bag_file,
    hdf5_file,
    hdf5_log,
    joint_log,
    json_log,
    list_columns,
    matlab5_log,
    matlab73_log,
    read_frame,
    tdms_log,
)
from places import ROOT

from pipeline.base.errors import LogError
from pipeline.readers.formats import FORMATS
from pipeline.readers.frame import ColumnInfo, Contents
from pipeline.readers.isolation import isolated, library
from pipeline.readers.limits import allowed_bytes

FILES = {
    "json": ("json", json_log),
    "parquet": ("parquet", lambda: arrow_log("parquet")),
    "feather": ("feather", lambda: arrow_log("lz4")),
    "feather unpacked": ("feather", lambda: arrow_log("uncompressed")),
    "matlab 5": ("matlab", lambda: matlab5_log(False)),
    "matlab 5 packed": ("matlab", lambda: matlab5_log(True)),
    "matlab 7.3": ("matlab", lambda: hdf5_file(matlab73_log, 512)),
    "hdf5": ("hdf5", lambda: hdf5_file(hdf5_log)),
    "tdms": ("tdms", tdms_log),
    "bag": ("rosbag", lambda: bag_file("bag", joint_log)),
    "bag packed": ("rosbag", lambda: bag_file("bag", joint_log, "lz4")),
    "db3": ("rosbag", lambda: bag_file("db3", joint_log)),
    "mcap": ("mcap", lambda: bag_file("mcap", joint_log)),
    "mcap packed": ("mcap", lambda: bag_file("mcap", joint_log, "zstd")),
}
DAMAGES = 200
LONGEST_S = 15.0
"""Wait for one file: 0.6 s of processor time (isolation.CPU_SECONDS) on a machine with 20 times that load."""


def damaged(data, seed):
    """Yield copies of a file that are cut, or have up to 40 changed bytes."""
    rng = random.Random(seed)
    while True:
        copy = bytearray(data)
        if rng.random() < 0.25:
            del copy[rng.randrange(len(copy)) :]
        for _ in range(rng.choice((1, 1, 2, 8, 40)) if copy else 0):
            copy[rng.randrange(len(copy))] = rng.choice((0, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        yield bytes(copy)


@pytest.mark.sampled
@pytest.mark.parametrize("kind", FILES)
def test_only_frames_and_log_errors_come_out(kind):
    form, make = FILES[kind]
    name = f"log.{'bag' if 'bag' in kind else kind.split()[0]}"
    settings = {"records": "entries"} if kind == "json" else {}
    whole = make()
    assert len(list_columns(form, name, whole, **settings)) > 3
    refusals = []
    longest = 0.0
    for number, data in enumerate(islice(damaged(whole, kind), DAMAGES)):
        start = time.monotonic()
        try:
            if number % 2:
                found = list_columns(form, name, data, **settings)
                assert all(isinstance(info, ColumnInfo) for info in found)
            else:
                found = read_frame(form, name, data, **settings)
                assert isinstance(found, Contents)
                assert {len(column) for column in found.columns.values()} <= {len(found.row)}
        except LogError as error:
            refusals.append(str(error))
        longest = max(longest, time.monotonic() - start)
    assert refusals, "no damage was noticed"
    assert [refusal for refusal in refusals if not refusal.startswith("log")] == [], "a refusal names the file"
    assert longest < LONGEST_S


@pytest.mark.parametrize("form", ["json", "parquet", "feather", "matlab", "hdf5", "tdms", "rosbag", "mcap", "mdf"])
@pytest.mark.parametrize(
    "data", [b"", b"\0", b"\0" * 5000, b"time_s,command,position\n0,0,0\n", b"PK\x03\x04" + b"\0" * 600]
)
def test_files_of_another_kind_are_refused(form, data):
    for read in (lambda: read_frame(form, "log", data, ["t"]), lambda: list_columns(form, "log", data)):
        with pytest.raises(LogError, match=r"^log: .*(expected|cut|Correct|Record|mended)"):
            read()


def test_limits_grow_with_the_file():
    assert allowed_bytes(0) == 64 << 20
    assert allowed_bytes(5 << 20) == 150 << 20
    assert allowed_bytes(256 << 20) == 1 << 30


def test_a_worker_that_hangs_or_crashes_costs_only_its_file():
    for function, words in (
        ("hang", "cannot be read as a file: the library that reads it does not come to an end"),
        ("crash", "cannot be read as a file: the library that reads it crashes .status -11"),
        ("starve", "takes more memory than a file of its size may"),
    ):
        with pytest.raises(LogError, match=f"^log: {words}"):
            isolated(f"{misbehaving.__name__}:{function}", "log", "a file", b"")
        assert isolated("misbehaving:shout", "log", "a file", b"a", "b", imports="no_such_module") == "ab"


def test_refusals_come_back_with_their_row():
    with pytest.raises(LogError, match="wrong in row 7") as error:
        isolated("misbehaving:refuse", "log", "a file", b"")
    assert error.value.row == 7


def test_threads_have_workers_of_their_own():
    files = [hdf5_file(lambda file, n=n: file.create_dataset("t", data=np.full(4, n))) for n in range(8)]
    with ThreadPoolExecutor(4) as pool:
        frames = list(pool.map(lambda data: read_frame("hdf5", "log", data, ["t"]), files))
    assert [frame.columns["t"][0] for frame in frames] == list(range(8))


def test_a_library_that_is_missing_is_named():
    with pytest.raises(LogError, match=r"needs no_such_module, .*pip install '\.\[extra\]'.*--rehash"):
        library("no_such_module", "extra")


def test_every_extra_that_a_message_names_exists():
    root = ROOT
    extras = set(tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    assert {form.extra for form in FORMATS.values()} - {""} <= extras

"""Damaged, cut, empty and hostile files: a frame or a `LogError` comes out, whatever the bytes."""

import tomllib
from concurrent.futures import ThreadPoolExecutor

import misbehaving
import numpy as np
import pytest
from foreign_files import (
    hdf5_file,
    read_frame,
)
from places import ROOT

from pipeline.base.errors import LogError
from pipeline.readers.file_columns import allowed_bytes, library
from pipeline.readers.formats import FORMATS
from pipeline.readers.isolation import isolated


@pytest.mark.parametrize("form", ["json", "parquet", "feather", "matlab", "hdf5", "tdms", "rosbag", "mcap", "mdf"])
@pytest.mark.parametrize(
    "data", [b"", b"\0", b"\0" * 5000, b"time_s,command,position\n0,0,0\n", b"PK\x03\x04" + b"\0" * 600]
)
def test_files_of_another_kind_are_refused(form, data):
    with pytest.raises(LogError, match=r"^log: .*(expected|truncated|Correct|Record|Repair)"):
        read_frame(form, "log", data, ["t"])


def test_limits_grow_with_the_file():
    assert allowed_bytes(0) == 64 << 20
    assert allowed_bytes(5 << 20) == 150 << 20
    assert allowed_bytes(256 << 20) == 1 << 30


def test_a_worker_that_hangs_or_crashes_costs_only_its_file():
    for function, words in (
        ("hang", "cannot be read as a file: its library does not end in time"),
        ("crash", "cannot be read as a file: its library crashes .status -11"),
        ("starve", "needs more memory than a file of its size may use"),
    ):
        with pytest.raises(LogError, match=f"^log: {words}"):
            isolated(f"{misbehaving.__name__}:{function}", "a file", 0, "log", b"")
        assert isolated("misbehaving:shout", "a file", 0, "log", b"a", "b", imports="no_such_module") == "ab"


def test_refusals_come_back_with_their_row():
    with pytest.raises(LogError, match="wrong in row 7") as error:
        isolated("misbehaving:refuse", "a file", 0, "log", b"")
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

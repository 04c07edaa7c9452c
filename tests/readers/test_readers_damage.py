"""Damaged, cut, empty and hostile files: a frame or a `LogError` comes out, whatever the bytes."""

import bz2
import random
import re
import struct
import time
import tomllib
import zlib
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import lz4.frame
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
    matlab5_log,
    matlab73_log,
    profile,
    tdms_log,
    zstd,
)
from places import ROOT

from pipeline.base.errors import LogError
from pipeline.readers import safety
from pipeline.readers.formats import arrow_tables, hdf5, json_records, matlab, mcap, rosbag, tdms
from pipeline.readers.frame import ColumnInfo, Frame
from pipeline.readers.isolation import isolated

FILES = {
    "json": (json_records, json_log),
    "parquet": (arrow_tables, lambda: arrow_log("parquet")),
    "feather": (arrow_tables, lambda: arrow_log("lz4")),
    "feather unpacked": (arrow_tables, lambda: arrow_log("uncompressed")),
    "matlab 5": (matlab, lambda: matlab5_log(False)),
    "matlab 5 packed": (matlab, lambda: matlab5_log(True)),
    "matlab 7.3": (matlab, lambda: hdf5_file(matlab73_log, 512)),
    "hdf5": (hdf5, lambda: hdf5_file(hdf5_log)),
    "tdms": (tdms, tdms_log),
    "bag": (rosbag, lambda: bag_file("bag", joint_log)),
    "bag packed": (rosbag, lambda: bag_file("bag", joint_log, "lz4")),
    "db3": (rosbag, lambda: bag_file("db3", joint_log)),
    "mcap": (mcap, lambda: bag_file("mcap", joint_log)),
    "mcap packed": (mcap, lambda: bag_file("mcap", joint_log, "zstd")),
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
    module, make = FILES[kind]
    records = profile("entries") if kind == "json" else profile()
    whole = make()
    assert len(module.list_columns("log", whole, records)) > 3
    refusals = []
    longest = 0.0
    for number, data in enumerate(islice(damaged(whole, kind), DAMAGES)):
        start = time.monotonic()
        try:
            if number % 2:
                found = module.list_columns("log", data, records)
                assert all(isinstance(info, ColumnInfo) for info in found)
            else:
                found = module.read_frame(records, "log", data, ())
                assert isinstance(found, Frame)
                assert {len(column) for column in found.columns.values()} <= {len(found.row)}
        except LogError as error:
            refusals.append(str(error))
        longest = max(longest, time.monotonic() - start)
    assert refusals, "no damage was noticed"
    assert [refusal for refusal in refusals if not refusal.startswith("log")] == [], "a refusal names the file"
    assert longest < LONGEST_S


@pytest.mark.parametrize("module", [json_records, arrow_tables, matlab, hdf5, tdms, rosbag, mcap])
@pytest.mark.parametrize(
    "data", [b"", b"\0", b"\0" * 5000, b"time_s,command,position\n0,0,0\n", b"PK\x03\x04" + b"\0" * 600]
)
def test_files_of_another_kind_are_refused(module, data):
    for read in (lambda: module.read_frame(profile(), "log", data, ["t"]), lambda: module.list_columns("log", data)):
        with pytest.raises(LogError, match=r"^log .*(expected|cut|Correct|Record)"):
            read()


@pytest.mark.parametrize(
    ("packing", "pack"),
    [("zlib", zlib.compress), ("bz2", bz2.compress), ("lz4", lz4.frame.compress), ("zstd", zstd.compress)],
)
def test_unpacking_stops_at_the_limit(packing, pack):
    bomb = pack(bytes(100 << 20))
    with pytest.raises(LogError, match="log: packed data claims"):
        safety.unpack("log", packing, bomb, safety.allowed_bytes(len(bomb)), len(bomb))
    text = b"samples" * 1000
    assert safety.unpack("log", packing, pack(text), 1 << 20, 500) == text
    with pytest.raises((EOFError, RuntimeError)):
        safety.unpack("log", packing, pack(text)[:-6], 1 << 20, 500)


def test_limits_grow_with_the_file():
    assert safety.allowed_bytes(0) == 64 << 20
    assert safety.allowed_bytes(5 << 20) == 500 << 20
    assert safety.allowed_bytes(256 << 20) == 1 << 30
    with pytest.raises(LogError, match=r"expected one of .*zstd"):
        safety.unpack("log", "rar", b"", 1, 1)


def test_bombs_in_bags_are_refused():
    def head(*fields):
        body = b"".join(struct.pack("<I", len(f)) + f for f in fields)
        return struct.pack("<I", len(body)) + body

    bomb = bz2.compress(bytes(100 << 20))
    chunk = head(b"op=\x05", b"compression=bz2", b"size=\0\0\0\0") + struct.pack("<I", len(bomb)) + bomb
    with pytest.raises(LogError, match="packed data claims"):
        rosbag.list_columns("log.bag", b"#ROSBAG V2.0\n" + chunk)
    bomb = zstd.compress(bytes(100 << 20))
    body = struct.pack("<QQQII", 0, 0, 100 << 20, 0, 4) + b"zstd" + struct.pack("<Q", len(bomb)) + bomb
    with pytest.raises(LogError, match="packed data claims"):
        mcap.list_columns("log.mcap", b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(body)) + body)


def test_lists_of_lists_of_nothing_end():
    """Messages without content may claim lists of 2^32 elements in each other."""
    definition = "B[] b\n" + "=" * 80 + "\nMSG: x/B\nC[] c\n" + "=" * 80 + "\nMSG: x/C\n"
    conn = b"".join(
        struct.pack("<I", len(f)) + f for f in (b"type=x/A", b"md5sum=0", b"message_definition=" + definition.encode())
    )

    def rec(fields, body):
        joined = b"".join(struct.pack("<I", len(f)) + f for f in fields)
        return struct.pack("<I", len(joined)) + joined + struct.pack("<I", len(body)) + body

    many = 20_000
    message = struct.pack("<I", many) + struct.pack("<I", many) * many
    data = b"#ROSBAG V2.0\n" + rec((b"op=\x07", b"conn=\0\0\0\0", b"topic=/a"), conn)
    data += rec((b"op=\x02", b"conn=\0\0\0\0", b"time=" + bytes(8)), message)
    with pytest.raises(LogError, match="does not come to an end"):
        rosbag.read_frame(profile(), "log.bag", data, ["/a.b[0].c[0].x"])


def test_a_worker_that_hangs_or_crashes_costs_only_its_file():
    for function, words in (
        ("hang", "cannot be read as a file: the library that reads it does not come to an end"),
        ("crash", "cannot be read as a file: the library that reads it crashes .status -11"),
        ("starve", "takes more memory than a file of its size may"),
    ):
        with pytest.raises(LogError, match=f"^log {words}"):
            isolated(f"{misbehaving.__name__}:{function}", "log", "a file", b"", imports=())
        assert isolated("misbehaving:shout", "log", "a file", b"a", "b", imports=("no_such_module",)) == "ab"


def test_refusals_come_back_with_their_row():
    with pytest.raises(LogError, match="wrong in row 7") as error:
        isolated("misbehaving:refuse", "log", "a file", b"", imports=())
    assert error.value.row == 7


def test_threads_have_workers_of_their_own():
    files = [hdf5_file(lambda file, n=n: file.create_dataset("t", data=np.full(4, n))) for n in range(8)]
    with ThreadPoolExecutor(4) as pool:
        frames = list(pool.map(lambda data: hdf5.read_frame(profile(), "log", data, ["t"]), files))
    assert [frame.columns["t"][0] for frame in frames] == list(range(8))


def test_a_library_that_is_missing_is_named():
    with pytest.raises(
        LogError, match=r"needs the package no_such, .*pip install 'haptic-pipeline\[extra\]'.*--rehash"
    ):
        safety.library("no_such_module", "no_such", "extra")


def test_every_extra_that_a_message_names_exists():
    root = ROOT
    extras = set(tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    named = set()
    for path in sorted((root / "pipeline" / "readers").rglob("*.py")):
        named |= set(re.findall(r'library\([^()]*"(\w+)"\)|open_image\(data, "(\w+)"\)', path.read_text()))
    names = {name for pair in named for name in pair if name}
    assert names == {"mat", "hdf5", "bags", "tdms"}
    assert names <= extras

"""Run as a script by test_hostile: files whose headers claim far more than they hold, read with little address space.

Prints, as JSON, how many such files of each format were refused, and the largest memory of this process and of its
workers. Ends with an error where a file is accepted, or anything else than a refusal happens.
"""

import json
import resource
import sqlite3
import struct
import sys
import tempfile
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
from foreign_files import (
    arrow_log,
    bag_file,
    hdf5_file,
    joint_log,
    list_columns,
    matlab5_log,
    matlab_class,
    read_frame,
    tdms_log,
    zstd,
)
from pyarrow import parquet

from pipeline.base import isolated
from pipeline.base.errors import LogError

ADDRESS_SPACE = 3 << 30
"""Bytes: the libraries take 1 to 2 of it without using them; what follows a claim of 10^12 rows takes more than any."""

ROWS = 10**12


def replaced(data: bytes, old: bytes, new: bytes) -> Iterator[bytes]:
    """Yield copies with one occurrence after the other replaced."""
    assert len(old) == len(new)
    at = data.find(old)
    while at >= 0:
        yield data[:at] + new + data[at + len(old) :]
        at = data.find(old, at + 1)


def bomb(packer: Any, mebibytes: int, block: bytes = bytes(1 << 20)) -> bytes:
    """Return so much of one block, packed, without ever having it in memory."""
    return b"".join([*(packer.compress(block) for _ in range(mebibytes)), packer.flush()])


def parquet_claims() -> Iterator[bytes]:
    buffer = BytesIO()
    parquet.write_table(pa.table({"t": pa.array(np.zeros(20_000_000))}), buffer)
    yield buffer.getvalue()


def feather_claims() -> Iterator[bytes]:
    data = arrow_log("zstd")
    for size in (40 * 8, 15 * 8, 15):
        yield from replaced(data, struct.pack("<q", size), struct.pack("<q", ROWS))


def matlab_claims() -> Iterator[bytes]:
    plain = matlab5_log(False)
    yield from replaced(plain, struct.pack("<ii", 40, 1), struct.pack("<ii", 2**31 - 1, 2**31 - 1))
    yield from replaced(plain, struct.pack("<II", 9, 320), struct.pack("<II", 9, 2**32 - 8))
    packed = bomb(zlib.compressobj(), 150)
    yield plain[:128] + struct.pack("<II", 15, len(packed)) + packed


def huge(file: h5py.File) -> None:
    matlab_class(file.create_dataset("t", shape=(ROWS,), chunks=(1000,), dtype="f8", compression="gzip"), "double")


def packed_zeros(file: h5py.File) -> None:
    block = 1_000_000
    zeros = file.create_dataset("t", shape=(20 * block,), dtype="f8", chunks=(block,), compression="gzip")
    for start in range(0, len(zeros), block):
        zeros[start : start + block] = 0.0
    matlab_class(zeros, "double")


def tdms_claims() -> Iterator[bytes]:
    data = tdms_log()
    yield from replaced(data, struct.pack("<Q", 20), struct.pack("<Q", ROWS))
    yield from replaced(data, struct.pack("<Q", 20), struct.pack("<Q", 2**63))


def bag_claims() -> Iterator[bytes]:
    plain = bag_file("bag", joint_log)
    for at in (13, 200, 4117):
        yield plain[:at] + struct.pack("<I", 0xFFFFFFF0) + plain[at + 4 :]
    fields = b"".join(
        struct.pack("<I", len(field)) + field
        for field in (b"op=\x05", b"compression=lz4", b"size=" + struct.pack("<I", 2**32 - 1))
    )
    # an lz4 frame that states a content of 10^12 bytes
    frame = b"\x04\x22\x4d\x18\x68\x40" + struct.pack("<Q", ROWS) + b"\0" + bytes(100)
    yield b"#ROSBAG V2.0\n" + struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(frame)) + frame


def mcap_claims() -> Iterator[bytes]:
    plain = bag_file("mcap", joint_log)
    for length in (2**63, ROWS):
        yield plain[:9] + struct.pack("<Q", length) + plain[17:]
    packed = bomb(zstd.ZstdCompressor(), 150)
    body = struct.pack("<QQQII", 0, 0, ROWS, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    yield b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(body)) + body


def database_claims() -> Iterator[bytes]:
    data = bag_file("db3", joint_log)
    # pages of the database
    yield data[:28] + struct.pack(">I", 2**32 - 2) + data[32:]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.db3"
        path.write_bytes(data)
        with sqlite3.connect(path) as database:
            database.execute("CREATE VIEW big AS SELECT 1, zeroblob(1000000000), 1")
            database.execute("ALTER TABLE messages RENAME TO others")
            database.execute("CREATE TABLE messages AS SELECT id, topic_id, timestamp, data FROM others")
            database.execute("UPDATE messages SET data = NULL")
            database.commit()
        database.close()
        yield path.read_bytes()


def text_claims() -> Iterator[bytes]:
    yield bomb(zlib.compressobj(wbits=31), 150)
    yield bomb(zstd.ZstdCompressor(), 150, b"1,2,3\n" * (1 << 17))
    # a zstd frame that states its content in 8 bytes
    yield b"\x28\xb5\x2f\xfd\xc0\x00" + struct.pack("<Q", ROWS) + bytes(100)


FORMATS = {
    "parquet": ("parquet", parquet_claims),
    "feather": ("feather", feather_claims),
    "matlab 5": ("matlab", matlab_claims),
    "matlab 7.3": ("matlab", lambda: iter([hdf5_file(huge, 512), hdf5_file(packed_zeros, 512)])),
    "hdf5": ("hdf5", lambda: iter([hdf5_file(huge), hdf5_file(packed_zeros)])),
    "tdms": ("tdms", tdms_claims),
    "bag": ("rosbag", bag_claims),
    "db3": ("rosbag", database_claims),
    "mcap": ("mcap", mcap_claims),
    "text": ("delimited", text_claims),
    "json": ("json", lambda: iter([b'[{"t": ' + b"9" * 5000 + b"}]"])),
}


def main() -> None:
    # the bombs themselves are made first, since this takes memory
    files = [(kind, form, data) for kind, (form, make) in FORMATS.items() for data in make()]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    claims = dict.fromkeys(FORMATS, 0)
    for kind, form, data in files:
        name = f"log.{'db3' if kind == 'db3' else kind}"
        for read in (
            lambda form=form, data=data, name=name: read_frame(form, name, data, decimal="."),
            lambda form=form, data=data, name=name: list_columns(form, name, data, decimal="."),
        ):
            try:
                read()
            except LogError:
                claims[kind] += 1
    isolated.end_all()
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    json.dump(
        {
            "claims": claims,
            "files": len(files),
            "made_mib": before >> 10,
            "peak_mib": peak >> 10,
            "worker_peak_mib": children >> 10,
        },
        sys.stdout,
    )


if __name__ == "__main__":
    main()

"""Logs in foreign formats, each written by the reference library of its format, for the tests of the readers."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pyarrow as pa
import scipy.io
from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter
from pyarrow import feather, parquet
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_typestore

from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import FileColumns
from pipeline.readers.isolation import read_file

zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")

START = 1_732_060_000_000_000_000
"""Time of the first message of a bag [ns]: a float of it is wrong by up to 128 ns."""


def profile(kind: str = "json", **settings: Any) -> Profile:
    """A profile of which only what format readers look at is there."""
    return Profile.model_construct(name="lab", format=kind, files=("*",), **settings)


def read_frame(kind: str, name: str, data: bytes, wanted: Sequence[str] = (), **settings: Any) -> FileColumns:
    """Columns of a file as they stand in it."""
    return read_file(profile(kind, **settings), (name,), (data,), wanted).frame()


class ColumnInfo(NamedTuple):
    """A column that a file offers: type, number of values, first ones, and what the file says of its unit."""

    name: str
    dtype: str
    rows: int
    first: tuple[str, ...] = ()
    hint: str = ""


def list_columns(kind: str, name: str, data: bytes, **settings: Any) -> list[ColumnInfo]:
    """The columns that a file offers; what cannot be read has no rows, and the reason as hint."""
    found, infos = read_file(profile(kind, **settings), (name,), (data,)), []
    for key, values in found.columns.items():
        dtype = {"f": "number", "U": "text"}.get(values.dtype.kind, "integer")
        hint = found.units.get(key) or found.hints.get(key, "")
        infos.append(ColumnInfo(key, dtype, len(values), tuple(map(str, values[:3])), hint))
    return infos + [ColumnInfo(key, "text", 0, (), reason) for key, reason in found.refused.items()]


def samples(rows: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], positions of shape (rows, 3), and a counter above 2^53."""
    rng = np.random.default_rng(5)
    return np.arange(rows) / 1000, rng.normal(size=(rows, 3)), np.arange(rows) + 2**60


def hdf5_file(write: Callable[[h5py.File], None], userblock: int = 0) -> bytes:
    """An HDF5 file; with a user block of 512 bytes, one that begins as MATLAB 7.3 begins it."""
    buffer = BytesIO()
    with h5py.File(buffer, "w", userblock_size=userblock) as file:
        write(file)
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return (head if userblock else b"") + buffer.getvalue()[len(head) if userblock else 0 :]


def hdf5_log(file: h5py.File) -> None:
    time, position, counter = samples()
    file.attrs["device"] = "arm"
    file["arm/t"] = time
    file["arm/t"].attrs["unit"] = "s"
    file.create_dataset("arm/q", data=position, chunks=(10, 3), compression="gzip", shuffle=True)
    file["arm/by_joint"] = position.T
    file["arm/single"] = position[:, 0].astype("f4")
    file["counter"] = counter
    file["stiffness"] = 3200.0
    file["label"] = np.array(["ä", "b"] * (len(time) // 2), dtype=object)
    table = np.zeros(len(time), dtype=[("t", "f8"), ("n", ">u4"), ("v", "f8", (3,))])
    table["t"], table["n"], table["v"] = time, np.arange(len(time)), position
    file["log"] = table


def matlab_class(item: Any, kind: str) -> Any:
    item.attrs["MATLAB_class"] = np.bytes_(kind)
    if kind == "char":
        item.attrs["MATLAB_int_decode"] = np.int32(2)
    return item


def matlab73_log(file: h5py.File) -> None:
    """What ``save -v7.3`` writes: arrays transposed, structs as groups, cells and struct arrays as references."""
    time, position, _ = samples()
    matlab_class(file.create_dataset("t", data=time[None, :]), "double")
    matlab_class(file.create_dataset("log/q", data=position.T), "double")
    matlab_class(file["log"], "struct")
    matlab_class(file.create_dataset("log/n", data=np.arange(len(time), dtype="u4")[:, None]), "uint32")
    matlab_class(file.create_dataset("K", data=np.array([[3200.0]])), "double")
    matlab_class(file.create_dataset("device", data=np.array([[97], [114], [109]], dtype="u2")), "char")
    nothing = matlab_class(file.create_dataset("none", data=np.array([0, 0], dtype="u8")), "double")
    nothing.attrs["MATLAB_empty"] = np.uint8(1)
    refs = file.create_group("#refs#")
    references = []
    for number in range(2):
        item = refs.create_dataset(f"v{number}", data=position[:, [number]].T)
        references.append(matlab_class(item, "double").ref)
    file.create_dataset("signals/values", data=np.array(references, dtype=h5py.ref_dtype)[:, None])
    matlab_class(file["signals"], "struct")
    texts = [matlab_class(refs.create_dataset(c, data=np.array([[ord(c)]], dtype="u2")), "char").ref for c in "ab"]
    matlab_class(file.create_dataset("cell", data=np.array(texts, dtype=h5py.ref_dtype)[:, None]), "cell")
    series = matlab_class(file.create_dataset("ts", data=np.zeros((1, 6), dtype="u4")), "timeseries")
    series.attrs["MATLAB_object_decode"] = np.int32(3)


def matlab5_log(compressed: bool) -> bytes:
    time, position, _ = samples()
    signals = np.zeros(2, dtype=[("values", "O"), ("label", "O")])
    signals[0] = (position[:, :2], "position (rad)")
    signals[1] = (position[:, 2:], "-F_h")
    buffer = BytesIO()
    contents = {
        "t": time,
        "log": {"q": position, "by_joint": position.T, "n": np.arange(len(time), dtype="u2"), "on": time > 0.01},
        "scope": {"time": time[:, None], "signals": signals},
        "K": 3200.0,
        "device": "arm ä",
        "names": np.array(["a", "bb"], dtype=object),
        "lines": np.array(["ab ", "cde"]),
        "none": np.zeros((0, 0)),
        "pose": np.moveaxis(np.tile(position[:, :, None], (1, 1, 2)), 0, 2),
        "z": np.array([1 + 2j, 3]),
        "single": position[:, 0].astype("f4"),
        "big": np.arange(len(time), dtype="u8") + 2**63,
    }
    scipy.io.savemat(buffer, contents, do_compression=compressed, oned_as="column")
    return buffer.getvalue()


def arrow_table() -> pa.Table:
    time, position, counter = samples()
    rows = len(time)
    return pa.table(
        {
            "t": time,
            "stamp": pa.array(START // 1000 + 1000 * np.arange(rows), pa.timestamp("us", "UTC")),
            "n": pa.array(counter, pa.uint64()),
            "gap": pa.array([None, *range(1, rows)], pa.int32()),
            "label": pa.array(["a", "bb"] * (rows // 2)).dictionary_encode(),
            "q": pa.array(list(position)),
            "fixed": pa.FixedSizeListArray.from_arrays(pa.array(position.reshape(-1)), 3),
            "state": [{"w": value, "on": True} for value in position[:, 0]],
            "raw": [b"x"] * rows,
        },
        metadata={"device": "arm"},
    )


def arrow_log(kind: str) -> bytes:
    buffer = BytesIO()
    if kind == "parquet":
        parquet.write_table(arrow_table(), buffer, row_group_size=15)
    else:
        feather.write_feather(arrow_table(), buffer, compression=kind, chunksize=15)
    return buffer.getvalue()


def json_log() -> bytes:
    time, position, _ = samples()
    entries = [{"t": t, "q": list(q), "on": t > 0.01} for t, q in zip(time.tolist(), position.tolist(), strict=True)]
    return json.dumps({"kp": 32, "motor": {"name": "ä"}, "entries": entries}).encode()


def tdms_log() -> bytes:
    time, position, _ = samples()
    waveform = {"wf_increment": 0.001, "wf_start_offset": 0.5, "unit_string": "N"}
    stamps = np.datetime64(START // 1000, "us") + np.arange(len(time)) * np.timedelta64(1001, "us")
    half = len(time) // 2
    buffer = BytesIO()
    with TdmsWriter(buffer) as writer:
        for part in (slice(0, half), slice(half, None)):
            writer.write_segment(
                [
                    RootObject({"operator": "me", "trial": 3}),
                    GroupObject("arm", {"K": 3200.0}),
                    ChannelObject("arm", "force", position[part, 0], waveform),
                    ChannelObject("arm", "count", np.arange(len(time), dtype="u4")[part], waveform),
                    ChannelObject("arm", "stamp", stamps[part]),
                    ChannelObject("arm", "label", ["ä", "b"] * (half // 2)),
                ]
            )
    return buffer.getvalue()


def bag_file(kind: str, fill: Callable[[Any, Any, bool], None], packed: str = "") -> bytes:
    """A bag of a kind ("bag", "db3", "mcap"), filled by ``fill(writer, typestore, is_ros1)``."""
    with tempfile.TemporaryDirectory() as folder:
        if kind == "bag":
            path = Path(folder) / "x.bag"
            writer: Any = Bag1(path)
            if packed:
                writer.set_compression(Bag1.CompressionFormat[packed.upper()])
        else:
            plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
            writer = Bag2(Path(folder) / "x", version=9, storage_plugin=plugin)
            if packed:
                mode = CompressionMode.STORAGE if kind == "mcap" else CompressionMode.MESSAGE
                writer.set_compression(mode, CompressionFormat.ZSTD)
            path = Path(folder) / "x" / f"x.{kind}"
        with writer:
            fill(writer, get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE), kind == "bag")
        return path.read_bytes()


def joint_log(writer: Any, store: Any, is_ros1: bool, rows: int = 40) -> None:
    """Joint states at 1 kHz with a header, and a command without one at every second of them, received later."""
    types = store.types
    joints, header, number = (
        types[f"{key}"] for key in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "std_msgs/msg/Float64")
    )
    encode = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    states = writer.add_connection("/arm/joints", joints.__msgtype__, typestore=store)
    commands = writer.add_connection("/command", number.__msgtype__, typestore=store)
    _, position, _ = samples(rows)
    for i in range(rows):
        time = START + 1_000_000 * i
        stamp = types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
        head = header(stamp=stamp, frame_id="base", **({"seq": i} if is_ros1 else {}))
        nothing = np.empty(0)
        message = joints(header=head, name=["a", "b", "c"], position=position[i], velocity=nothing, effort=nothing)
        writer.write(states, time + 150, encode(message, joints.__msgtype__))
        if i % 2 == 0:
            writer.write(commands, time + 500, encode(number(data=float(i)), number.__msgtype__))

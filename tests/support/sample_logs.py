"""Small logs in the file formats that docs/logs.md describes, written by the libraries of these formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

STEP = 8.0
TIME_S = np.array([0.0, 0.001, 0.002])
FORCE = np.array([0.0, STEP, STEP])
POSITION_MM = np.array([0.0, 0.0, 0.02])


def parquet() -> None:
    import pyarrow as pa
    from pyarrow import feather
    from pyarrow.parquet import write_table

    table = pa.table({"t_us": [0, 1000, 2000], "F": FORCE, "x": [[x, 1.0] for x in POSITION_MM]})
    write_table(table, "log.parquet")
    feather.write_feather(table, "log.feather")


def matlab() -> None:
    from scipy.io import savemat

    log = {"t": 25.372 + TIME_S, "minus_F": -FORCE, "x": POSITION_MM / 1e3}
    savemat("wall.mat", {"log": log, "K": 300.0})


def bag() -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    names = ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    joints, header, stamp = (store.types[name] for name in names)
    with Writer(Path("bag"), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/joints", joints.__msgtype__, typestore=store)
        for k, (torque, angle) in enumerate(zip(FORCE, POSITION_MM, strict=True)):
            head = header(stamp=stamp(sec=1700000000, nanosec=1_000_000 * k), frame_id="arm")
            message = joints(head, ["joint"], *(np.array([value]) for value in (angle, 0.0, torque)))
            packed = store.serialize_cdr(message, joints.__msgtype__)
            writer.write(topic, 10**9 * 1700000000 + 1_000_000 * k, packed)


WRITERS: dict[str, Callable[[], None]] = {f"{writer.__name__}.toml": writer for writer in (parquet, matlab, bag)}
"""What writes the sample that a profile of docs/logs.md reads, by the file of the profile."""

"""Stamps of clocks that count from a date: what every reader makes of them has the exact differences of the file."""

import json
from fractions import Fraction
from io import BytesIO

import numpy as np
import pyarrow as pa
import pytest
import scipy.io
from foreign_files import START, bag_file, hdf5_file
from nptdms import ChannelObject, TdmsWriter
from pyarrow import feather, parquet

from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log, RawLog, reader_of

ROWS = 50
# irregular, in whole microseconds, since TDMS is written in these
STAMPS = START + 1000 * (1000 * np.arange(ROWS) + np.random.default_rng(8).integers(0, 400, size=ROWS))
SECONDS = np.array([float(Fraction(int(ns - STAMPS[0]), 10**9)) for ns in STAMPS])
NS = STAMPS.tolist()
TEXTS = [f"{ns // 10**9}.{ns % 10**9:09d}" for ns in NS]
SECONDS_AS_FLOATS = [float(text) for text in TEXTS]


def exact(found):
    # one product with 1e-9 or a power of ten: two roundings, of a difference that another one was taken off
    np.testing.assert_allclose(found, SECONDS, rtol=5e-16, atol=1e-17)


def table(stamps):
    return pa.table({"t": stamps, "F": np.ones(ROWS), "x": np.arange(ROWS) / 8})


def arrow(write, stamps=None):
    buffer = BytesIO()
    write(table(pa.array(STAMPS, pa.timestamp("ns")) if stamps is None else stamps), buffer)
    return buffer.getvalue()


def matlab():
    buffer = BytesIO()
    scipy.io.savemat(buffer, {"t": STAMPS, "F": np.ones(ROWS), "x": np.arange(ROWS) / 8})
    return buffer.getvalue()


def hdf5():
    def write(file):
        file["t"], file["F"], file["x"] = STAMPS, np.ones(ROWS), np.arange(ROWS) / 8

    return hdf5_file(write)


def tdms():
    stamps = np.datetime64(0, "us") + (STAMPS // 1000) * np.timedelta64(1, "us")
    columns = {"t": stamps, "F": np.ones(ROWS), "x": np.arange(ROWS) / 8}
    buffer = BytesIO()
    with TdmsWriter(buffer) as writer:
        writer.write_segment([ChannelObject("g", name, values) for name, values in columns.items()])
    return buffer.getvalue()


def bag(kind):
    def fill(writer, store, is_ros1):
        names = ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
        joints, header, time = (store.types[name] for name in names)
        encode = store.serialize_ros1 if is_ros1 else store.serialize_cdr
        topic = writer.add_connection("/j", joints.__msgtype__, typestore=store)
        for k, ns in enumerate(NS):
            extra = {"seq": k} if is_ros1 else {}
            head = header(stamp=time(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="", **extra)
            message = joints(head, ["a"], np.array([k / 8]), np.array([0.0]), np.array([1.0]))
            writer.write(topic, ns, encode(message, joints.__msgtype__))

    return bag_file(kind, fill)


def csv(stamps):
    return ("t;F;x\n" + "".join(f"{t};1;{k / 8}\n" for k, t in enumerate(stamps))).encode()


def records(stamps):
    """JSON by hand, so that the digits of the stamps are those given."""
    return ("[" + ",".join(f'{{"t": {t}, "F": 1, "x": {k / 8}}}' for k, t in enumerate(stamps)) + "]").encode()


MICRO = [f"{ns // 1000}.{ns % 1000:03d}" for ns in NS]
TEXTS_OF = {9: TEXTS, 3: MICRO}
PLAIN = {"time": "t", "command": "F", "position": "x"}
BAG = {"time": "/j.header.stamp", "command": "/j.effort[0]", "position": "/j.position[0]"}
FILES = {
    "delimited ns": ("delimited", lambda: csv(NS), PLAIN, "ns", 0),
    "delimited us": ("delimited", lambda: csv(MICRO), PLAIN, "us", 3),
    "json ns": ("json", lambda: records(NS), PLAIN, "ns", 0),
    "parquet": ("parquet", lambda: arrow(parquet.write_table), PLAIN, "ns", 0),
    "parquet integers": ("parquet", lambda: arrow(parquet.write_table, STAMPS), PLAIN, "ns", 0),
    "feather": ("feather", lambda: arrow(feather.write_feather), PLAIN, "ns", 0),
    "matlab": ("matlab", matlab, PLAIN, "ns", 0),
    "hdf5": ("hdf5", hdf5, PLAIN, "ns", 0),
    "tdms": ("tdms", tdms, {"time": "/g/t", "command": "/g/F", "position": "/g/x"}, "ns", 0),
    "rosbag 1": ("rosbag", lambda: bag("bag"), BAG, "ns", 0),
    "rosbag 2": ("rosbag", lambda: bag("db3"), BAG, "ns", 0),
    "mcap": ("mcap", lambda: bag("mcap"), BAG, "ns", 0),
}
UNITS = {"command": "N", "position": "m"}


def read(form, data, names, unit, **time) -> Log:
    columns = {key: {"name": names[key], "unit": UNITS[key], "sign": 1} for key in UNITS}
    columns["time"] = {"name": names["time"], "unit": unit} | time
    values = {"name": "lab", "format": form, "files": ["*"], "columns": columns, "step_at": "command edge"}
    values["constants"] = {
        "device": "d", "experiment": "1", "stiffness": 1, "damping": 1, "step": 1, "sampling_period_s": 0.001,
    }  # fmt: skip
    if form == "delimited":
        values |= {"delimiter": ";", "decimal": "."}
    profile = Profile.model_validate(values)
    (outcome,) = reader_of(profile)(profile, [RawLog(("log",), (data,))])
    if isinstance(outcome, Exception):
        raise outcome
    (log,) = outcome
    return log


@pytest.mark.parametrize(
    ("name", "kind"), [*((name, "absolute") for name in FILES), ("delimited us", "counter"), ("parquet", "counter")]
)
def test_differences_of_dates_are_exact_and_the_stamps_are_kept(name, kind):
    form, write, names, unit, decimals = FILES[name]
    log = read(form, write(), names, unit, kind=kind)
    exact(log.time)
    raw = log.raw_time.astype(object) * 10**decimals
    assert raw.tolist() == (NS if not decimals else [float(text) * 10**decimals for text in TEXTS_OF[decimals]])
    assert log.position.tolist() == [k / 8 for k in range(ROWS)]


def test_dates_with_blank_cells_are_right_to_what_a_float_is():
    whole = read("delimited", csv([*NS[:3], "", *NS[3:]]), PLAIN, "ns", blanks="skip")
    np.testing.assert_allclose(whole.time, SECONDS, rtol=0, atol=2.4e-7)
    assert whole.raw_time.tolist() == [float(ns) for ns in NS]


def test_dates_in_seconds_are_right_to_what_a_float_of_them_is():
    for order, stamps in (("file", TEXTS), ("sort", [TEXTS[k] for k in (3, 0, 1, 2, *range(4, ROWS))])):
        log = read("delimited", csv(stamps), PLAIN, "s", order=order)
        np.testing.assert_allclose(log.time, SECONDS, rtol=0, atol=2.4e-7)
        assert log.raw_time.tolist() == SECONDS_AS_FLOATS


def test_dates_in_two_parts_are_exact():
    data = json.dumps([{"s": ns // 10**9, "ns": ns % 10**9, "F": 1, "x": 0} for ns in NS]).encode()
    log = read("json", data, PLAIN | {"time": "s"}, "s", fraction={"name": "ns", "unit": "ns"})
    exact(log.time)
    assert log.raw_time.tolist() == NS


def test_stamps_near_zero_keep_their_origin():
    log = read("delimited", csv(f"{25.372 + k / 1000:.3f}" for k in range(ROWS)), PLAIN, "s")
    assert log.time[0] == 25.372
    uptime = read("delimited", csv(3_000_000_000 + k for k in range(ROWS)), PLAIN, "ms")
    assert uptime.time[0] == 3e6, "an uptime of 35 days"

"""MATLAB logs: version 5 written by scipy, version 7.3 laid out by h5py as MATLAB does."""

import struct
from io import BytesIO

import numpy as np
import pytest
import scipy.io
from foreign_files import hdf5_file, list_columns, matlab5_log, matlab73_log, read_frame, samples
from places import SHARED

from pipeline.base.errors import LogError

DEVICE = SHARED / "real" / "ohara_haptics" / "own_ctrl_pop.mat"


def frame(data, *wanted):
    return read_frame("matlab", "log.mat", data, wanted)


@pytest.mark.parametrize("compressed", [False, True])
def test_every_value_of_version_5_comes_back(compressed):
    time, position, _ = samples()
    expected = {
        "t": time,
        **{f"log.q[{i}]": position[:, i] for i in range(3)},
        **{f"log.by_joint[{i}]": position[:, i] for i in range(3)},
        "log.n": np.arange(40),
        "log.on": (time > 0.01).astype(int),
        "scope.time": time,
        "scope.signals[0].values[1]": position[:, 1],
        "scope.signals[1].values": position[:, 2],
        "pose[2][1]": position[:, 2],
        "single": position[:, 0].astype("f4").astype("f8"),
        "big": np.arange(40, dtype="u8") + np.uint64(2**63),
    }
    read = frame(matlab5_log(compressed), *expected)
    for key, values in expected.items():
        np.testing.assert_array_equal(read.columns[key], values, err_msg=key)
    assert read.columns["big"].dtype == np.uint64
    assert read.attributes["K"] == 3200.0
    assert read.attributes["device"] == "arm ä"
    assert frame(matlab5_log(compressed), "names").columns["names"].tolist() == ["a", "bb"]
    assert frame(matlab5_log(compressed), "lines").columns["lines"].tolist() == ["ab", "cde"]
    assert len(frame(matlab5_log(compressed), "none")) == 0


def test_a_big_endian_file_is_read():
    body = struct.pack(">II", 6, 8) + struct.pack(">II", 6, 0)
    body += struct.pack(">IIii", 5, 8, 3, 1) + struct.pack(">HH", 1, 1) + b"t\0\0\0"
    body += struct.pack(">II3d", 9, 24, 0.5, 1.5, 2.5)
    data = b"MATLAB 5.0".ljust(124) + struct.pack(">H", 0x0100) + b"MI" + struct.pack(">II", 14, len(body)) + body
    assert scipy.io.loadmat(BytesIO(data))["t"].ravel().tolist() == [0.5, 1.5, 2.5]
    assert frame(data, "t").columns["t"].tolist() == [0.5, 1.5, 2.5]


def test_every_value_of_version_73_comes_back():
    time, position, _ = samples()
    expected = {
        "t": time,
        **{f"log.q[{i}]": position[:, i] for i in range(3)},
        "log.n": np.arange(40),
        "signals[0].values": position[:, 0],
        "signals[1].values": position[:, 1],
    }
    data = hdf5_file(matlab73_log, 512)
    read = frame(data, *expected)
    for key, values in expected.items():
        np.testing.assert_array_equal(read.columns[key], values, err_msg=key)
    assert read.attributes["K"] == 3200.0
    assert read.attributes["device"] == "arm"
    assert frame(data, "cell").columns["cell"].tolist() == ["a", "b"]
    assert len(frame(data, "none")) == 0


def test_objects_are_refused_with_how_to_export_them():
    for wanted in ("ts", "ts.Data"):
        with pytest.raises(
            LogError,
            match=r"object of class timeseries.*struct\('time', ts\.Time, 'data', ts\.Data\); save\('log\.mat'",
        ):
            frame(hdf5_file(matlab73_log, 512), "t", wanted)
    hints = {info.name: info.hint for info in list_columns("matlab", "log.mat", hdf5_file(matlab73_log, 512))}
    assert "class timeseries" in hints["ts"]
    assert "#refs#" not in " ".join(hints)


def opaque(name, kind):
    """An object as MATLAB saves it in version 5: its class, and a number that points into a hidden variable."""

    def text(value):
        return struct.pack("<II", 1, len(value)) + value.ljust(-(-len(value) // 8) * 8, b"\0")

    body = struct.pack("<IIII", 6, 8, 17, 0) + text(name) + text(b"MCOS") + text(kind) + struct.pack("<II", 14, 0)
    return struct.pack("<II", 14, len(body)) + body


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("timeseries", "in MATLAB: s = struct('time', ts.Time, 'data', ts.Data); save('log.mat', 's', '-v7')"),
        ("Simulink.SimulationData.Dataset", "in MATLAB for each of its elements: ts = logsout{1}.Values; s = struct("),
        ("Simulink.SimulationOutput", "in MATLAB for each of its elements: ts = out.logsout{1}.Values; s = struct("),
        ("timetable", "in MATLAB: s = table2struct(timetable2table(T), 'ToScalar', true); save("),
        ("lab.Recording", "in MATLAB: s = struct('time', <its times>, 'data', <its values>); save("),
    ],
)
def test_the_hint_is_for_the_class_of_the_object(kind, words):
    """A Dataset was told to export ts.Data and T.Name."""
    data = matlab5_log(False) + opaque(b"run1", kind.encode())
    with pytest.raises(LogError, match=f"'run1' is a MATLAB object of class {kind}") as refusal:
        frame(data, "t", "run1.Data")
    assert words in refusal.value.reason
    assert ("T.Name" in refusal.value.reason) is False
    assert frame(data, "t").columns["t"].tolist() == samples()[0].tolist()


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ("z", "complex numbers"),
        ("log", "no column 'log'.*log.q"),
        ("T", "no column 'T'.*Columns of the file: t, log.q"),
        ("log.q", r"Name one element in columns.*: log.q\[0\] to log.q\[2\]"),
        ("log.q[3]", "Name one element"),
        ("K", "different lengths"),
    ],
)
def test_wrong_names_are_explained(wanted, words):
    with pytest.raises(LogError, match=f"log.mat.*{words}"):
        frame(matlab5_log(True), "t", wanted)


def test_signals_are_listed_with_their_labels():
    infos = {info.name: info for info in list_columns("matlab", "log.mat", matlab5_log(True))}
    assert infos["scope.signals[1].values"].hint == "-F_h"
    assert (infos["log.by_joint[2]"].rows, infos["log.by_joint[2]"].dtype) == (40, "number")
    assert infos["none"].rows == 0


def test_other_files_are_refused():
    with pytest.raises(LogError, match=r"version 4 file must be saved again"):
        frame(bytes(200))
    with pytest.raises(LogError, match="not a MATLAB file; expected version 5 or 7"):
        frame(b"time_s,command\n")


def test_what_a_complex_field_stands_beside_is_read():
    buffer = BytesIO()
    scipy.io.savemat(buffer, {"s": {"z": np.array([1 + 2j, 3]), "t": np.array([0.0, 1.0])}})
    assert frame(buffer.getvalue(), "s.t").columns["s.t"].tolist() == [0.0, 1.0]
    with pytest.raises(LogError, match="complex numbers"):
        frame(buffer.getvalue(), "s.z")


@pytest.mark.skipif(not DEVICE.is_file(), reason="recorded logs in ../shared are not there")
def test_haptic_device_log_equals_scipy():
    with pytest.warns(scipy.io.matlab.MatReadWarning, match="Duplicate variable"):
        raw = scipy.io.loadmat(DEVICE)["scope"][0, 0]
    wanted = ["scope.time", *(f"scope.signals[{i}].values[{j}]" for i in range(3) for j in range(2))]
    data = DEVICE.read_bytes()
    read = frame(data, *wanted)
    assert len(read) == 5810
    assert read.columns["scope.time"].tolist() == raw["time"].ravel().tolist()
    for i in range(3):
        values = raw["signals"][0, i]["values"]
        for j in range(2):
            assert read.columns[f"scope.signals[{i}].values[{j}]"].tolist() == values[:, j].tolist()
    assert read.attributes["J"] == pytest.approx(1 / 631.36, rel=1e-12)
    hints = {info.name: info.hint for info in list_columns("matlab", DEVICE.name, data)}
    assert hints["scope.signals[1].values[0]"] == "Interaction forces (Nm at lever)     -F_h, F_e"
    assert "class tf" in hints["Zm"]

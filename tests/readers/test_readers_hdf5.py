"""HDF5 logs, written by h5py."""

import re

import h5py
import numpy as np
import pytest
from foreign_files import hdf5_file, hdf5_log, list_columns, read_frame, samples

from pipeline.base.errors import LogError


def frame(data, *wanted):
    return read_frame("hdf5", "log.h5", data, wanted)


def test_every_value_comes_back():
    time, position, counter = samples()
    read = frame(hdf5_file(hdf5_log))
    expected = {
        "/arm/t": time,
        **{f"/arm/q[{i}]": position[:, i] for i in range(3)},
        **{f"/arm/by_joint[{i}]": position[:, i] for i in range(3)},
        "/arm/single": position[:, 0].astype("f4").astype("f8"),
        "/counter": counter,
        "/label": np.array(["ä", "b"] * 20),
        "/log.t": time,
        "/log.n": np.arange(40),
        **{f"/log.v[{i}]": position[:, i] for i in range(3)},
    }
    assert set(read.columns) == set(expected)
    for key, values in expected.items():
        np.testing.assert_array_equal(read.columns[key], values, err_msg=key)
    assert read.columns["/counter"].dtype == np.int64
    assert read.attributes == {"device": "arm", "/arm/t@unit": "s", "/stiffness": 3200.0}


def test_the_first_slash_may_be_left_out():
    _, position, _ = samples()
    read = frame(hdf5_file(hdf5_log), "arm/t", "arm/q[1]", "/log.v[0]")
    assert list(read.columns) == ["arm/t", "arm/q[1]", "/log.v[0]"]
    assert read.columns["arm/q[1]"].tolist() == position[:, 1].tolist()


def test_the_longest_axis_is_time():
    def write(file):
        file["t"] = np.arange(9.0)
        file["wide"] = np.arange(63.0).reshape(7, 9)
        file["square"] = np.arange(81.0).reshape(9, 9)
        file["other"] = np.arange(3.0)
        file["pose"] = np.arange(144.0).reshape(9, 4, 4)

    data = hdf5_file(write)
    read = frame(data, "t", "wide[6]", "square[1]", "pose[1][2]")
    assert read.columns["wide[6]"].tolist() == list(range(54, 63))
    assert read.columns["square[1]"].tolist() == list(range(1, 81, 9))
    assert read.columns["pose[1][2]"].tolist() == list(range(6, 144, 16))
    with pytest.raises(LogError, match=r"different lengths .'t': 9, 'other': 3") as error:
        frame(data, "t", "other")
    assert error.value.row == 4
    for wanted in ("wide[7]", "wide"):
        words = rf"no column '{re.escape(wanted)}'. Name one element .* /wide\[0\] to /wide\[6\]"
        with pytest.raises(LogError, match=words):
            frame(data, "t", wanted)


def test_columns_are_listed():
    infos = {info.name: info for info in list_columns("hdf5", "log.h5", hdf5_file(hdf5_log))}
    assert (infos["/arm/t"].dtype, infos["/arm/t"].rows, infos["/arm/t"].hint) == ("number", 40, "s")
    assert infos["/log.n"].first == ("0", "1", "2")
    assert infos["/stiffness"].rows == 1


def test_what_is_no_column_is_refused_with_the_reason():
    def write(file):
        file["t"] = np.arange(3.0)
        file["z"] = np.array([1 + 1j])
        file["nothing"] = h5py.Empty("f8")

    with pytest.raises(LogError, match="'/z' contains complex numbers"):
        frame(hdf5_file(write), "t", "z")
    with pytest.raises(LogError, match="'/nothing' is empty"):
        frame(hdf5_file(write), "nothing")
    with pytest.raises(LogError, match=r"no column 'tt'.*Columns of the file: /t\. Not readable: '/nothing'"):
        frame(hdf5_file(write), "tt")


def test_no_other_file_is_opened(tmp_path):
    with h5py.File(tmp_path / "secret.h5", "w") as other:
        other["key"] = np.arange(3.0)

    def write(file):
        file["t"] = np.arange(3.0)
        file["link"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "/key")
        layout = h5py.VirtualLayout((3,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "key", (3,))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("raw", (3,), "f8", external=str(tmp_path / "secret.h5"))

    data = hdf5_file(write)
    infos = {info.name: info.hint for info in list_columns("hdf5", "log.h5", data)}
    assert list(infos) == ["/t", "/raw", "/virtual"]
    assert "other files" in infos["/raw"]
    with pytest.raises(LogError, match="no column 'link'"):
        frame(data, "link")
    for name in ("virtual", "raw"):
        with pytest.raises(LogError, match="values in other files"):
            frame(data, name)


def test_loops_of_groups_end():
    def write(file):
        file["a/t"] = np.arange(2.0)
        file["a/again"] = file["a"]

    assert list(frame(hdf5_file(write)).columns) == ["/a/t"]

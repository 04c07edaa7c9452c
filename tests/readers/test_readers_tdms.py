"""TDMS logs, written by npTDMS."""

from io import BytesIO

import numpy as np
import pytest
from foreign_files import START, list_columns, read_frame, samples, tdms_log
from nptdms import ChannelObject, TdmsWriter

from pipeline.base.errors import LogError


def frame(data, *wanted):
    return read_frame("tdms", "log.tdms", data, wanted)


def test_every_value_comes_back():
    _, position, _ = samples()
    read = frame(tdms_log())
    expected = {
        "/arm/force": position[:, 0],
        "/arm/count": np.arange(40),
        "/arm/stamp": START + np.arange(40) * 1_001_000,
        "/arm/label": np.array(["ä", "b"] * 20),
    }
    assert list(read.columns) == [*expected, "@time"]
    for key, values in expected.items():
        np.testing.assert_array_equal(read.columns[key], values, err_msg=key)
    assert read.columns["/arm/count"].dtype == np.int64
    assert read.attributes["operator"] == "me"
    assert read.attributes["/arm@K"] == 3200.0
    assert read.attributes["/arm/force@wf_increment"] == 0.001


def test_time_follows_from_the_waveform():
    read = frame(tdms_log(), "@time", "/arm/force", "/arm/count")
    np.testing.assert_array_equal(read.columns["@time"], 0.5 + np.arange(40) * 0.001)
    with pytest.raises(LogError, match=r"'@time' needs one wf_increment.*'/arm/label': None"):
        frame(tdms_log(), "@time", "/arm/force", "/arm/label")


def test_waveforms_that_disagree_have_no_time():
    buffer = BytesIO()
    with TdmsWriter(buffer) as writer:
        channels = [
            ChannelObject("g", name, np.zeros(4), {"wf_increment": dt}) for name, dt in (("a", 0.1), ("b", 0.2))
        ]
        writer.write_segment(channels)
    with pytest.raises(LogError, match=r"found '/g/a': 0\.1, '/g/b': 0\.2"):
        frame(buffer.getvalue(), "@time", "/g/a", "/g/b")
    assert frame(buffer.getvalue(), "@time", "/g/b").columns["@time"].tolist() == [0.0, 0.2, 0.4, 0.2 * 3]


def test_channels_are_listed():
    infos = {info.name: info for info in list_columns("tdms", "log.tdms", tdms_log())}
    assert (infos["/arm/force"].rows, infos["/arm/force"].hint) == (40, "N")
    assert (infos["/arm/label"].dtype, infos["/arm/label"].first) == ("text", ("ä", "b", "ä"))
    assert infos["@time"].first == ("0.5", "0.501", "0.502")


def test_wrong_names_and_files_are_explained():
    with pytest.raises(LogError, match=r"no column '/arm/forse'\. Nearest: /arm/force"):
        frame(tdms_log(), "/arm/forse")
    with pytest.raises(LogError, match="cannot be read as a TDMS file"):
        frame(b"TDSh" + bytes(40))

"""Simulink datasets in MATLAB 7.3 and 5: signals as objects or structs, in buses, with regular or listed times."""

import re
import warnings

import numpy as np
import pytest
from foreign_files import read_frame

from pipeline.base.errors import LogError
from pipeline.profiles.profile_files import read_profile
from pipeline.shell.profile.check import check_samples
from pipeline.shell.profile.draft import draft_profile

matio = pytest.importorskip("matio")

ROWS = 60
TIME = np.arange(ROWS) / 1000
TORQUE = 0.2 * (np.arange(ROWS) >= 10)
ANGLE = 12.5 * np.maximum(TIME - 0.011, 0) ** 2
EMPTY = np.zeros((0, 0))


def opaque(parts, kind):
    from matio.utils.matclass import MatlabOpaque

    return MatlabOpaque(parts, kind)


def number(value):
    return np.array([[float(value)]])


def series(values, unit="", time=None):
    """A timeseries with regular times, or with those that are listed."""
    info = {"Start_": number(0), "Increment_": number(0.001), "Length": number(len(values)), "Units": "seconds"}
    info["Time_"] = EMPTY
    listed = EMPTY if time is None else time[:, None]
    parts = {"Data_": values[:, None], "Time_": listed, "TimeInfo": opaque(info, "tsdata.timemetadata"), "Name": ""}
    if unit:
        parts["DataInfo"] = opaque({"Units": unit}, "tsdata.datametadata")
    return opaque(parts, "timeseries")


def struct(**fields):
    record = np.empty((1, 1), dtype=[(key, "O") for key in fields])
    record[0, 0] = tuple(fields.values())
    return record


def cell(*elements):
    found = np.empty((1, len(elements)), object)
    for i, element in enumerate(elements):
        found[0, i] = element
    return found


def signal(name, values):
    path = opaque({"Path": "rig/Controller", "SubPath": ""}, "Simulink.SimulationData.BlockPath")
    parts = {"Name": name, "PropagatedName": "", "BlockPath": path, "PortType": "outport", "PortIndex": number(1)}
    return opaque(parts | {"Values": values}, "Simulink.SimulationData.Signal")


def dataset(*elements, storage="RamDatasetStorage"):
    parts = {"Version": number(2), "Elements": cell(*elements)}
    inner = opaque(parts, f"Simulink.SimulationData.Storage.{storage}")
    outer = {"Name": "logsout", "Version": number(3), "Storage": inner}
    return opaque(outer, "Simulink.SimulationData.Dataset")


def save(path, version="v7.3", **variables):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matio.save_to_mat(path, variables, version=version)
    return path


def columns_of(path):
    return read_frame("matlab", "log.mat", path.read_bytes())


@pytest.mark.parametrize("version", ["v7.3", "v7"])
def test_signals_of_a_dataset_are_columns_by_their_names(tmp_path, version):
    elements = (signal("torque", series(TORQUE, "Nm")), signal("angle", series(ANGLE, time=TIME)))
    read = columns_of(save(tmp_path / "a.mat", version, logsout=dataset(*elements)))
    assert [*read.columns] == [f"logsout.{name}.{part}" for name in ("torque", "angle") for part in ("Time", "Data")]
    assert read.columns["logsout.torque.Time"] == pytest.approx(TIME)
    assert read.columns["logsout.angle.Time"].tolist() == TIME.tolist()
    assert read.columns["logsout.angle.Data"].tolist() == ANGLE.tolist()
    assert read.hints["logsout.torque.Data"] == "Nm"


def test_a_bus_has_a_column_for_each_of_its_signals(tmp_path):
    bus = struct(cmd=series(TORQUE), meas=struct(q=series(ANGLE)))
    read = columns_of(save(tmp_path / "a.mat", logsout=dataset(signal("joint", bus))))
    assert {name for name in read.columns if name.endswith("Data")} == {
        "logsout.joint.cmd.Data",
        "logsout.joint.meas.q.Data",
    }


def test_elements_without_a_name_or_with_the_same_are_numbered(tmp_path):
    elements = (signal("", series(TORQUE)), signal("q", series(ANGLE)), signal("q", series(2 * ANGLE)))
    read = columns_of(save(tmp_path / "a.mat", logsout=dataset(*elements)))
    assert {name for name in read.columns if name.endswith("Data")} == {
        "logsout[0].Data",
        "logsout.q.Data",
        "logsout[2].Data",
    }
    assert read.columns["logsout[2].Data"].tolist() == (2 * ANGLE).tolist()


def test_elements_that_are_structs_have_their_samples_beside_them(tmp_path):
    def element(name, values, **time):
        leaf = struct(Data=values[:, None], DataUnits="Nm", Name=name, **time)
        return struct(ElementType="signal", Name=name, Values=leaf)

    packed = element("torque", TORQUE, CompressedTime=np.array([[0.0, 0.001, ROWS]]))
    listed = element("angle", ANGLE, Time=TIME[:, None])
    read = columns_of(save(tmp_path / "a.mat", logsout=dataset(packed, listed, storage="MatFileDatasetStorage")))
    assert read.columns["logsout.torque.Time"] == pytest.approx(TIME)
    assert read.columns["logsout.torque.Data"].tolist() == TORQUE.tolist()
    assert read.columns["logsout.angle.Time"].tolist() == TIME.tolist()
    assert read.hints["logsout.torque.Data"] == "Nm"


def test_a_dataset_in_the_output_of_a_simulation_is_found(tmp_path):
    inner = dataset(signal("torque", series(TORQUE)))
    out = opaque({"logsout": inner, "ErrorMessage": ""}, "Simulink.SimulationOutput")
    read = columns_of(save(tmp_path / "a.mat", out=out))
    assert "out.logsout.torque.Data" in read.columns


def test_samples_in_records_of_their_own_are_refused_with_how_to_export_them(tmp_path):
    leaf = struct(DataR2=number(17), CompressedTime=np.array([[0.0, 0.001, ROWS]]))
    element = struct(ElementType="signal", Name="torque", Values=leaf)
    path = save(tmp_path / "a.mat", t=TIME[:, None], logsout=dataset(element, storage="MatFileDatasetStorage"))
    read = columns_of(path)
    assert [*read.columns] == ["t"]
    with pytest.raises(LogError, match=r"class Simulink\.SimulationData\.Dataset.*logsout\{1\}\.Values"):
        read_frame("matlab", "log.mat", path.read_bytes(), ("logsout.torque.Data",))


@pytest.mark.parametrize("version", ["v7.3", "v7"])
def test_a_dataset_asks_one_unit_and_is_read(tmp_path, version):
    elements = (signal("tau", series(TORQUE, "N*m")), signal("phi", series(ANGLE)))
    path = save(tmp_path / "a.mat", version, logsout=dataset(*elements))
    text = draft_profile(path)
    assert text.count("# QUESTION") == 1
    text = re.sub(r'# QUESTION: columns\.position\.unit: .*\n# unit = "rad"', 'unit = "rad"', text)
    (tmp_path / "lab.toml").write_text(text)
    (sample,) = check_samples(read_profile(tmp_path / "lab.toml"), [path])
    found = {column["column"]: column for column in sample["trials"][0]["columns"]}
    assert found["command"]["last"] == pytest.approx(0.2)
    assert found["position"]["last"] == pytest.approx(ANGLE[-1])
    assert found["time"]["last"] == pytest.approx(0.059)

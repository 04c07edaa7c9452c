"""MATLAB logs as labs leave them, through ingest: what is stored is what was put in, or a refusal says how to go on."""

from io import BytesIO

import numpy as np
import pytest
import scipy.io
from foreign_files import hdf5_file, matlab_class

from pipeline.intake.ingest import ingest
from pipeline.store.samples import load_batch
from pipeline.store.storage import read_trials

TIME = 25.372 + np.arange(6) / 1000
FORCE = np.array([0.0, 0.0, -5.0, -5.0, -5.0, -5.0])
ANGLE = np.array([0.0, 0.0, 0.0, 0.5, 1.0, 2.0])

PROFILE = """
name = "lab"
format = "matlab"
files = ["*.mat"]
step_at = "command edge"
attributes = { stiffness = "K" }
columns.time = { name = "NAMES[0]", unit = "s" }
columns.command = { name = "NAMES[1]", unit = "Nm", sign = -1 }
columns.position = { name = "NAMES[2]", unit = "deg", sign = 1 }
[constants]
device = "lever"
experiment = "1"
motion = "rotation"
damping = 0.1
step = 5
sampling_period_s = 0.001
"""


def version_5(contents):
    buffer = BytesIO()
    scipy.io.savemat(buffer, contents | {"K": 20.0})
    return buffer.getvalue()


def version_73(write):
    def fill(file):
        matlab_class(file.create_dataset("K", data=np.array([[20.0]])), "double")
        write(file)

    return hdf5_file(fill, 512)


def readme_only():
    """Columns whose meaning stands in a README alone: one matrix, no name."""
    return version_5({"data": np.column_stack((TIME, FORCE, ANGLE))}), ("data[0]", "data[1]", "data[2]")


def letters():
    return version_5({"a": TIME, "b1": FORCE, "c": ANGLE}), ("a", "b1", "c")


def struct():
    log = {"t": TIME[:, None], "ctrl": {"tau": FORCE}, "q": np.column_stack((np.zeros(6), ANGLE))}
    return version_5({"log": log}), ("log.t", "log.ctrl.tau", "log.q[1]")


def arrays_73():
    def write(file):
        for name, values in (("t", TIME[None, :]), ("tau", FORCE[:, None]), ("q", np.stack((np.zeros(6), ANGLE)))):
            matlab_class(file.create_dataset(name, data=values), "double")

    return version_73(write), ("t", "tau", "q[1]")


def objects_73():
    def write(file):
        matlab_class(file.create_dataset("t", data=TIME[None, :]), "double")
        series = matlab_class(file.create_dataset("ts", data=np.zeros((1, 6), dtype="u4")), "timeseries")
        series.attrs["MATLAB_object_decode"] = np.int32(3)

    return version_73(write), ("t", "ts.Data", "ts.Time")


def zero_length():
    return version_5({"t": np.zeros((0, 0)), "tau": np.zeros((0, 0)), "q": np.zeros((0, 0))}), ("t", "tau", "q")


@pytest.fixture
def lab(tmp_path):
    def run(data, names):
        text = PROFILE
        for index, name in enumerate(names):
            text = text.replace(f"NAMES[{index}]", name)
        (tmp_path / "lab.toml").write_text(text, encoding="utf-8")
        (tmp_path / "run.mat").write_bytes(data)
        return ingest([tmp_path / "run.mat"], tmp_path / "processed", tmp_path / "lab.toml", jobs=1)

    return run


@pytest.mark.parametrize("make", [readme_only, letters, struct, arrays_73])
def test_what_was_saved_is_stored_in_si(make, lab, tmp_path):
    report = lab(*make())
    assert (report.ingested, report.quarantined) == (1, ())
    batch = load_batch(tmp_path / "processed", read_trials(tmp_path / "processed"))
    assert batch.stiffness.tolist() == [20]
    assert batch.time[0].tolist() == TIME.tolist()
    assert batch.command[0].tolist() == (-FORCE).tolist()
    np.testing.assert_allclose(batch.position[0], np.radians(ANGLE), rtol=4e-16)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            objects_73,
            ("'ts' is a MATLAB object of class timeseries", "s = struct('time', ts.Time, 'data', ts.Data); save("),
        ),
        (zero_length, ("run.mat: has 0 samples; expected at least 2",)),
    ],
)
def test_what_holds_no_samples_is_refused(make, words, lab):
    (refusal,) = lab(*make()).quarantined
    for part in words:
        assert part in refusal.reason

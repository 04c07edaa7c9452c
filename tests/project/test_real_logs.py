"""Estimators on logs of real hardware, which nobody simulated; see the notices beside the data."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pyarrow.parquet as pq
import pytest
from labs import compare
from places import SHARED
from scipy.io import loadmat

from pipeline.intake.ingest import ingest
from pipeline.measured.signal.response import declare_edge, find_response
from pipeline.measured.thesis import by_momentum, first_change
from pipeline.records.trials import Trial
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

REAL = SHARED / "real"
pytestmark = pytest.mark.skipif(not REAL.is_dir(), reason="logs of real hardware are not beside the repository")

RUN = "dfki_pendulum/1nm_torque_limited_swingup_failure__data_{}.csv"


def one_trial(time, position, command=None, *, step=1.0, period=None):
    """A log without a wall as a trial."""
    command = np.zeros_like(position) if command is None else command
    period = float(np.median(np.diff(time))) if period is None else period
    return Trial("real", 0.0, 0.0, step, period, time, command, position)


@pytest.fixture(scope="module")
def pendulum():
    """Trial of the pendulum, and its measured torque."""
    desired, measured = (
        np.genfromtxt(REAL / RUN.format(name), delimiter=",", names=True) for name in ("desired", "measured")
    )
    trial = one_trial(measured["time"], measured["position"], desired["torque"], step=0.9, period=5e-3)
    return trial, measured["torque"][None], measured["velocity"]


@pytest.fixture(scope="module")
def servo():
    (path,) = (REAL / "bam_servo").glob("*.json")
    entries = json.loads(path.read_text())["entries"]
    return tuple(np.array([entry[name] for entry in entries]) for name in ("timestamp", "position", "speed"))


@pytest.fixture(scope="module")
def lever():
    """Contents of the file of the 1-DoF haptic device."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the file holds two objects of the same name
        return loadmat(REAL / "ohara_haptics" / "own_ctrl_pop.mat", struct_as_record=False, squeeze_me=True)


def test_delay_of_the_pendulum_is_not_identifiable_without_a_baseline(pendulum):
    trial = pendulum[0]
    response = find_response(trial)
    found = first_change(trial, response)
    assert found.delay_samples == -1
    assert "not identifiable" in found.reason


def test_a_declared_step_row_gives_a_late_first_change(pendulum):
    trial = pendulum[0]
    response = declare_edge(trial, find_response(trial), 0)
    found = first_change(trial, response)
    # friction holds the pendulum, and 10 arc minutes take it long: 0.9 Nm/0.15 kg m^2 move them in 31 ms
    assert trial.time[found.first_row] - trial.time[0] > 0.031


def test_the_balance_of_the_thesis_takes_gravity_and_friction_for_mass(pendulum):
    trial = pendulum[0]
    response = declare_edge(trial, find_response(trial), 0)
    # its window of 15 ms ends before the first movement, and the rows are not T apart
    assert "time steps" in by_momentum(trial, response, 0).reason


def test_quantum_of_the_pendulum_is_10_arc_minutes(pendulum):
    assert find_response(pendulum[0]).sensor_quantum == pytest.approx(np.radians(1 / 6), rel=2e-3)


def test_quantum_of_the_servo_is_that_of_12_bits(servo):
    time, position, _ = servo
    assert find_response(one_trial(time, position)).sensor_quantum == pytest.approx(2 * np.pi / 4096, rel=1e-6)


@pytest.mark.parametrize("column", [0, 1])
@pytest.mark.parametrize(
    "stored", [lambda x: x, lambda x: x.astype(np.float32).astype(float), lambda x: np.round(x, 6)]
)
def test_quantum_of_the_haptic_lever(lever, column, stored):
    scope = lever["scope"]
    position = stored(scope.signals[0].values[:, column])
    found = find_response(one_trial(scope.time, position)).sensor_quantum
    # the file names it; six digits leave half a unit in 21 per change, the mean of thousands far less
    assert found == pytest.approx(lever["posAccuracy"], rel=1e-4)


def test_filtered_columns_have_no_quantum(lever):
    scope = lever["scope"]
    for column in scope.signals[1].values.T:
        assert find_response(one_trial(scope.time, np.ascontiguousarray(column))).sensor_quantum == 0.0


# through the shipped profiles

DEVICES = ("bam_servo", "dfki_pendulum", "ohara_haptics", "tclab")


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """All folders, ingested by the shipped profiles."""
    folder = tmp_path_factory.mktemp("real")
    report = ingest([REAL], folder)
    assert report.quarantined == ()
    # uneven stamps of the servo, few values of the heater: worth a word, and no more
    assert {warning.severity for warning in report.warnings} <= {"note"}
    assert (report.found, report.ingested) == (4, 4)
    return folder


def trial_of(stored, device):
    trials = read_trials(stored, device)
    (row,) = trials.to_pylist()
    (trial,) = load_trials(stored, trials)
    return row, trial


def test_every_folder_is_one_trial(stored):
    assert sorted(read_trials(stored).column("device").to_pylist()) == list(DEVICES)


def test_servo_equals_a_reading_with_the_json_module(stored):
    row, trial = trial_of(stored, "bam_servo")
    (path,) = (REAL / "bam_servo").glob("*.json")
    entries = json.loads(path.read_text())["entries"]
    names = {"time": "timestamp", "command": "goal_position", "position": "position", "velocity": "speed"}
    for column, name in names.items():
        assert getattr(trial, column).tolist() == [entry[name] for entry in entries], column
    extra = json.loads(row["extra"])
    assert extra["stands_for.command"] == "1 rad stands for 1 Nm"
    assert "not a force" in extra["provenance.command"]
    assert (extra["file.mass"], extra["file.motor"]) == ("1.13", "sts3250")
    assert (row["step"], row["motion"]) == (0.0, "rotation")


def test_lever_equals_a_reading_with_scipy(stored, lever):
    row, trial = trial_of(stored, "ohara_haptics")
    scope = lever["scope"]
    assert trial.time.tolist() == scope.time.tolist()
    assert trial.time[0] == 25.372
    position, force, torque = (signal.values[:, 0] for signal in scope.signals)
    # logged with the sign that the labels show
    assert "-F_h, F_e" in scope.signals[1].label
    assert "-tau_rm, tau_rs" in scope.signals[2].label
    assert trial.position.tolist() == position.tolist()
    assert trial.force.tolist() == (-force).tolist()
    assert trial.command.tolist() == (-torque).tolist()
    assert (row["sampling_period_s"], row["step"]) == (lever["Ts"], 0.0)


@pytest.mark.xfail(
    reason="0.209 kg m^2, 0.145 to 0.272: fits of 1, 2, 4 s, with gravity's sine or a spring, give 0.18 to 0.23",
    strict=True,
)
def test_compare_gives_the_inertia_of_the_pendulum(stored, tmp_path):
    outcome = compare("dfki_pendulum", stored, report=tmp_path / "pendulum.html")
    (experiment,) = outcome.result.experiments
    mass = experiment.estimates["mass"]
    # 0.147 kg m^2 for a rod, 0.157 by a full fit: the notes beside the data; 10 % beyond both
    assert 0.9 * 0.147 < mass.value < 1.1 * 0.157
    assert mass.low < 0.157
    assert mass.high > 0.147


@pytest.mark.parametrize(("device", "latest"), [("dfki_pendulum", 16), ("tclab", 18)])
def test_a_first_change_behind_a_coarse_sensor_is_an_upper_bound_of_the_delay(stored, device, latest):
    outcome = compare(device, stored)
    (experiment,) = outcome.result.experiments
    delay = experiment.estimates["delay_samples"]
    assert (delay.low, delay.high) == (0, latest)
    assert not experiment.loop.adequate
    assert experiment.passive is None


def test_mass_of_the_heater_is_not_known_and_no_stop_holds_it(stored):
    (experiment,) = compare("tclab", stored).result.experiments
    assert experiment.estimates["mass"].value is None
    assert "travel_limit" not in experiment.outcomes


@pytest.mark.parametrize("device", [pytest.param("bam_servo", marks=pytest.mark.slow), "ohara_haptics"])
def test_a_log_without_a_step_is_compared_with_reasons_only(stored, device, tmp_path):
    outcome = compare(device, stored, report=tmp_path / "page.html")
    (experiment,) = outcome.result.experiments
    assert experiment.estimates["delay_samples"].value is None
    assert experiment.estimates["mass"].value is None
    assert "no step was commanded" in experiment.estimates["delay_samples"].reason
    folder = stored / "stages" / device
    (outcomes,) = (pq.read_table(path).to_pylist() for path in folder.glob("*/outcome-*.parquet"))
    assert [(row["outcome"], row["evidence"]) for row in outcomes] == [("no_step", "no step was commanded (step is 0)")]
    for stage, column in (("overshoot", "overshoot"), ("settling", "settle_2pct"), ("energy", "energy_w0")):
        (rows,) = (pq.read_table(path).to_pylist() for path in folder.glob(f"*/{stage}-*.parquet"))
        assert [row[column] for row in rows] == [None]
        assert rows[0]["reason"]


def test_a_heater_shows_no_force_beside_its_command(stored):
    (experiment,) = compare("tclab", stored).result.experiments
    assert experiment.outcomes == {"moving": 1}
    # no theory rests on a loop that is not adequate, and the page does not say that one does
    warned = " ".join(compare("tclab", stored).result.warnings)
    assert "has no device file: no theoretical prediction is possible." in warned
    assert "another device" not in warned

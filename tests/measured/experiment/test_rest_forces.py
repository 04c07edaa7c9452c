"""Where settled devices rest, and the costs of a device that a spring holds, by the exact loop with that spring."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from labs import make_lab

import pipeline
from pipeline.comparison.scene.scene import open_scene
from pipeline.device.parts import LoopTable
from pipeline.device_data.devices import load_device
from pipeline.measured.experiment.rest_forces import _spring as spring_by_rests
from pipeline.measured.experiment.rest_forces import rest_forces, rest_spring
from pipeline.measured.stages.stage_tables import ExperimentStages

SPRING = 300.0
LOOP = pipeline.Loop(0.8, 7.0, 0.001, 3, stiffness=SPRING)


def stages(folder, seed, stiffness=0.0, **parts):
    base = load_device("falcon")
    held = {"mass": 0.8, "damping": 7.0, "stiffness": stiffness, "delay_samples": 3, "jitter_samples": ()}
    first = base.experiments[0].model_copy(update=held)
    device = base.model_copy(update={"name": "held", "experiments": (first,), "tables": (), **parts})
    return make_lab(folder, device, ("1",), coarsen=12, seed=seed).stages("1")


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    return stages(tmp_path_factory.mktemp("held"), 4, SPRING)


def test_friction_in_soft_walls_of_one_stiffness_is_no_spring():
    """There the force that friction leaves is the same share of the way; stiff walls tell nothing."""
    stiffness = np.repeat([0.32, 0.64, 0.96, 1.28, 3.2, 12.8], (6, 4, 4, 4, 4, 4))
    moved = 0.01 / stiffness
    reach = stiffness * (6e-5 + 2e-3 * moved)
    friction = np.where(stiffness < 1, -2e-4, 0.0)
    assert (np.abs(friction) > reach).sum() == 14
    assert spring_by_rests(friction, moved, reach) == 0.0
    assert spring_by_rests(-0.02 * moved, moved, reach) == pytest.approx(0.02)


def test_a_spring_is_told_by_where_the_device_rests(held):
    assert rest_forces(held).spring == pytest.approx(SPRING, rel=1e-3)


@pytest.mark.parametrize(
    ("stage", "column", "exact"),
    [
        ("overshoot", "overshoot", "overshoot"),
        pytest.param("settling", "settle_2pct", "settle_2pct_discrete", marks=pytest.mark.slow),
        pytest.param("energy", "energy_w0", "energy_step_w0_discrete", marks=pytest.mark.slow),
    ],
)
def test_costs_of_a_held_device_are_those_about_its_own_rest(held, stage, column, exact):
    truth = LOOP.points(held.column(stage, "stiffness"), held.column(stage, "damping"))[exact].to_numpy(float)
    low, high = (held.column(stage, column + end) for end in ("_low", "_high"))
    both = np.isfinite(low) & np.isfinite(high) & np.isfinite(truth)
    # about x_0 + F_0/K no trial would settle, and each overshoot and energy be far off
    assert both.sum() >= 15
    assert np.mean((low <= truth) & (truth <= high), where=both) >= 0.9


def few(of, **options):
    """The same experiment with two logs behind stable walls, too few to tell a spring from a force by."""
    stiffness = of.trials.column("stiffness").to_numpy()
    some = np.flatnonzero((stiffness >= 4800) & (stiffness <= 7200))[:2]
    return ExperimentStages(of.processed, of.device, of.experiment, of.trials.take(some), **options)


def test_a_declared_spring_is_that_of_the_costs(held, tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.measured.stages.stage_tables.write_result", lambda *_: None)
    told, untold = few(held, spring=SPRING), few(held)
    assert rest_spring(untold) == 0.0
    K, B = (told.column("overshoot", name) for name in ("stiffness", "damping"))
    truth = LOOP.points(K, B)["overshoot"].to_numpy(float)
    low, high = (told.column("overshoot", f"overshoot_{end}") for end in ("low", "high"))
    np.testing.assert_array_equal((low <= truth) & (truth <= high), True)
    assert told.key("settling") != untold.key("settling")
    assert told.key("response") == untold.key("response")


def test_a_comparison_takes_the_spring_of_the_device_file(held, tmp_path, monkeypatch):
    (tmp_path / "held.toml").write_text(
        """
name = "held"
title = "held by a spring"
source = "made up"
motion = "translation"
sampling_period_s = 0.001
step = 8.0
duration_s = 1.0
baseline_s = 0.02
sensor = { quantum = 2e-6, noise = 5e-7 }
limits = { travel = 0.05 }
[[experiment]]
name = "1"
mass = 0.8
damping = 7.0
stiffness = 250.0
delay_samples = 3
damping_last = 100.0
damping_step = 10.0
stiffness_step = 100.0
[experiment.loop]
operator = { mass = 0.1, damping = 1.0, stiffness = 50.0 }
"""
    )
    monkeypatch.setenv("PIPELINE_DEVICES", str(tmp_path))
    (stages,) = open_scene("held", held.processed, None, None).experiments
    assert rest_spring(stages) == SPRING
    assert open_scene("held", held.processed, None, None).device is not None
    monkeypatch.delenv("PIPELINE_DEVICES")
    (stages,) = open_scene("held", held.processed, None, None).experiments
    assert stages.spring == 0.0


def test_friction_is_no_spring(tmp_path):
    rest = rest_forces(stages(tmp_path, 6, loop=LoopTable.model_validate({"friction": {"coulomb": 0.3}})))
    assert rest.is_reliable
    assert rest.spring == 0.0


class Settled:
    """Logs that have settled at x_0 + (F_0 + force)/(K + spring), as stored."""

    sampling_period_s = 1e-3

    def __init__(self, stiffness, spring=0.0, force=0.0):
        n = len(stiffness)
        self.verdicts = SimpleNamespace(verdict=np.full(n, "stable"))
        self.trials = pa.table({"trial_id": [str(i) for i in range(n)], "rows": [400] * n})
        self.columns = {
            "stiffness": stiffness,
            "position_start": np.zeros(n),
            "position_final_expected": 8.0 / stiffness,
            "position_final_measured": (8.0 + force) / (stiffness + spring),
            "growth_per_s": np.full(n, -50.0),
            "sensor_quantum": np.full(n, 1e-6),
            "sensor_noise": np.zeros(n),
        }

    def column(self, stage, name):
        return self.columns[name]

    def texts(self, stage, name):
        return self.trials.column(name).to_pylist()


@pytest.mark.parametrize(
    ("stiffness", "options", "spring"),
    [
        ([500.0, 1000.0, 2000.0, 4000.0, 8000.0], {"spring": 120.0}, 120.0),
        ([500.0, 1000.0, 2000.0, 4000.0, 8000.0], {"force": -0.5}, 0.0),
        ([500.0, 1000.0, 2000.0, 4000.0, 8000.0], {"spring": 120.0, "force": -0.5}, 0.0),
        ([1000.0] * 5, {"spring": 120.0}, 0.0),  # one wall tells no spring from a force
    ],
)
def test_a_spring_alone_is_told_from_a_constant_force(stiffness, options, spring):
    rest = rest_forces(Settled(np.array(stiffness), **options))
    assert rest.is_reliable
    assert rest.spring == pytest.approx(spring, rel=1e-9)


@pytest.mark.parametrize(
    ("forces", "quantum", "off", "reliable", "constant"),
    [
        ([0.28] * 5, 1e-4, 0, False, False),  # three quanta are 0.3 mm
        ([0.35] * 5, 1e-4, 5, True, True),
        ([0.5] * 4 + [0.0] * 16, 1e-6, 4, False, True),
        ([0.5] * 5 + [0.0] * 15, 1e-6, 5, True, True),
        ([0.5] * 2 + [0.0] * 2, 1e-6, 2, False, True),
        ([1.0, 1.0, 1.4], 1e-6, 3, True, True),
        ([1.0, 1.0, 1.6], 1e-6, 3, True, False),
    ],
)
def test_a_force_is_told_beyond_the_sensor_in_many_logs_and_one_where_they_are_alike(
    forces, quantum, off, reliable, constant
):
    logs = Settled(np.full(len(forces), 1000.0), force=np.array(forces))
    logs.columns["sensor_quantum"] = np.full(len(forces), quantum)
    rest = rest_forces(logs)
    assert (rest.off, rest.is_reliable, rest.constant) == (off, reliable, constant)

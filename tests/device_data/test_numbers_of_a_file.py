"""Numbers of device files: whole ones wherever a number is meant, delays that jitter, and sizes without sense."""

from __future__ import annotations

import json
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from pipeline import PipelineError
from pipeline.base.errors import DeviceError
from pipeline.device_data.devices import load_device, read_device
from pipeline.records.models import Device
from pipeline.rig.design import design
from pipeline.service.theory import document as rest
from pipeline.simulation.setup import setup_of
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.surface.physical_loop import Loop
from pipeline.theory.cases import best_wall, case_of, costs_of_walls, limits_of_walls

FOUR = {"mass": 1.0, "damping": 3.0, "sampling_period_s": 0.001, "delay_samples": 2.0}
NUMBERS: dict[str, Any] = {
    "mass": 2,
    "damping": 3,
    "stiffness": 4,
    "delay_samples": 2,
    "sampling_period_s": 1,
    "step": 8,
    "centre": 1,
    "duration_s": 500,
    "baseline_s": 20,
    "damping_first": 0,
    "damping_last": 9,
    "damping_step": 1,
    "stiffness_step": 1,
    "sensor.quantum": 1,
    "sensor.noise": 1,
    "limits.travel": 9,
    "limits.force": 9,
    "loop.actuator_lag_s": 1,
    "loop.force_gain": 2,
    "loop.operator.mass": 1,
    "loop.operator.damping": 2,
    "loop.operator.stiffness": 3,
    "loop.mode.frequency_hz": 1,
    "loop.mode.damping_ratio": 1,
    "loop.mode.mass": 1,
    "loop.mode.load_damping": 1,
    "loop.friction.coulomb": 1,
    "loop.friction.stiction": 2,
    "loop.friction.stribeck_velocity": 1,
    "simulation.constant_force": 1,
}
"""Every key that means a number, with a whole one."""


def written(folder: Path, *texts: str, **values: object) -> Path:
    path = folder / "arm.toml"
    path.write_text("\n".join([f"{name} = {value}" for name, value in {**FOUR, **values}.items()] + [*texts]))
    return path


def table(key: str, value: object) -> tuple[str, ...]:
    """Return the lines of a key in a table, with what its table needs beside it."""
    beside = {
        "operator": {"mass": 1},
        "friction": {"coulomb": 1},
        "mode": {"frequency_hz": 1, "damping_ratio": 1, "mass": 0.5},
    }
    *tables, name = key.split(".")
    other = {n: v for n, v in beside.get(tables[-1], {}).items() if n != name}
    return f"[{'.'.join(tables)}]", f"{name} = {value}", *(f"{n} = {v}" for n, v in other.items())


def with_key(folder: Path, key: str, value: object) -> Path:
    if "." not in key:
        return written(folder, **({"duration_s": 500} if key == "baseline_s" else {}) | {key: value})
    return written(folder, *table(key, value), **({"mass": 2.0} if key.startswith("loop.mode") else {}))


@pytest.mark.parametrize("key", NUMBERS)
def test_a_whole_number_is_a_number(tmp_path: Path, key: str) -> None:
    whole, point = (read_device(with_key(tmp_path, key, kind(NUMBERS[key]))) for kind in (int, float))
    assert whole == point


@pytest.mark.parametrize("period", [1, 2, 10])
def test_an_integer_period_needs_no_more_keys(tmp_path: Path, period: int) -> None:
    device = read_device(written(tmp_path, sampling_period_s=period))
    assert (device.duration_s, device.baseline_s) == (1000.0 * period, 20.0 * period)
    case = case_of(device, device.experiments[0])
    other = read_device(written(tmp_path, sampling_period_s=float(period)))
    assert limits_of_walls(case, 20).to_json() == limits_of_walls(case_of(other, other.experiments[0]), 20).to_json()


ABSURD = ("1e-300", "1e300", "5e-324", "-1e300", f"1{'0' * 400}", "1e-31", "1e31")


@pytest.mark.parametrize("key", NUMBERS)
def test_absurd_sizes_are_refused_by_name(tmp_path: Path, key: str) -> None:
    for value in ABSURD:
        with pytest.raises(DeviceError) as refused:
            read_device(with_key(tmp_path, key, value))
        assert f"{key.split('.')[-1]}" in str(refused.value)
        assert "1 field(s) to correct" in str(refused.value)


@pytest.mark.parametrize("value", ["1e-30", "1e-12", "1e-6", "1e6", "1e12", "1e30"])
@pytest.mark.parametrize("key", ["sampling_period_s", "mass", "damping", "loop.force_gain", "loop.operator.stiffness"])
def test_sizes_at_the_end_are_an_answer_or_an_error(tmp_path: Path, key: str, value: str) -> None:
    device = read_device(with_key(tmp_path, key, value))
    with warnings.catch_warnings(), suppress(PipelineError):
        warnings.simplefilter("error")
        case = case_of(device, device.experiments[0])
        found = (
            limits_of_walls(case, 12).to_json()["stiffness_max"],
            best_wall(case, "pole_radius").to_json()["stiffness"],
        )
        json.dumps(found, allow_nan=False)


def test_a_wall_too_large_for_a_number_is_refused(tmp_path: Path) -> None:
    import numpy as np

    device = read_device(written(tmp_path))
    with pytest.raises(PipelineError, match="stiffness: expected at most"):
        costs_of_walls(case_of(device, device.experiments[0]), np.array([[1e300, 1.0]])).to_json()


def test_a_trial_of_too_many_rows_is_refused(tmp_path: Path) -> None:
    device = read_device(written(tmp_path, duration_s=1e9, baseline_s=1))
    with pytest.raises(PipelineError, match=r"duration_s = 1e\+09 has 1e\+12 sampling periods"):
        setup_of(device, device.experiments[0])


JITTERS = ([6, 7, 8], [1, 4], [3, 4, 4, 5], [0, 1])


@pytest.fixture(params=JITTERS, ids=str)
def jittering(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    drawn: list[int] = request.param
    return written(tmp_path, "[loop.friction]", "coulomb = 0.1", delay_samples=drawn[0], jitter_samples=drawn)


def mean_of(device: Device) -> float:
    (experiment,) = device.experiments
    return sum(experiment.jitter_samples) / len(experiment.jitter_samples)


def test_theory_takes_the_mean_of_a_delay_that_jitters(jittering: Path) -> None:
    device = read_device(jittering)
    case, loop = case_of(device, device.experiments[0]), Loop.of(device.loop_for(device.experiments[0]))
    mean = mean_of(device)
    assert case.loop.delay == loop.delay_samples == mean == setup_of(device, device.experiments[0]).mean_delay_samples
    assert loop.left_out == ("friction", "jitter")
    assert loop.boundary(20).attrs["left_out"] == ["friction", "jitter"]
    found = limits_of_walls(case, 40).to_json()
    drawn = device.experiments[0].jitter_samples
    assert (found["delay_samples"], found["delay_samples_low"], found["delay_samples_high"]) == (
        mean,
        min(drawn),
        max(drawn),
    )
    assert found["stiffness_max"] == pytest.approx(loop.boundary(40).attrs["stiffness_max"])


def test_every_surface_names_jitter(jittering: Path, call, monkeypatch: pytest.MonkeyPatch) -> None:
    walls = jittering.with_name("walls.csv")
    walls.write_text("stiffness,damping\n500,5\n")
    of = ("--device", jittering)
    commands = {
        "boundary": ("theory", "boundary", *of),
        "points": ("theory", "points", walls, *of),
        "optimum": ("theory", "optimum", "--criterion", "pole_radius", *of),
        "design": ("design", *of, "--stiffness", "500"),
    }
    for name, command in commands.items():
        status, text, _ = call(*command)
        assert status == 0, name
        assert "not included in linear theory: friction, jitter" in text.lower()
        assert "jitters from" in text
        shown = json.loads(call(*command, "--json")[1])
        assert (shown[0] if name == "points" else shown)["left_out"] == ["friction", "jitter"]
    monkeypatch.setenv("PIPELINE_DEVICES", str(jittering.parent))
    for what, *more in (("boundary",), ("optimum", "pole_radius", None), ("points", [[500.0, 5.0]])):
        shown = rest(what, ("arm", None), *more)
        assert (shown[0] if what == "points" else shown)["left_out"] == ["friction", "jitter"]
    device = read_device(jittering)
    answer = design(Loop.of(device.loop_for(device.experiments[0])), 500.0)
    assert answer.document()["wish"]["stiffness"] == 500.0


@pytest.mark.parametrize(("stated", "drawn"), [(1, [6, 7, 8]), (9, [6, 7, 8]), (2.9, [3, 4]), (0, [1])])
def test_a_delay_outside_of_its_jitter_is_refused(tmp_path: Path, stated: float, drawn: list[int]) -> None:
    with pytest.raises(DeviceError, match=rf"delay_samples \({stated:g}\) is outside the range of jitter_samples"):
        read_device(written(tmp_path, delay_samples=stated, jitter_samples=drawn))


def test_one_delay_is_no_jitter(tmp_path: Path) -> None:
    for path in (written(tmp_path, jitter_samples=[2, 2]), written(tmp_path)):
        device = read_device(path)
        assert device.loop_for(device.experiments[0]).left_out == ()
        assert case_of(device, device.experiments[0]).loop.delay == 2


def test_shipped_delays_are_the_mean_of_their_jitter() -> None:
    for name in ("falcon", "falcon-real"):
        for experiment in load_device(name).experiments:
            assert experiment.delay_samples == pytest.approx(
                sum(experiment.jitter_samples) / len(experiment.jitter_samples)
            )


def test_the_truth_of_a_simulation_has_the_same_delay(jittering: Path) -> None:
    device = read_device(jittering)
    write_sweep(run_sweep(device, "1", coarsen=8, duration_s=0.1), jittering.parent / "logs")
    truth = json.loads((jittering.parent / "logs" / "arm" / "1" / "truth.json").read_text())
    drawn = device.experiments[0].jitter_samples
    told = [truth[f"delay_samples{end}"] for end in ("", "_low", "_high")]
    assert told == [mean_of(device), min(drawn), max(drawn)]

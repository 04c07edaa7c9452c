"""The velocity filter of recorded walls and the jitter of the delay: from logs to document, device file and loop."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from typer.testing import CliRunner

import pipeline
from pipeline.device.loop import Loop
from pipeline.device.parameters import MOTIONS
from pipeline.device_data.devices import read_device
from pipeline.readers import Log
from pipeline.records.native import NativeHeader, format_header
from pipeline.shell.cli import application
from pipeline.simulation.setup import Setup
from pipeline.simulation.simulate import applied_delay_moments, simulate
from pipeline.surface import wall_filter as walls
from pipeline.surface.identify import device_text, measured_trial, wall_loop

IDEAL = Loop(0.5, 3.0, 1e-3, 2.0)
DIFFERENCE = {"kind": "difference", "samples": 4}
BUTTERWORTH = {"kind": "butterworth", "order": 2, "cutoff_hz": 80.0}
COEFFICIENTS = {"kind": "coefficients", "b": (0.3, 0.1), "a": (1.0, -0.6)}
FOAW = {"kind": "foaw", "bound": 2e-5, "longest": 8}
STIFFNESS, DAMPING = (300.0, 500.0, 700.0, 900.0), (5.0, 8.0, 11.0, 14.0)


def logs(stiffness=STIFFNESS, damping=DAMPING, **parts):
    """Logs of walls of a loop, an exact step each."""
    loop = replace(IDEAL, **parts)
    trials = simulate(Setup(loop, 4.0, 400, edge_row=20), np.array(stiffness), np.array(damping))
    return [
        Log(
            NativeHeader("arm", "1", float(K), float(B), 4.0, loop.sampling_period_s, motion=loop.motion),
            *(trial.time, trial.command, trial.position),
        )
        for K, B, trial in zip(stiffness, damping, trials, strict=True)
    ]


def wall_filter(recorded):
    """The filter that logs show."""
    return walls.wall_filter([measured_trial(str(number), log) for number, log in enumerate(recorded)])


def files(folder, recorded):
    """The same logs as native files."""
    for i, log in enumerate(recorded):
        rows = zip(log.time.tolist(), log.command.tolist(), log.position.tolist(), strict=True)
        lines = "\n".join(",".join(map(repr, row)) for row in rows)
        (folder / f"{i}.csv").write_text(f"{format_header(log.header)}{lines}\n", encoding="utf-8")
    return folder


@pytest.mark.parametrize("motion", ["translation", "rotation in V"])
@pytest.mark.parametrize("velocity", [DIFFERENCE, BUTTERWORTH, COEFFICIENTS])
def test_the_filter_of_walls_is_that_of_their_controller(velocity, motion):
    shown = wall_filter(logs(motion=motion, velocity=velocity))
    truth = replace(IDEAL, velocity=velocity).velocity
    assert type(shown.velocity) is type(truth)
    for name, value in truth:
        assert getattr(shown.velocity, name) == (value if isinstance(value, str) else pytest.approx(value, rel=1e-6))
    assert "(4 of 4 logs)" in shown.sentence
    assert not shown.left_out


def test_walls_of_a_plain_difference_and_logs_without_walls_have_no_filter():
    plain = wall_filter(logs())
    assert (plain.velocity, plain.left_out) == (None, False)
    assert "difference quotient (4 of 4 logs)" in plain.sentence
    assert wall_filter(logs(stiffness=(0.0, 0.0), damping=(1.0, 2.0))) is None


@pytest.mark.parametrize(
    ("recorded", "why", "left_out"),
    [
        (logs(velocity=FOAW), "window that adapts to the motion", True),
        (logs(velocity={"kind": "levant", "acceleration": 50.0}), "deviates from the wall law", True),
        (logs()[:1] + logs(velocity=DIFFERENCE)[:2] + logs(velocity=BUTTERWORTH)[:2], "the logs show different", True),
        (logs(damping=(0.0,) * 4), "damping of 0", False),
        ([replace(log, header=replace(log.header, stiffness=2e3)) for log in logs()], "a wall that differs", False),
        ([replace(log, header=replace(log.header, step=0.0)) for log in logs()], "no log has a step", False),
    ],
)
def test_a_filter_that_is_not_known_is_named_with_the_reason(recorded, why, left_out):
    shown = wall_filter(recorded)
    assert (shown.velocity, shown.left_out) == (None, left_out)
    assert why in shown.sentence
    assert "is unknown" in shown.sentence
    assert "boundary is valid for the difference quotient" in shown.sentence


def test_a_filter_at_another_period_is_assumed_the_same_or_not_known():
    shown = wall_filter(logs(velocity=BUTTERWORTH))
    assert shown.at(1e-3, 1e-3) is shown
    assert "assumed to be the same at T = 0.002 s" in shown.at(1e-3, 2e-3).sentence
    slow = shown.at(1e-3, 1e-2)
    assert (slow.velocity, slow.left_out) == (None, True)


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    recorded = logs(velocity=BUTTERWORTH, delay_samples=2.4, motion="rotation")
    return pipeline.identify(files(tmp_path_factory.mktemp("filtered"), recorded))


def test_a_filter_is_in_the_loop_the_boundary_and_the_device_file(identified, tmp_path):
    document = identified.document
    assert document["loop"]["velocity"]["cutoff_hz"]["value"] == pytest.approx(80.0)
    assert document["left_out"] == []
    assert identified.loop.velocity.cutoff_hz == pytest.approx(80.0)
    identified.write(tmp_path / "arm.toml")
    device = read_device(tmp_path / "arm.toml")
    loop = device.loop_for(device.experiments[0])
    assert loop.velocity == identified.loop.velocity
    top = pipeline.Loop.of(loop).boundary().attrs["stiffness_max"]
    assert top == pytest.approx(document["boundary"]["stiffness_max"]["value"], rel=1e-6)
    truth = replace(IDEAL, velocity=BUTTERWORTH, delay_samples=2.4, motion="rotation")
    assert top == pytest.approx(pipeline.Loop.of(truth).boundary().attrs["stiffness_max"], rel=0.02)


@pytest.mark.parametrize(
    ("motion", "velocity", "drawn"),
    [
        *((motion, BUTTERWORTH, ()) for motion in MOTIONS),
        *product(["rotation"], [None, DIFFERENCE, COEFFICIENTS], [(), (2, 3, 4)]),
    ],
)
def test_a_device_file_is_the_loop_of_its_document(identified, tmp_path, motion, velocity, drawn):
    shown = wall_filter(logs(velocity=velocity)) if velocity else None
    numbers = {f"{side}{i}": value for side in "ba" for i, value in enumerate(velocity[side])} if (
        velocity is COEFFICIENTS
    ) else {key: value for key, value in (velocity or {}).items() if key != "kind"}  # fmt: skip
    loop = identified.document["loop"] | {"velocity": {k: {"value": float(v)} for k, v in numbers.items()} or None}
    age, deviation = applied_delay_moments(drawn) if drawn else (2.4, 0.0)
    loop["delay_samples"] = {"value": age, "low": age - 0.01, "high": age + 0.01}
    loop["jitter_samples"] = {"value": deviation, "low": deviation - 0.01, "high": deviation + 0.01} if drawn else None
    document = identified.document | {
        "motion": motion,
        "loop": loop,
        "velocity_filter": shown.sentence if shown else None,
        "left_out": ["jitter"] if drawn else [],
        "wall": identified.document["wall"] | {"jitter_samples": list(drawn)},
    }
    (tmp_path / "arm.toml").write_text(device_text(document, "arm"), encoding="utf-8")
    device = read_device(tmp_path / "arm.toml")
    of_file, of_document = device.loop_for(device.experiments[0]), wall_loop(document)
    assert replace(of_file, sensor=of_document.sensor) == of_document
    assert of_file.delay_samples == pytest.approx(3.0 if drawn else 2.4)
    assert of_file.left_out == tuple(document["left_out"])


@pytest.mark.slow
def test_a_delay_that_jitters_is_named_and_drawn_in_the_device_file(tmp_path):
    walls = {"stiffness": STIFFNESS * 3, "damping": tuple(B + 3 for B in DAMPING) * 3}
    folder = files(tmp_path, logs(**walls, delay_samples=3.0, jitter_samples=(2, 3, 4)))
    out = tmp_path / "arm.toml"
    result = CliRunner().invoke(application("identify"), ["identify", str(folder), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "The delay jitters with a standard deviation of 0.7" in result.output
    assert "not included in linear theory: jitter" in result.output
    device = read_device(out)
    assert device.experiments[0].jitter_samples == (2, 3, 4)
    other = pipeline.identify(folder, delay=5.0)
    assert other.document["left_out"] == ["jitter"]
    other.write(out)
    assert read_device(out).experiments[0].jitter_samples == ()
    assert "# The delay jitters, standard deviation" in out.read_text(encoding="utf-8")

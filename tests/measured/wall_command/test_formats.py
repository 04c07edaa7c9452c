"""Courses as loggers write them: no cause by digits, stamps and readings alone, and each real one as what it is."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from logged import FORMATS, RIGS, lab, repeated, scattered, thinned, with_rows, written
from scipy import signal

from pipeline.measured.signal.response import find_response
from pipeline.measured.wall_command.wall_law import wall_law
from pipeline.records.trials import Trials

FEW = 3
"""Logs below which nothing is concluded of a course."""

FAST = [("falcon", "%.6g"), ("motor", "%.9g"), ("motor", "float32"), ("robot", "%.9f"), ("robot", "degrees")]
ALL = [(rig, text) for rig in RIGS for text in FORMATS]


def named(trials):
    """How many logs show each departure."""
    laws = (wall_law(trial, find_response(trial)) for trial in trials)
    return Counter(departure.code for law in laws for departure in law.departures)


def butterworth(order):
    return {"ba": signal.butter(order, 40, fs=1000)}


def cases(fast, slow):
    return [*fast, *(pytest.param(*case, marks=pytest.mark.slow) for case in slow if case not in fast)]


@pytest.mark.parametrize(("rig", "text"), cases(FAST, ALL))
@pytest.mark.parametrize(
    "trials", [25, pytest.param(8, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.slow)]
)
def test_digits_are_no_departure(rig, text, trials):
    found = named(written(lab(RIGS[rig], trials, seed=501), text))
    assert {code: logs for code, logs in found.items() if logs >= FEW} == {}


SENSORS = {"decimal": 2e-6, "binary": 2.0**-18, "coarse": 2e-5, "ideal": 0.0}


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize(("rig", "text"), cases([("falcon", "%.6g"), ("motor", "%.10g")], ALL))
def test_digits_of_any_sensor_are_no_departure(rig, text, sensor):
    found = named(written(lab(replace(RIGS[rig], quantum=SENSORS[sensor]), 16, seed=502), text))
    assert {code: logs for code, logs in found.items() if logs >= FEW} == {}


REAL = {
    "butterworth 1": (butterworth(1), "velocity_filter"),
    "butterworth 2": (butterworth(2), "velocity_filter"),
    "difference": ({"samples": 4}, "velocity_filter"),
    "position filter": ({"seen": signal.butter(1, 60, fs=1000)}, "position_filter"),
    "mean position": ({"seen": (np.full(3, 1 / 3), [1.0])}, "position_filter"),
    "clipped": ({"clip": 0.7}, "saturation"),
    "late": ({"late": 1}, "command_shifted"),
    "ramp": ({"ramp": 6}, "step_not_a_step"),
    "held": ({"slow": 2}, "repeated_rows"),
}
SHAPES = ["%.17g", "%.9g", "%.6g", "float32"]


@pytest.mark.parametrize(
    ("rig", "what", "text"),
    cases(
        [("falcon", "butterworth 2", "%.6g"), ("motor", "difference", "%.9g"), ("robot", "late", "%.6g"),
         ("motor", "late", "%.17g"), ("robot", "clipped", "float32"), ("falcon", "held", "%.17g"),
         ("falcon", "position filter", "%.17g"), ("motor", "mean position", "%.9g")],
        [(rig, what, text) for rig in RIGS for what in REAL for text in SHAPES],
    ),
)  # fmt: skip
def test_what_a_controller_does_is_found_in_few_digits_too(rig, what, text):
    options, code = REAL[what]
    if "clip" in options:
        options = {"clip": options["clip"] * RIGS[rig].step}
    found = named(written(lab(RIGS[rig], 16, seed=503, **options), text))
    # in six digits a filter of the position looks like one of the velocity in some logs
    either = what == "position filter" and text == "%.6g"
    assert found[code] >= (8 if what == "held" or either else 13), found
    if either:
        assert found[code] > found.pop("velocity_filter", 0)
    assert {other: logs for other, logs in found.items() if other not in (code, "unknown") and logs >= FEW} == {}


ROWS = {
    "gaps": (lambda trials: thinned(trials, 0.02, 5), "missing_rows"),
    "hidden gaps": (lambda trials: thinned(trials, 0.02, 5, shown=False), "missing_rows"),
    "gaps among scattered stamps": (lambda trials: scattered(thinned(trials, 0.02, 5), seed=5), "missing_rows"),
    "repeated": (lambda trials: repeated(trials, 0.03, 5), "repeated_rows"),
    "scattered stamps": (lambda trials: scattered(trials, seed=5), "scattered_stamps"),
    "halved period": (lambda t: replace(t, sampling_period_s=t.sampling_period_s / 2), "sampling_period"),
}


@pytest.mark.parametrize("rig", ["falcon", *(pytest.param(r, marks=pytest.mark.slow) for r in ("motor", "robot"))])
@pytest.mark.parametrize("what", ROWS)
def test_what_a_logger_does_is_named(rig, what):
    change, code = ROWS[what]
    found = named(change(lab(RIGS[rig], 25, seed=504)))
    assert found[code] >= 18, found
    assert {other: logs for other, logs in found.items() if other != code and logs >= FEW} == {}


@pytest.mark.parametrize("rig", RIGS)
def test_a_command_in_counts_of_a_converter_is_no_departure(rig):
    trials, step = lab(RIGS[rig], 25, seed=508), RIGS[rig].step / 700
    counted = replace(trials, command=step * np.rint(trials.command / step))
    assert named(counted) == {}
    assert named(thinned(counted, 0.02, 5))["missing_rows"] >= 18


@pytest.mark.parametrize("every", [2, 5])
@pytest.mark.parametrize("header", ["of rows", "of the loop"])
@pytest.mark.parametrize("rig", ["falcon", *(pytest.param(r, marks=pytest.mark.slow) for r in ("motor", "robot"))])
def test_a_logger_that_is_slower_than_the_loop_is_named(rig, header, every):
    trials = Trials.of(with_rows(trial, slice(None, None, every)) for trial in lab(RIGS[rig], 25, seed=507))
    period = trials.sampling_period_s * (every if header == "of rows" else 1)
    found = named(replace(trials, sampling_period_s=period))
    assert found["decimated_rows"] >= 18
    assert set(found) <= {"decimated_rows", "sampling_period", "unknown"}


@pytest.mark.parametrize("rig", ["falcon", *(pytest.param(r, marks=pytest.mark.slow) for r in ("motor", "robot"))])
def test_an_adaptive_window_is_named_and_a_position_loop_is_not(rig):
    device = RIGS[rig]
    coarse = replace(device, quantum=10 * device.quantum)
    adaptive = lab(coarse, 16, seed=505, window=15, band=coarse.quantum)
    assert named(adaptive) == {"adaptive_velocity": 16}
    assert named(written(adaptive, "%.6g"))["adaptive_velocity"] >= 12
    setpoint = device.step / float(sorted(adaptive.stiffness)[8])
    error = lab(device, 16, seed=505, error_of=setpoint)
    for sign in (1, -1):
        assert set(named(replace(error, position=sign * error.position))) <= {"unknown"}


@pytest.mark.parametrize("rig", ["falcon", *(pytest.param(r, marks=pytest.mark.slow) for r in ("motor", "robot"))])
def test_a_limited_rate_is_named_where_it_shows(rig):
    found = named(lab(RIGS[rig], 16, seed=506, slew=0.12 * RIGS[rig].step))
    assert found["rate_limit"] >= FEW
    assert set(found) <= {"rate_limit", "step_not_a_step", "unknown"}

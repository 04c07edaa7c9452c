"""Kinds of devices that are not ideal, each a variation of a base device whose truth is known.

A kind is a table of the keys of a device file with what they may be, and perhaps a course that a lab would have cut
short. A seed perturbs the base device and draws from the ranges, so that statements can be held against many truths.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from pipeline.records.models import Device
from pipeline.simulation.sweep import SimulatedSweep, run_sweep

Draw = Callable[[np.random.Generator, Device], Any]
Keep = Literal["all", "stable", "unstable", "few"]

FEW = 6
"""Trials of a course that was broken off."""

SPREAD = 0.3
"""Largest change of the base device's mass and damping by a seed, relative to them."""


@dataclass(frozen=True)
class Kind:
    """What a kind changes of the base device, by keys of the device file such as ``loop.friction.coulomb``.

    ``causes`` are the codes of what sets it apart, as in the JSON of a comparison.
    """

    keys: Mapping[str, Draw] = field(default_factory=dict)
    causes: tuple[str, ...] = ()
    keep: Keep = "all"


@dataclass(frozen=True)
class Case:
    """One device of a kind.

    Parameters
    ----------
    device : Device
        The true device, with one experiment.
    stated : Device
        What a lab would write of it: mass, damping and delay, nothing of what the kind adds.
    options : dict
        Keyword arguments of `pipeline.simulation.sweep.run_sweep`.
    keep : {"all", "stable", "unstable", "few"}
        Which of the course's trials the lab has.
    truth : dict
        Drawn values by key, and ``causes``.
    """

    device: Device
    stated: Device
    options: dict[str, Any]
    keep: Keep
    truth: dict[str, Any]


def uniform(low: float, high: float) -> Draw:
    """Return a draw between two numbers."""
    return lambda random, _: float(random.uniform(low, high))


def either(*values: Any) -> Draw:
    """Return a draw of one of some values."""
    return lambda random, _: values[int(random.integers(len(values)))]


def of_step(low: float, high: float) -> Draw:
    """Return a draw of a force between two shares of the step F_0."""
    return lambda random, device: float(device.step * random.uniform(low, high))


def of_mass(low: float, high: float) -> Draw:
    """Return a draw between two multiples of the device's mass: of what limits walls grow with it."""
    return lambda random, device: float(device.experiments[0].mass * random.uniform(low, high))


def of_quantum(low: float, high: float) -> Draw:
    """Return a draw of a length between two multiples of the sensor's quantum."""
    return lambda random, device: float(device.sensor.quantum * random.uniform(low, high))


def of_signed(draw: Draw) -> Draw:
    """Return a draw with either sign."""
    return lambda random, device: float(draw(random, device) * (1 if random.random() < 0.5 else -1))


_MODE = {
    "loop.mode.frequency_hz": uniform(20, 90),
    "loop.mode.damping_ratio": uniform(0.01, 0.06),
    "loop.mode.mass": of_mass(0.08, 0.3),
}
_BUTTERWORTH = {
    "loop.velocity.kind": either("butterworth"),
    "loop.velocity.order": either(1, 2, 3, 4),
    "loop.velocity.cutoff_hz": uniform(25, 120),
}
_OPERATOR = {
    "loop.operator.mass": of_mass(0.1, 0.5),
    "loop.operator.damping": of_mass(1.7, 14),
    "loop.operator.stiffness": of_mass(86, 690),
}
_LAG = {"loop.actuator_lag_s": uniform(0.001, 0.004)}
_COULOMB = {"loop.friction.coulomb": of_step(0.01, 0.03)}

_KINDS = {
    "ideal": Kind(),
    "fractional delay": Kind({"experiment.delay_samples": uniform(2.2, 4.8)}, ("fractional_delay",)),
    "jitter": Kind({"experiment.jitter_samples": either((3, 4, 5), (2, 3), (3, 4))}, ("delay_jitter",)),
    "friction weak": Kind(_COULOMB, ("coulomb_friction",)),
    "friction strong": Kind({"loop.friction.coulomb": of_step(0.06, 0.15)}, ("coulomb_friction",)),
    "friction with stiction": Kind(
        {
            "loop.friction.coulomb": of_step(0.02, 0.06),
            "loop.friction.stiction": of_step(0.07, 0.1),
            "loop.friction.stribeck_velocity": uniform(0.003, 0.03),
        },
        ("coulomb_friction",),
    ),
    "butterworth filter": Kind(_BUTTERWORTH, ("velocity_filter",)),
    "difference filter": Kind(
        {"loop.velocity.kind": either("difference"), "loop.velocity.samples": either(2, 4, 8, 16)}, ("velocity_filter",)
    ),
    "coefficient filter": Kind(
        {
            "loop.velocity.kind": either("coefficients"),
            "loop.velocity.b": either((0.2,), (0.1, 0.1), (0.25, 0.5, 0.25)),
            "loop.velocity.a": either((1.0, -0.8)),
        },
        ("velocity_filter",),
    ),
    "actuator lag": Kind(_LAG, ("actuator_lag",)),
    # logs do not tell a lag of less than a sample from a delay that is no whole number of them
    "short lag": Kind({"loop.actuator_lag_s": uniform(1e-4, 5e-4)}, ("actuator_lag", "fractional_delay")),
    "mode at the motor": Kind({**_MODE, "loop.mode.sensor": either("motor")}, ("vibration_mode",)),
    "mode at the load": Kind({**_MODE, "loop.mode.sensor": either("load")}, ("vibration_mode",)),
    "operator": Kind(_OPERATOR, ("operator",)),
    "gain": Kind({"loop.force_gain": either(0.8, 0.9, 1.1, 1.2)}, ("force_gain",)),
    "hidden gain": Kind({"simulation.gain_error": of_signed(uniform(0.05, 0.2))}, ("force_gain",)),
    "clock": Kind({"simulation.clock_error": of_signed(uniform(0.01, 0.05))}, ("sampling_period",)),
    "clipping": Kind({"limits.force": of_step(0.9, 1.1)}, ("saturation",)),
    "clipping in the log": Kind(
        {"limits.force": of_step(0.9, 1.1), "simulation.clipped_command_logged": either(True)}, ("saturation",)
    ),
    "one-sided wall": Kind({"simulation.one_sided_wall": either(True)}, ("unilateral_wall",)),
    "gravity": Kind({"simulation.constant_force": of_signed(of_step(0.02, 0.1))}, ("constant_force",)),
    "lost rows": Kind({"simulation.lost_rows": uniform(0.005, 0.03)}, ("missing_rows",)),
    "hidden rows": Kind(
        {"simulation.lost_rows": uniform(0.005, 0.03), "simulation.lost_rows_hidden": either(True)}, ("missing_rows",)
    ),
    "held samples": Kind({"simulation.held_samples": uniform(0.01, 0.1)}, ("repeated_rows",)),
    "repeated rows": Kind({"simulation.repeated_rows": uniform(0.01, 0.1)}, ("repeated_rows",)),
    "coarse sensor": Kind({"sensor.quantum": of_quantum(10, 40)}, ("coarse_sensor",)),
    "noisy sensor": Kind({"sensor.noise": of_quantum(2.5, 10)}),
    "ramp": Kind({"simulation.ramp_samples": either(3, 6, 12, 25)}, ("step_not_a_step",)),
    "several steps": Kind(
        {"simulation.later_steps": lambda random, device: ({"time_s": 0.2, "size": -0.5 * device.step},)},
        ("several_steps",),
    ),
    "few trials": Kind(keep="few", causes=("few_trials",)),
    "only stable": Kind(keep="stable", causes=("no_unstable_trial",)),
    "only unstable": Kind(keep="unstable", causes=("no_stable_trial",)),
    "filter and lag": Kind({**_BUTTERWORTH, **_LAG}, ("velocity_filter", "actuator_lag")),
    "all parts": Kind(
        {**_BUTTERWORTH, **_LAG, **_MODE, **_OPERATOR, **_COULOMB},
        ("velocity_filter", "actuator_lag", "vibration_mode", "operator", "coulomb_friction"),
    ),
}


def kinds(base: Device) -> dict[str, Callable[[int], Case]]:
    """Return for each kind a function from a seed to a case.

    Parameters
    ----------
    base : Device
        Device that is varied; ranges are shares of its own step, mass and quantum, and times of a sampling period of
        about 1 ms. The jitter of its first experiment is left out.
    """
    first = base.experiments[0].model_copy(update={"jitter_samples": ()})
    alone = base.model_copy(update={"experiments": (first,), "tables": (), "name": "case"})
    return {name: partial(_case, alone, name) for name in _KINDS}


def _case(base: Device, name: str, seed: int) -> Case:
    kind = _KINDS[name]
    # the place of a kind in the table is no part of its seed: another kind must not change its devices
    random = np.random.default_rng([seed, *name.encode()])
    # what a device does not name stays unnamed: an experiment's own parts go before those of the device
    stated = base.model_dump(mode="json", by_alias=True, exclude_unset=True)
    for key in ("mass", "damping"):
        factor = float(random.uniform(1 - SPREAD, 1 + SPREAD))
        stated["experiment"][0][key] = factor * getattr(base.experiments[0], key)
    plain = Device.model_validate(stated)
    drawn = {key: draw(random, plain) for key, draw in kind.keys.items()}
    true = plain.model_dump(mode="json", by_alias=True, exclude_unset=True)
    for key, value in drawn.items():
        first, *rest = key.split(".")
        place = true["experiment"][0] if first == "experiment" else true.setdefault(first, {})
        for part in rest[:-1]:
            place[part] = place.get(part) or {}
            place = place[part]
        place[rest[-1]] = value
    truth = {**drawn, "causes": kind.causes, "mass": plain.experiments[0].mass, "damping": plain.experiments[0].damping}
    return Case(Device.model_validate(true), plain, {"seed": seed}, kind.keep, truth)


def record(case: Case, **options: Any) -> SimulatedSweep:
    """Return the course of a case with the trials that the lab has; options go to `run_sweep` too."""
    course = run_sweep(case.device, case.device.experiments[0].name, **{**case.options, **options})
    unstable = course.verdict == "unstable"
    every = np.arange(len(unstable))
    chosen = {
        "all": every,
        "stable": every[~unstable],
        "unstable": every[unstable],
        "few": np.sort(np.random.default_rng(course.seed).permutation(every)[:FEW]),
    }[case.keep]
    return replace(
        course, trials=course.trials.select(chosen), passes=course.passes[chosen], verdict=course.verdict[chosen]
    )

"""Decide from free runs of few logs between a mode, a spring, and neither, for a device with friction.

The command is often constant between two reversals. Segments of one direction then show how a device with a load
vibrates. They do not show whether motor or load is driven, nor how mass, damping and friction are shared. A free run
includes the reversals. Its errors are modelled as autoregressive noise, which is estimated together with the device:

    y_k - y(theta)_k + a_1 (y_(k-1) - y(theta)_(k-1)) + ... = e_k

Source: Clarke 1967, "Generalized least squares estimation of the parameters of a dynamic model".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter

import numpy as np

from pipeline.measured.identification.likelihood import LIMITS, WORTH, Device, Fit, fitted, free_motion
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.part_table import CLOSER, PARTS
from pipeline.measured.identification.scatter import solve
from pipeline.measured.identification.search import climbed
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats

WHITE_ERRORS = (1.0,)
"""Filter for white errors."""

ORDER = 4
"""Number of coefficients of the noise of free runs, which includes force drift and the filter of a sensor."""

NOISE_ROUNDS = 2
"""Number of estimates of the noise of free runs. A search follows each estimate."""

STEPS, LAST_STEPS = 20, 6
"""Largest number of steps of a search from a starting value, and of a search after an estimate of the noise."""

LOAD_SHARES = ((0.1, 0.1), (0.3, 0.4))
"""Initial values of the shares of damping and friction that act on the load."""

VISIBLE = 4.0
"""Threshold for the variance of free-run errors, relative to the variance of readings. Above it, a slow mode is
searched for."""

LOWEST, HIGHEST, FACTOR = 4 * np.pi, 0.4, 1.4
"""Limits and ratio of the frequencies of the search: the lowest phase [rad] of a mode over a record (two periods), the
highest frequency [rad/sample], and the ratio of successive frequencies. Segments show modes of higher frequency."""

MASS_SHARES, DAMPER_SHARES = (0.15, 0.45), (0.5,)
"""Initial values for a mode: shares of the mass that belong to the load, and, if the position of the load is measured,
shares of the loss that occur in the damper between both sides."""

LOAD_PARTS = {"load damping": "load_damping", "load friction": "load_coulomb"}
"""Number of the estimator for each part that acts on the load of a mode."""

LEFT = 0.5
"""Largest share of the variance of free-run errors that may remain after a mode is added."""

SENSED = {"motor": "mode", "load": "mode at the load"}
"""Name of the mode's part for each side whose position may be measured."""

MODE = {name for part in SENSED.values() for name in PARTS[part].numbers}
"""Numbers of a mode."""


def free_fit(segments: Segments, device: Device, steps: int = STEPS) -> tuple[Segments, Fit]:
    """Fit free runs near a device, and return the segments with the filter that whitens the errors, and the fit."""
    segments = replace(segments, free=WHITE_ERRORS)
    fit = climbed(segments, replace(device, noise=WHITE, effects=None), steps)
    for _ in range(NOISE_ROUNDS):
        segments = replace(segments, free=_coefficients(segments, fit))
        fit = climbed(segments, fit.device, LAST_STEPS)
    return segments, fit


def free_errors(segments: Segments, fit: Fit) -> list[Floats]:
    """Return the errors of the free run of each segment from its most likely initial state."""
    motion, _, _ = free_motion(segments, fit.device, min(segments.white, fit.device.reading), segments.largest)
    errors = segments.position[segments.places] - motion
    return np.split(errors, np.cumsum(segments.rows)[:-1])


def _coefficients(segments: Segments, fit: Fit) -> tuple[float, ...]:
    """Return the filter that whitens the errors of free runs, from least squares over all segments."""
    before, now = [], []
    for errors in free_errors(segments, fit):
        before.append(np.stack([errors[ORDER - back : -back] for back in range(1, ORDER + 1)], axis=1))
        now.append(errors[ORDER:])
    columns, wanted = np.concatenate(before), np.concatenate(now)
    return 1.0, *(-np.linalg.lstsq(columns, wanted, rcond=1e-9)[0]).tolist()


def with_mode(segments: Segments, fit: Fit, parts: dict[str, float]) -> tuple[Segments, Fit, dict[str, float]] | None:
    """Return segments, fit and parts of a device with friction and a mode, or None if free runs do not require a mode.

    ``fit`` is the fit to segments of one direction. A mode, a spring and neither of them are compared. A mode is
    accepted if its likelihood exceeds the others by its threshold and at most `LEFT` of the variance of free-run errors
    remains.
    """
    numbers = fit.device.numbers
    rigid = {name: value for name, value in numbers.items() if name not in (*MODE, "load_damping")}
    plain = [rigid]
    if "mode_frequency" in numbers and "gamma" not in rigid:
        plain.append({"gamma": numbers["mode_frequency"] ** 2} | rigid)
    fits = [free_fit(segments, Device(each)) for each in plain]
    without = max(fits, key=lambda each: each[1].likelihood)
    left = _variance(segments, without[1])
    if "mode_frequency" not in numbers and left < VISIBLE * segments.white:
        return None
    starts = list(_starts(segments, fit, without[1]))
    whole, other = max((free_fit(segments, each) for each in starts), key=lambda each: each[1].likelihood)
    gain, found = other.likelihood - without[1].likelihood, other.device.numbers
    side = "load" if "spring_damping_fraction" in found else "motor"
    names = PARTS[SENSED[side]].numbers
    if gain < PARTS[SENSED[side]].threshold + CLOSER * len(LOAD_PARTS):
        return None
    if "mode_frequency" not in numbers and _variance(segments, other) > LEFT * left:
        return None
    if not all(LIMITS[name][0] < found[name] < LIMITS[name][1] for name in ("gain", *names[::2])):
        return None
    rest = {name: value for name, value in parts.items() if name not in (*SENSED.values(), *LOAD_PARTS)}
    return whole, other, {**rest, SENSED[side]: gain, **_load_parts(other)}


def _load_parts(fit: Fit) -> dict[str, float]:
    """Return the likelihood gains of damping and friction on the load, or 0 if the logs do not identify them."""
    from pipeline.measured.identification.intervals import Errors

    gains = {}
    for name, number in LOAD_PARTS.items():
        if number not in fit.device.numbers:
            continue
        interval = Errors.of(fit).interval(itemgetter(number))
        gain = 0.5 * (interval.value / interval.error) ** 2 if interval.value > 0 and interval.error > 0 else 0.0
        gains[name] = gain if gain > WORTH else 0.0
    return gains


def _variance(segments: Segments, fit: Fit) -> float:
    """Return the variance of the errors of free runs."""
    return float(np.mean(np.concatenate(free_errors(segments, fit)) ** 2))


def _starts(segments: Segments, fit: Fit, without: Fit) -> Iterator[Device]:
    """Yield initial devices with a mode. It is the mode of the segments if they have one, otherwise the best of a
    grid."""
    if "mode_frequency" in fit.device.numbers:
        for shares in LOAD_SHARES:
            yield _loaded(fit.device.numbers, shares)
        return
    rows = float(np.median(segments.rows))
    turns = np.geomspace(LOWEST / rows, HIGHEST, 1 + int(np.log(HIGHEST * rows / LOWEST) / np.log(FACTOR)))
    rigid = {name: value for name, value in without.device.numbers.items() if name != "gamma"}
    for part, shares_of_side in ((SENSED["motor"], MASS_SHARES), (SENSED["load"], DAMPER_SHARES)):
        modes = ((turn, 0.05, share) for turn in turns for share in shares_of_side)
        tried = [_loaded(rigid | dict(zip(PARTS[part].numbers, each, strict=True)), LOAD_SHARES[0]) for each in modes]
        yield max(tried, key=lambda each: _promise(segments, each))


def _loaded(numbers: dict[str, float], shares: tuple[float, float]) -> Device:
    """Return a device whose load has the given shares of damping and friction."""
    damping, friction = shares
    load = {}
    if "coulomb" in numbers:
        load = {"load_coulomb": friction * numbers["coulomb"], "coulomb": (1 - friction) * numbers["coulomb"]}
    if "spring_damping_fraction" not in numbers:
        load["load_damping"] = damping * numbers["delta"]
    return Device(numbers | load)


def _promise(segments: Segments, device: Device) -> float:
    """Return the likelihood of a device with a mode after one step of all numbers except those of the mode."""
    fit = fitted(replace(segments, free=WHITE_ERRORS), device, np.empty(0, dtype=np.int64))
    others = [place for place, name in enumerate(device.names) if name not in MODE]
    return solve(fit.moments.some(others), np.empty(0, dtype=np.int64)).likelihood

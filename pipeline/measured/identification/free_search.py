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

from pipeline.measured.identification.likelihood import LIMITS, WORTH, Device, Fit, free_motion, moments_of
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.part_table import CLOSER, PARTS, TriedPart
from pipeline.measured.identification.recordings import LogUnits, Recording
from pipeline.measured.identification.replay import medians, replays
from pipeline.measured.identification.scatter import solve
from pipeline.measured.identification.search import climbed, ended
from pipeline.measured.identification.segments import Segments, segments_of
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
"""Largest share of the variance of the velocity errors of free runs that may remain after a mode is added."""

EXPLORED_ROWS, LONGEST_PART = 9000, 4500
"""Number of rows that are used to search for a mode, and largest number of rows of each part of a log that is used. The
devices of the search are then fitted to all rows. More rows would not change the choice of starting values."""

BANDS_PER_OCTAVE = 3
"""Number of frequency bands per octave in which the content of a record is measured."""

SENSED = {"motor": "mode", "load": "mode at the load"}
"""Name of the part of a mode, by the side whose position is measured."""

MODE = {name for part in SENSED.values() for name in PARTS[part].numbers}
"""Numbers of a mode."""


def free_fit(
    segments: Segments, device: Device, steps: int = STEPS, errors: tuple[float, ...] = WHITE_ERRORS
) -> tuple[Segments, Fit]:
    """Fit free runs near a device, and return the segments with the filter that whitens the errors, and the fit.

    ``errors`` is the filter of the first search.
    """
    segments = replace(segments, free=errors)
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


def with_mode(
    logs: tuple[list[Recording], LogUnits, int], fit: Fit, parts: dict[str, float]
) -> tuple[Segments, Fit, dict[str, float]] | TriedPart:
    """Return segments, fit and parts of a device with friction and a mode, or the test that a mode failed.

    ``fit`` is the fit to segments of one direction. Devices with a mode, with a spring, and with neither are compared.
    A mode is accepted if its likelihood exceeds that of the alternatives by its threshold, and if it is `_followed`.
    The search uses `informative` rows. Its best device is then fitted to all rows, and judged again.
    """
    recordings, units, lead = logs
    segments, numbers = segments_of(recordings, units, lead, False, WHITE_ERRORS), fit.device.numbers
    some, known = informative(segments), "mode_frequency" in numbers
    rigid = {name: value for name, value in numbers.items() if name not in (*MODE, "load_damping")}
    plain = [rigid]
    if known and "gamma" not in rigid:
        plain.append({"gamma": numbers["mode_frequency"] ** 2} | rigid)
    without = max((free_fit(some, Device(each)) for each in plain), key=lambda each: each[1].likelihood)
    if not known and _variance(*without) < VISIBLE * some.white:
        return TriedPart("small errors", np.nan, required_gain(SENSED["motor"]))
    fits = sorted((free_fit(some, *each) for each in _starts(some, fit, without)), key=lambda each: -each[1].likelihood)
    best = TriedPart("gain", fits[0][1].likelihood - without[1].likelihood, required_gain(SENSED[_side(fits[0][1])]))
    worth = [each for each in fits if _is_required(each[1].likelihood - without[1].likelihood, each[1])]
    found = next((each for each in worth if known or _followed(logs, without[1], each[1])), None)
    if found is None:
        is_enough = best.gain >= best.required
        return replace(best, decision="free runs" if worth else "at a limit" if is_enough else "gain")
    gain = found[1].likelihood - without[1].likelihood
    if some is not segments:
        found = free_fit(segments, found[1].device, errors=found[0].free)
        if not (known or _followed(logs, without[1], found[1])):
            return TriedPart("free runs", gain, required_gain(SENSED[_side(found[1])]))
    side = _side(found[1])
    if not _has_load(*found):
        return TriedPart("no load", gain, required_gain(SENSED[side]))
    absent = {*SENSED.values(), *LOAD_PARTS} | ({"stiffness"} if "gamma" not in found[1].device.numbers else set())
    rest = {name: value for name, value in parts.items() if name not in absent}
    return *found, {**rest, SENSED[side]: gain, **_load_parts(found[1])}


def _followed(logs: tuple[list[Recording], LogUnits, int], without: Fit, found: Fit) -> bool:
    """Return whether a mode reduces the variance of the velocity error of free runs to less than `LEFT` of its
    value."""
    (before, _), (behind, _) = (
        medians(replays(*logs, replace(each.device, effects=None))) for each in (without, found)
    )
    return before is None or behind is None or (100 - behind) ** 2 < LEFT * (100 - before) ** 2


def _has_load(segments: Segments, fit: Fit) -> bool:
    """Return whether the load of a mode is identifiable. A load whose mass may be 0 only absorbs errors of the
    model."""
    from pipeline.measured.identification.intervals import Errors

    if "load_mass_fraction" not in fit.device.numbers:
        return True
    interval = Errors.of(ended(segments, fit.device)).interval(itemgetter("load_mass_fraction"))
    return interval.low > 0


def _side(fit: Fit) -> str:
    """Return the side whose position is measured, for a device with a mode."""
    return "load" if "spring_damping_fraction" in fit.device.numbers else "motor"


def required_gain(part: str) -> float:
    """Return the gain of log-likelihood required for a mode, with damping and friction on its load."""
    return PARTS[part].threshold + CLOSER * len(LOAD_PARTS)


def _is_required(gain: float, fit: Fit) -> bool:
    """Return whether a gain of log-likelihood is sufficient for a mode, with numbers inside their limits.

    The damping ratio may be at its lower limit. At the upper one, the mode does not vibrate, and replaces a delay.
    """
    part, numbers = PARTS[SENSED[_side(fit)]], fit.device.numbers
    if gain < required_gain(SENSED[_side(fit)]) or numbers["mode_damping_ratio"] >= LIMITS["mode_damping_ratio"][1]:
        return False
    return all(LIMITS[name][0] < numbers[name] < LIMITS[name][1] for name in ("gain", *part.numbers[::2]))


def informative(segments: Segments) -> Segments:
    """Return parts of segments with about `EXPLORED_ROWS` rows in total, or all segments if they have fewer rows.

    The parts are added one at a time. Each added part is the one that adds most to the information sum ln(1 + S) over
    frequency bands, where S is the sum of the power of the motion in a band over all chosen parts, relative to the
    power of the readings' noise. The choice depends on the content of the parts only, not on the order of the logs.
    """
    if int(segments.rows.sum()) <= EXPLORED_ROWS:
        return segments
    pieces = segments.split(LONGEST_PART)
    powers = np.array([_band_powers(pieces, s) for s in range(len(pieces))])
    chosen: list[int] = []
    total, left = np.zeros(powers.shape[1]), EXPLORED_ROWS
    while left > 0 and len(chosen) < len(pieces):
        gains = np.log1p(powers / (1 + total)[None]).sum(axis=1) / pieces.rows
        gains[chosen] = -np.inf
        chosen.append(int(np.argmax(gains)))
        total, left = total + powers[chosen[-1]], left - int(pieces.rows[chosen[-1]])
    return pieces.select(np.array(sorted(chosen), dtype=np.int64))


def _band_powers(pieces: Segments, number: int) -> Floats:
    """Return the power of the motion of a part in each frequency band, relative to the power of the readings' noise."""
    position = pieces.position[pieces.first[number] : pieces.behind[number]]
    since = np.linspace(-1.0, 1.0, len(position))
    lines = np.stack([np.ones(len(since)), since], axis=1)
    bent = position - lines @ np.linalg.lstsq(lines, position, rcond=None)[0]
    power = np.abs(np.fft.rfft(bent * np.hanning(len(bent)))) ** 2 / (pieces.white * len(bent))
    turns = np.arange(1, len(power)) * (LONGEST_PART / len(bent))
    bands = np.floor(BANDS_PER_OCTAVE * np.log2(turns)).astype(np.int64)
    most = int(BANDS_PER_OCTAVE * np.log2(LONGEST_PART))
    return np.asarray(np.bincount(np.clip(bands, 0, most), power[1:], minlength=most + 1), dtype=np.float64)


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


def _starts(
    segments: Segments, fit: Fit, without: tuple[Segments, Fit]
) -> Iterator[tuple[Device, int, tuple[float, ...]]]:
    """Yield initial devices with a mode, numbers of steps, and filters of the errors, as arguments of `free_fit`.

    The mode is that of the fit to segments, if this fit has a mode. Otherwise, it is the best mode of a grid, for white
    errors and for the errors of the device without a mode. White errors show a slow mode in readings with little drift.
    The errors without a mode show a mode in addition to drift.
    """
    if "mode_frequency" in fit.device.numbers:
        for shares in LOAD_SHARES:
            yield _loaded(fit.device.numbers, shares), STEPS, WHITE_ERRORS
        return
    rows = float(np.median(segments.rows))
    turns = np.geomspace(LOWEST / rows, HIGHEST, 1 + int(np.log(HIGHEST * rows / LOWEST) / np.log(FACTOR)))
    rigid = {name: value for name, value in without[1].device.numbers.items() if name != "gamma"}
    for part, shares_of_side in ((SENSED["motor"], MASS_SHARES), (SENSED["load"], DAMPER_SHARES)):
        modes = ((turn, 0.05, share) for turn in turns for share in shares_of_side)
        tried = [_loaded(rigid | dict(zip(PARTS[part].numbers, each, strict=True)), LOAD_SHARES[0]) for each in modes]
        for errors in (WHITE_ERRORS, without[0].free):
            promises = [_promise(replace(segments, free=errors), each) for each in tried]
            yield tried[int(np.argmax(promises))], STEPS, errors


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
    others = tuple(name for name in device.names if name not in MODE)
    return solve(moments_of(segments, device, others), np.empty(0, dtype=np.int64)).likelihood

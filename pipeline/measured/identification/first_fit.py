"""First fit of a device from its force balance, with friction and a spring if the logs show or allow them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.identification.estimated import ESTIMATED
from pipeline.measured.identification.first_guess import first_guesses
from pipeline.measured.identification.intervals import Errors
from pipeline.measured.identification.likelihood import WORTH, Device, Fit, moments_of
from pipeline.measured.identification.noise import WHITE
from pipeline.measured.identification.part_table import TriedPart
from pipeline.measured.identification.recordings import SHORTEST, LogUnits, Recording
from pipeline.measured.identification.scatter import FEWEST, solve
from pipeline.measured.identification.search import climbed, refined
from pipeline.measured.identification.segments import Segments, segments_of

BASE = ("gain", "delta", "delay", "force")
"""Numbers that every device has."""

SHORTER = (150,)
"""Largest number of rows of short segments, which give additional starting values. It is about ten time constants of a
fast motor at 1 kHz."""

STARTS = 2
"""Number of initial devices for a search on whole segments. One has a spring, and one does not."""

LOOKED_AT = 9000
"""Number of rows used in the first search for parts, in segments spread over all rows. More rows would
not change any decision."""

UNSEEN_FRICTION = 0.02
"""Friction that may remain undetected, relative to the largest command. Beyond it, unknown friction is included in the
fit. The relative error of the mass equals this ratio."""

SLIGHT = 1e-6
"""Threshold for the force of a spring or of friction, relative to the largest command. Below it, the force counts as
zero. The value separates rounding from real forces in exact logs."""

CONSTANT = 1e-3
"""Threshold for the change of the commands, relative to the largest command. Below it, the commands are treated as one
constant command."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Intermediate result of the selection: a fit to segments, its parts with their gains, and all tests so far."""

    segments: Segments
    fit: Fit
    parts: dict[str, float]
    tried: dict[str, TriedPart]


def first_fit(
    recordings: list[Recording], units: LogUnits, lead: int, begin: list[Device]
) -> tuple[Selection, dict[str, float]]:
    """Return the selection, with friction and a spring if they are present or possible, and bounds.

    The search starts from each of the given devices. Bounds are the upper ends of friction and spring [SI], from a fit
    with both.
    """
    bounds, fit, tried = {}, None, dict[str, TriedPart]()
    if "coulomb" in begin[0].numbers and len(segments := segments_of(recordings, units, lead, True)):
        whole = _searched(segments, begin)
        bounds = {name: upper_end(whole, name, units) for name in ("friction.coulomb", "stiffness")}
        fit, spring = _worth(segments, whole, begin[0])
        gain, numbers = loss_without(fit, "coulomb"), fit.device.numbers
        rubs = gain > WORTH and numbers["coulomb"] / numbers["gain"] > SLIGHT
        if rubs or upper_end(fit, "friction.coulomb", units) >= UNSEEN_FRICTION * units.command:
            tried = {"friction": TriedPart("accepted" if rubs else "undecided", gain, WORTH), "stiffness": spring}
            return Selection(segments, fit, {"friction": gain if rubs else 0.0} | _found(spring), tried), bounds
        tried = {"friction": TriedPart("size", gain, WORTH)}
    segments = segments_of(recordings, units, lead, False)
    starts = [_sliding(each) for each in begin]
    fit = refined(segments, _sliding(fit.device), far=False) if fit is not None else _searched(segments, starts)
    bounds["stiffness"] = upper_end(fit, "stiffness", units)
    fit, spring = _worth(segments, fit, starts[0])
    return Selection(segments, fit, _found(spring), tried | {"stiffness": spring}), bounds


def _found(spring: TriedPart) -> dict[str, float]:
    """Return the part of a spring with its gain if it is accepted."""
    return {"stiffness": spring.gain} if spring.decision == "accepted" else {}


def upper_end(fit: Fit, name: str, units: LogUnits) -> float:
    """Return the upper end of the interval of a nonnegative quantity."""
    return Errors.of(fit).interval(ESTIMATED[name].quantity(units), ends_at_zero=True).high


def _worth(segments: Segments, fit: Fit, begin: Device) -> tuple[Fit, TriedPart]:
    """Return the fit, with a spring only if the logs show a spring, and the test of the spring.

    If the logs seem to show a spring, the search is repeated without it from the same start. With a single wall, a
    spring may imitate the command.
    """
    gain, numbers = loss_without(fit, "gamma"), fit.device.numbers
    # relative to the largest command, at the largest displacement
    if gain > WORTH and abs(numbers["gamma"] / numbers["gain"]) > SLIGHT:
        free = refined(segments, springless(begin))
        if free.likelihood > fit.likelihood - WORTH:
            return free, TriedPart("gain", fit.likelihood - free.likelihood, WORTH)
        return fit, TriedPart("accepted", gain, WORTH)
    return refined(segments, springless(fit.device), far=False, noisy=False), TriedPart("size", gain, WORTH)


def springless(device: Device) -> Device:
    """Return a device without its spring."""
    return Device({name: value for name, value in device.numbers.items() if name != "gamma"}, device.noise)


def _sliding(device: Device) -> Device:
    """Return a device without friction and with a spring."""
    numbers = {name: value for name, value in device.numbers.items() if name != "coulomb"}
    return Device({"gamma": 0.0} | numbers, device.noise)


def base_numbers(recordings: list[Recording]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the numbers that the commands make identifiable, and the parameters that are assumed to be zero."""
    largest = max(float(np.abs(each.command).max()) for each in recordings)
    if any(np.ptp(each.command) > CONSTANT * largest for each in recordings):
        return BASE, ()
    if any(each.edge is not None for each in recordings):
        return ("gain", "delta", "delay"), ("constant_force",)
    levels = np.array([float(each.command[0]) for each in recordings])
    if np.ptp(levels) > CONSTANT * largest:
        return ("gain", "delta", "force"), ("delay_samples",)
    return ("gain", "delta"), ("delay_samples", "constant_force")


def first_devices(recordings: list[Recording], units: LogUnits, base: tuple[str, ...], lead: int) -> list[Device]:
    """Return initial devices for a search, with a spring, and with friction if directions of motion are known.

    Force balances are integrated over whole and over short segments. In a whole segment, a long plateau outweighs the
    fast motion before it; in short segments, a slow motion is hardly visible.

    Raises
    ------
    ParameterError
        If no part of a log is long enough or in motion, or if the device moves against its command.
    """
    segments, names = segments_of(recordings, units, lead, True), (*base, "gamma", "coulomb")
    if not len(segments):
        names, segments = (*base, "gamma"), segments_of(recordings, units, lead, False)
    if not len(segments):
        raise ParameterError(
            f"no log has {SHORTEST} consecutive rows after the first {lead} rows, whose commands are needed for the "
            "delay. Record longer logs, with the step closer to the start"
        )
    parts = [segments, *(segments.split(rows) for rows in SHORTER if segments.rows.max() > 2 * rows)]
    return [device for part in parts for device in devices_of(part, names, lead)]


def devices_of(segments: Segments, names: Sequence[str], most_delay: float) -> list[Device]:
    """Return two initial devices from the force balance, with and without a spring, the more likely device first.

    With a single wall, the command is that of a spring and a damper. Except for the delay, a device with a spring and a
    damper but no gain moves in the same way. Reading errors then decide between the two devices.
    """
    some = some_of(segments)
    return sorted(first_guesses(segments, names, most_delay), key=lambda device: -likelihood_of(some, device))


def _searched(segments: Segments, begin: list[Device]) -> Fit:
    """Return the maximum-likelihood fit, starting from the first device.

    If the best model includes a random force, the search is repeated from all initial devices, this time without a
    random force. A random force that is included too early may replace friction, a delay, or a fast motion.
    """
    fit = refined(segments, begin[0])
    if not fit.solved.information.any():
        raise ParameterError(
            "no motion follows the edge of the command, so the logs contain no information on the device. Record for a "
            "longer time after the edge, and start at rest"
        )
    if segments.trials < FEWEST and len(begin) > 1:
        first, second = (climbed(segments, device).solved.here for device in begin[:2])
        # one fit suffices if both starts lead to the same optimum without a random force
        if abs(first - second) >= WORTH:
            fit = max(fit, refined(segments, begin[1]), key=lambda each: each.likelihood)
    if fit.device.noise == WHITE or (len(begin) <= STARTS and segments.trials >= FEWEST):
        return fit
    some = some_of(segments)
    climbs = [climbed(some, device) for device in begin]
    here = climbed(some, replace(fit.device, noise=WHITE, effects=None))
    # if all devices have the same optimum without a random force, the random force has replaced nothing
    best = max(climbs, key=lambda each: each.solved.here)
    if best.solved.here < here.solved.here + WORTH:
        return fit
    if segments.trials >= FEWEST:
        climbs = [best]
    other = max((refined(some, each.device, far=False) for each in climbs), key=lambda each: each.likelihood)
    if some is not segments:
        whole = refined(some, replace(fit.device, effects=None), far=False)
        if other.likelihood <= whole.likelihood + WORTH:
            return fit
        other = refined(segments, replace(other.device, effects=None), far=False)
    return other if other.likelihood > fit.likelihood else fit


def likelihood_of(segments: Segments, device: Device) -> float:
    """Return the likelihood of a device without a further search."""
    return solve(moments_of(segments, device), np.empty(0, dtype=np.int64)).here


def loss_without(fit: Fit, name: str, *, signed: bool = False) -> float:
    """Return the loss of likelihood if a number in which the motion is linear is set to 0.

    A negative number has no meaning and no loss, unless ``signed`` is true.
    """
    found = Errors.of(fit).interval(lambda n: n[name])
    return 0.5 * (found.value / found.error) ** 2 if (signed or found.value > 0) and found.error > 0 else 0.0


def some_of(segments: Segments) -> Segments:
    """Return segments with about `LOOKED_AT` rows in total, or all segments if they have fewer."""
    return segments.subset(int(LOOKED_AT / np.mean(segments.rows)) + 1)

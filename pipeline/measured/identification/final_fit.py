"""Fit a device with chosen parts to all of its recordings, with the optima and bounds that the logs do not exclude."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.measured.identification.estimated import ESTIMATED
from pipeline.measured.identification.first_fit import some_of
from pipeline.measured.identification.free_search import free_fit
from pipeline.measured.identification.likelihood import DONE, Fit
from pipeline.measured.identification.part_table import PARTS, TriedPart
from pipeline.measured.identification.parts import BESIDE, SOME_STEPS, ChosenParts, other_numbers
from pipeline.measured.identification.recordings import LogUnits, Recording
from pipeline.measured.identification.search import climbed, ended
from pipeline.measured.identification.segments import Segments, segments_of

DELAYS, FRICTIONS = 4, (0.3, 2.0)
"""Starting points of the search for other optima: number of delays over their range, and factors of the best
friction."""

UNSEEN = (0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8, 1.1, 1.6, 2.2, 3.2)
"""Lags [samples] that may be part of a delay. Rounding can make shorter lags more likely than no lag."""

IMITATED = 0.75
"""Threshold for the lag [samples]. Below it, a fast mode, beyond the range of the search, has the same effect. A mode
at 1.9 rad/sample acts like a lag of 0.38 samples with a delay that is shorter by the same amount."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Fit of a device with its parts, and the gain of cross-validated likelihood of each part.

    A part with a gain of 0 is undecided, and its number is included as unknown. ``assumed`` contains the names of
    parameters that are assumed to be zero. ``bounds`` contains upper ends for absent friction, spring and lag, and the
    other end of the range of a delay that cannot be separated from a lag. Keys are names of `ESTIMATED`. ``open``
    contains the names of parts as in `ChosenParts`, and ``tried`` the test of each part that was tried.
    """

    fit: Fit
    segments: Segments
    units: LogUnits
    parts: dict[str, float]
    assumed: tuple[str, ...]
    bounds: dict[str, float] = field(default_factory=dict)
    open: tuple[str, ...] = ()
    tried: dict[str, TriedPart] = field(default_factory=dict)

    @property
    def moving(self) -> bool:
        """Whether rows with an unknown direction of motion are excluded."""
        return "friction" in self.parts


def fit_parts(recordings: list[Recording], chosen: ChosenParts) -> Choice:
    """Fit a device with chosen parts to recordings in the order of their ranks.

    Raises
    ------
    numpy.linalg.LinAlgError
        If no device fits.
    """
    units, lead = chosen.units, chosen.lead
    if chosen.free:
        segments = segments_of(recordings, units, lead, False, chosen.free)
        segments, fit = free_fit(segments, chosen.device, errors=chosen.free)
        fit = ended(segments, fit.device)
    else:
        segments = segments_of(recordings, units, lead, "friction" in chosen.parts)
        fit = ended(segments, chosen.device)
    if fit.few and not segments.free and "coulomb" in fit.device.numbers and "delay" in fit.device.numbers:
        fit = _spanned(segments, fit, lead)
    numbers = fit.device.numbers
    absent = (name for name in chosen.bounds if ESTIMATED[name].number not in numbers)
    bounds = {name: chosen.bounds[name] for name in absent if chosen.bounds[name] <= _largest_bound(name, units)}
    if lag := _unseen_lag(segments, fit):
        bounds |= {"actuator_lag_s": lag * units.period, "delay_samples": numbers["delay"] - lag}
    elif numbers.get("lag", np.inf) < IMITATED:
        bounds["delay_samples"] = numbers["delay"] + numbers["lag"]
    return Choice(fit, segments, units, chosen.parts, chosen.assumed, bounds, chosen.open, chosen.tried)


def _largest_bound(name: str, units: LogUnits) -> float:
    """Return the largest meaningful upper end of friction or of a spring [SI].

    Friction larger than the largest command would keep the device at rest. A spring stiffer than twice the largest
    command over the largest displacement would not have allowed this displacement.
    """
    return {"friction.coulomb": units.command, "stiffness": 2 * units.command / units.position}[name]


def _spanned(segments: Segments, fit: Fit, lead: int) -> Fit:
    """Return the best of several optima, with intervals that include all optima that the logs do not exclude.

    With friction and few logs there are several optima, because a reversal depends on both friction and delay. The
    search starts from delays over the whole range, with less and with more friction.
    """
    numbers = fit.device.numbers
    starts = [
        replace(fit.device, numbers=numbers | {"delay": float(delay), "coulomb": share * numbers["coulomb"]})
        for delay in np.unique(np.linspace(0, max(lead - 3, 1), DELAYS).round())
        for share in FRICTIONS
    ]
    fits = [fit, *(climbed(segments, device, SOME_STEPS) for device in starts)]
    best = max(fits, key=lambda each: each.likelihood)
    best = fit if best.likelihood < fit.likelihood + DONE else ended(segments, best.device)
    # the last search may find a better optimum than all others
    near = [each for each in fits if each.likelihood > best.likelihood - BESIDE * best.repeats]
    steps = [np.array(list(each.device.numbers.values())) - list(best.device.numbers.values()) for each in near]
    return replace(best, optima=np.stack([*best.optima, *steps]))


def _unseen_lag(segments: Segments, fit: Fit) -> float:
    """Return the longest lag [samples] that cannot be distinguished from an equal additional delay.

    Up to second order in its length, a lag acts like a delay. The result is 0 if the device has a lag or a mode.
    """
    numbers = fit.device.numbers
    if "delay" not in numbers or {"lag", "mode_frequency"} & set(numbers):
        return 0.0
    some, alone = some_of(segments), replace(fit.device, effects=None)

    def likelihood(lag: float) -> float:
        late = {"delay": numbers["delay"] - lag} | ({"lag": lag} if lag else {})
        device = replace(alone, numbers=numbers | late)
        # start at the optimum of the other numbers for this lag, because predictions from far away are too optimistic
        step = np.zeros(len(device.names))
        step[: len(numbers)] = other_numbers(some, device, PARTS["lag"], fit.places).step
        return other_numbers(some, device.stepped(step), PARTS["lag"], fit.places).likelihood

    most, end = likelihood(0.0), 0.0
    for lag in (lag for lag in UNSEEN if lag <= numbers["delay"]):
        likely = likelihood(lag)
        if likely < most - BESIDE * fit.repeats:
            return lag if end else 0.0
        end, most = lag, max(most, likely)
    return end

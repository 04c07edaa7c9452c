"""Intervals over all gains of a drive, and over parts of a drive that free runs do not confirm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pipeline.measured.identification.final_fit import Choice
from pipeline.measured.identification.identifiability import PER_MASS
from pipeline.measured.identification.intervals import Errors, Interval
from pipeline.measured.identification.likelihood import Fit
from pipeline.measured.identification.part_table import PARTS
from pipeline.measured.identification.search import climbed, refined


def with_open_parts(parameters: dict[str, Interval], choice: Choice) -> dict[str, Interval]:
    """Return intervals that include the intervals of the device with each open part.

    The likelihood of logs left out requires such a part. However, free runs of these logs do not improve, and the
    random force hardly falls. An arm whose free runs are as accurate as its readings cannot show a gain that falls by 3
    %, but its mass per unit of command differs by 3 % between small and large commands.

    Parameters
    ----------
    parameters : dict of str to Interval
        Intervals of the device of the choice [SI].
    choice : Choice
    """
    result = dict(parameters)
    for name in choice.open:
        errors = Errors.of(_with_part(choice, name))
        others = over_gains({key: errors.parameter(key, choice.units) for key in result}, errors.numbers)
        for key, other in others.items():
            interval = result[key]
            result[key] = replace(interval, low=min(interval.low, other.low), high=max(interval.high, other.high))
    return result


def _with_part(choice: Choice, name: str) -> Fit:
    """Return the most likely fit with an additional part and the noise of the choice."""
    fit, segments = choice.fit, choice.segments
    starts = PARTS[name].starts(fit.device.numbers)
    devices = [replace(fit.device, numbers=fit.device.numbers | start, effects=None) for start in starts]
    fits = (
        climbed(segments, each) if segments.free else refined(segments, each, far=False, noisy=False)
        for each in devices
    )
    return max(fits, key=lambda each: each.likelihood)


def over_gains(parameters: dict[str, Interval], numbers: Mapping[str, float]) -> dict[str, Interval]:
    """Return intervals of the value per unit of command, from the largest to the smallest gain of the drive.

    Parameters
    ----------
    parameters : dict of str to Interval
        Intervals per unit of a small command at the mean gain of both directions.
    numbers : mapping of str to float
        Numbers of the device, perhaps with the asymmetry and the curvature of its drive.
    """
    result = dict(parameters)
    asymmetry, large = abs(numbers.get("asymmetry", 0.0)), 1 - numbers.get("curvature", 0.0)
    least, most = (1 - asymmetry) * min(large, 1.0), (1 + asymmetry) * max(large, 1.0)
    for name in ({"mass"} | PER_MASS) & result.keys() if most > least else ():
        low, high = min(result[name].low, result[name].low / most), max(result[name].high, result[name].high / least)
        result[name] = replace(result[name], low=low, high=high)
    return result

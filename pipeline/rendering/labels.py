"""Names of quantities and formatting of numbers in figures and reports."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pipeline.base.wording import true_minus
from pipeline.device.parameters import ESTIMATE_PARAMETERS, MOTIONS, PARAMETERS, Dimension, Motion, unit_of
from pipeline.records.criteria import CRITERIA, criterion_of, is_criterion
from pipeline.records.findings import DampingRange, Estimate, Optimum
from pipeline.records.results import AnswerEstimate, ChangeCode

MISSING = "–"


DIGITS = 3
"""Smallest number of digits of an estimate. A narrow interval needs more digits."""

MOST_DIGITS = 9
"""Largest number of digits of an estimate. It is sufficient for masses from noise-free simulated logs, which are
accurate to 1e-9."""

BEYOND = 1000.0
"""Threshold of a deviation in percent. Above it, the two numbers are unrelated, so the digits of the deviation are
meaningless."""

ANSWER_DIGITS = 4
"""Largest number of digits on the first screen. Wider intervals than `TIGHT` do not need more."""

TIGHT = 0.1
"""Half width of an interval [% of its value]. Below it, both ends would have the same three digits."""

NEAR_ZERO = 0.2
"""Threshold for a parameter that may be zero, relative to its upper bound. Below it, the parameter is reported as not
found."""

ALL_BUT_ROUNDING = 1e-9
"""Tolerance within which a share counts as 1 and a cost counts as 0. Sums of 1e4 terms have rounding errors of
1e-12."""


@dataclass(frozen=True)
class Units:
    """Unit of each physical quantity for one kind of motion."""

    stiffness: str
    damping: str
    mass: str
    force: str


def unit_text(unit: str) -> str:
    """Return a unit as it is printed."""
    return unit.replace("^2", "²")


_DIMENSIONS: tuple[Dimension, ...] = ("stiffness", "damping", "mass", "force")

UNITS: dict[Motion, Units] = {
    motion: Units(*(unit_text(unit_of(dimension, motion)) for dimension in _DIMENSIONS)) for motion in MOTIONS
}


def quantity_name(quantity: str) -> str:
    """Return the name of an estimate in table heads, which consists of the label and the symbol of its parameter.

    >>> quantity_name("device_stiffness"), quantity_name("friction"), quantity_name("boundary_area")
    ('stiffness k', 'Coulomb friction', 'area under the boundary')
    """
    parameter = PARAMETERS.get(ESTIMATE_PARAMETERS.get(quantity, quantity))
    if parameter is None:
        return "area under the boundary" if quantity == "boundary_area" else quantity.replace("_", " ")
    return f"{parameter.label} {parameter.symbol}" if len(parameter.symbol) == 1 else parameter.label


def criterion_name(name: str) -> str:
    """Return the printed name of a criterion or another result."""
    return criterion_of(name).label if is_criterion(name, CRITERIA) else name.replace("_", " ")


def with_unit(name: str, unit: str) -> str:
    """Return a name with its unit, if it has one, as in ``overshoot [%]``."""
    return f"{name} [{unit}]" if unit else name


def criterion_label(criterion: str) -> str:
    """Return the name of a criterion with the unit of its printed cost."""
    return with_unit(criterion_name(criterion), criterion_of(criterion).family.printed_unit)


def condition_label(condition: str) -> str:
    """Return the printed name of a table condition, such as ``theory, discrete cost C*``."""
    known = {
        "theory_discrete": "theory, discrete cost C*",
        "theory_continuous": "theory, continuous cost C",
        "theory_damped": "theory, C* with the measured damping",
    }
    if condition.startswith("theory_of_"):
        return f"theory, C* of experiment {condition.removeprefix('theory_of_')}"
    return known.get(condition, condition.replace("_", " "))


CHANGES: dict[ChangeCode, str] = {
    "delay": "delay",
    "mass": "mass",
    "damping": "damping",
    "spring": "spring",
    "operator": "hand",
    "velocity_filter": "velocity filter",
    "actuator_lag": "lag",
    "vibration_mode": "vibration",
    "friction": "friction",
    "delay_jitter": "jitter",
}
"""Names of the numbers and parts of a loop that are changed to see their effect."""


def table_label(name: str) -> str:
    """Return the name of a table of optima, which is a number in the thesis and otherwise the name of an experiment."""
    return f"Table {name}" if name[:1].isupper() and name[1:2] == "." else name


def printed_scale(criterion: str) -> float:
    """Return the factor by which a stored cost is multiplied for printing. Overshoot is printed in %."""
    return criterion_of(criterion).family.scale


def shortened(text: str, longest: int) -> str:
    """Return a text cut to ``longest`` characters, with an ellipsis at the end if it was longer."""
    return text if len(text) <= longest else f"{text[: longest - 1].rstrip()}…"


def span(show: Callable[[float], str], low: float | None, high: float | None) -> str:
    """Return an interval as ``low to high``, or an empty text if an end is missing."""
    return "" if low is None or high is None else f"{show(low)} to {show(high)}"


def range_text(show: Callable[[float], str], low: float, high: float) -> str:
    """Return a range as ``low to high``, or one number if both ends print the same."""
    return show(low) if show(low) == show(high) else f"{show(low)} to {show(high)}"


def size_text(percent: float) -> str:
    """Return the absolute value of a deviation in percent with two digits. A value below 0.1 % is expressed in words.

    >>> size_text(-4.83), size_text(0.004), size_text(120.4)
    ('4.8 %', 'less than 0.1 %', '120 %')
    """
    size = abs(percent)
    return "less than 0.1 %" if size < 0.1 else f"{decimal(size, 0) if size >= 10 else significant(size, 2)} %"


def fixed(value: float, places: int) -> str:
    """Return a number with all its decimals, so that all numbers of a row have the same number of decimals."""
    return true_minus(f"{value:.{places}f}")


def decimal(value: float, places: int) -> str:
    """Return a number with a fixed number of decimals and a true minus sign.

    Whole numbers are written without decimals.
    """
    text = f"{value:.{places}f}"
    if "." in text and float(text) == int(float(text)):
        text = text.split(".")[0]
    return "0" if text == "-0" else text.replace("-", "\N{MINUS SIGN}")


def significant(value: float, digits: int) -> str:
    """Return a number rounded to significant digits.

    Numbers with at most seven digits before the decimal point have no exponent.
    """
    if value == 0 or not math.isfinite(value):
        return "0" if value == 0 else MISSING
    size = math.floor(math.log10(abs(value)))
    if not -4 <= size <= 6:  # an exponent is easier to read than many zeros
        return f"{value:.{digits - 1}e}".replace("-", "\N{MINUS SIGN}")
    return decimal(round(value, digits - 1 - size), max(digits - 1 - size, 0))


def at_least(value: float, digits: int = 2) -> str:
    """Return a lower bound with so many significant digits, rounded down.

    >>> at_least(2.057), at_least(0.0999), at_least(0.0)
    ('2', '0.099', '0')
    """
    return significant(_towards(value, digits, math.floor), digits)


def at_most(value: float) -> str:
    """Return an upper bound with three digits, rounded up.

    >>> at_most(2.0531), at_most(18.6), at_most(0.0)
    ('2.06', '18.6', '0')
    """
    return significant(_towards(value, DIGITS, math.ceil), DIGITS)


def overshoot_note(best: Optimum) -> str | None:
    """Return whether the optimum by overshoot is free of overshoot, with the threshold. None for other optima.

    >>> overshoot_note(Optimum(stiffness=1, damping=1, cost=0.0081, resolution=0.0092, free_of_overshoot=True))
    'Without overshoot: up to 0.92 % is within the resolution of this log (5.12).'
    """
    if best.resolution is None or best.free_of_overshoot is None:
        return None
    threshold = f"{at_least(100 * best.resolution)} %"
    if best.free_of_overshoot:
        alone = " Neighbouring walls overshoot by more, so it is no region but a single trial." if best.is_alone else ""
        return f"Without overshoot: up to {threshold} is within the resolution of this log (5.12).{alone}"
    return (
        f"No stable trial is known to be without overshoot; the resolution of this log is {threshold}. "
        "This is the least overshoot."
    )


def damping_range_text(around: DampingRange) -> str:
    """Return the dampings at which a stiffness is stable. Ends are rounded inwards.

    An open end is marked, except at zero damping.

    >>> damping_range_text(DampingRange(low=22.31, high=184, low_is_limit=True, high_is_limit=False, margin=1.2))
    '22.4 to at least 184'
    >>> damping_range_text(DampingRange(low=0, high=101.18, low_is_limit=False, high_is_limit=True, margin=1.2))
    '0 to 101'
    """
    low = f"{'' if around.low_is_limit or around.low == 0 else 'at most '}{_shortest(at_most(around.low))}"
    high = _shortest(at_least(around.high, DIGITS))
    return f"{low} to {'' if around.high_is_limit else 'at least '}{high}"


def _towards(value: float, digits: int, whole: Callable[[float], int]) -> float:
    """Return a number rounded to significant digits in one direction, without the effect of rounding errors."""
    if value == 0 or not math.isfinite(value):
        return value
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - digits + 1)
    share = value / unit
    nearest = round(share)
    return (nearest if abs(share - nearest) <= 1e-9 * abs(share) else whole(share)) * unit


def stiffness_text(value: float) -> str:
    """Return a stiffness as printed in Tables D.1 to D.5. At 100 or more, it is an integer. Below 100, it has at most
    four digits.

    >>> stiffness_text(4469.4), stiffness_text(4.5), stiffness_text(33.25)
    ('4469', '4.5', '33.25')
    """
    return decimal(value, 0) if abs(value) >= 100 else _shortest(significant(value, 4))


def damping_text(value: float) -> str:
    """Return a damping as printed in Tables D.1 to D.5. It has at most two decimals, and below 1 at most three digits.

    >>> damping_text(73.054), damping_text(22.5), damping_text(0.25)
    ('73.05', '22.5', '0.25')
    """
    return _shortest(decimal(value, 2) if abs(value) >= 1 or value == 0 else significant(value, 3))


def _shortest(text: str) -> str:
    """Return a number without zeros at the end of its decimals, because 4.500 may be read as 4500."""
    return text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text


def cost_text(criterion: str, value: float) -> str:
    """Return a cost as printed in Tables D.1 to D.6. It has two decimals, or one if it is at least 1000. Overshoot is
    in %."""
    printed = value * printed_scale(criterion)
    return decimal(printed, 2 if abs(printed) < 1000 else 1)


def cost_range_text(criterion: str, low: float, high: float) -> str:
    """Return a range of costs as ``low to high unit`` with three digits each, or one number if both print the same.

    >>> cost_range_text("overshoot", 1.85e-16, 0.0212)
    '0 to 2.12 %'
    """
    unit = criterion_of(criterion).family.printed_unit
    ends = (0.0 if abs(cost) < ALL_BUT_ROUNDING else cost for cost in (low, high))
    text = range_text(lambda cost: _shortest(significant(cost * printed_scale(criterion), 3)), *ends)
    return f"{text} {unit}" if unit else text


def published_text(value: float) -> str:
    """Return a published value with exactly the published digits (at most six)."""
    return f"{value:.7g}".replace("-", "\N{MINUS SIGN}")


def percent_text(value: float, places: int = 1) -> str:
    """Return a deviation with its sign and one decimal, as in Table D.6. A very large deviation is expressed in words.

    >>> percent_text(-7.5), percent_text(537261.9)
    ('−7.5', 'over +1000')
    """
    if value > BEYOND:
        return f"over +{BEYOND:.0f}"
    text = f"{value:+.{places}f}"
    return f"{0:.{places}f}" if float(text) == 0 else text.replace("-", "\N{MINUS SIGN}")


def share_text(value: float, places: int = 1) -> str:
    """Return a share in percent. A share below 1 is never rounded to 100 %.

    Parameters
    ----------
    value : float
        Share, between 0 and 1.
    places : int
        Number of decimals. One decimal is used where fewer would round a share to 0 % or 100 % although it is neither.
    """
    if value == 0.0 or abs(value - 1) <= ALL_BUT_ROUNDING:
        return decimal(100 * value, 0)
    text = f"{100 * value:.{places}f}"
    if float(text) in (0.0, 100.0):
        text = f"{100 * value:.1f}"
    return "99.9" if text == "100.0" else text


def estimate_texts(estimate: Estimate | AnswerEstimate) -> tuple[str, str, str]:
    """Return the value of an estimate and both ends of its interval, in the format of `interval_texts`."""
    return interval_texts(estimate.value, estimate.low, estimate.high)


def answer_texts(estimate: AnswerEstimate) -> tuple[str, str]:
    """Return the value of an estimate of the first screen with its unit, and its interval, as text.

    A parameter that cannot be negative and is not distinguished from zero is ``none``, with its upper bound. An
    interval narrower than `TIGHT` on both sides of its value is printed as one relative number, because equal digits
    are not informative.

    >>> answer_texts(AnswerEstimate(name="mass", value=0.1900002, low=0.1899991, high=0.1900013, unit="kg"))
    ('0.1900 kg', 'within 0.001 %')
    >>> answer_texts(AnswerEstimate(name="damping", value=4.5e-6, low=0.0, high=4.71e-5, unit="Ns/m"))
    ('none', 'below 4.71e−05 Ns/m')
    """
    value, low, high = estimate.value, estimate.low, estimate.high
    if estimate.reason:
        return "not identifiable", estimate.reason.removeprefix("not identifiable: ")
    unseen = estimate.name in ("damping", "friction") and not (low or 0.0) > 0 and high is not None
    if value is None or (unseen and high is not None and value < NEAR_ZERO * high):
        return "none", "" if high is None else f"below {at_most(high)} {estimate.unit}"
    if low is not None and high is not None and (around := relative_text(value, low, high)):
        return f"{fixed_digits(value, ANSWER_DIGITS)} {estimate.unit}", around
    shown, first, last = _with_equal_decimals(interval_texts(value, low, high, ANSWER_DIGITS), (value, low, high))
    if low is None and high is None:
        interval = MISSING
    elif low is None or high is None:
        interval = f"at least {first}" if high is None else f"at most {last}"
    elif shown in (first, last):
        interval = "as shown" if first == last else f"up to {last}" if shown == first else f"from {first}"
    else:
        interval = f"{first} to {last}"
    return f"{shown} {estimate.unit}", interval


def _with_equal_decimals(
    texts: tuple[str, str, str], numbers: tuple[float | None, float | None, float | None]
) -> tuple[str, str, str]:
    """Return the texts of an interval. All have the smallest number of decimals of its ends and its value.

    >>> _with_equal_decimals(("1.0000", "0.9985", "1.001"), (1.00001, 0.99852, 1.0013))
    ('1.000', '0.999', '1.001')
    """
    decimals = [len(text.partition(".")[2]) for text in texts if text and text != "0"]
    if None in numbers or any("e" in text for text in texts) or len(set(decimals)) < 2 or not min(decimals):
        return texts
    first, second, third = (fixed(number, min(decimals)) if number else "0" for number in numbers)
    return first, second, third


def relative_text(value: float, low: float, high: float) -> str:
    """Return the larger side of an interval in percent of its value, with one digit, or "" if it is not below `TIGHT`.

    >>> relative_text(0.57984, 0.57948, 0.58019), relative_text(2.0, 1.9, 2.1)
    ('± 0.07 %', '')
    """
    percent = 100 * max(high - value, value - low) / abs(value) if value else math.inf
    if not 0 <= percent < TIGHT:
        return ""
    return "within 0.001 %" if percent < 1e-3 else f"± {significant(_towards(percent, 1, math.ceil), 1)} %"


def fixed_digits(value: float, digits: int) -> str:
    """Return a number with significant digits, of which zeros after the decimal point are kept.

    >>> fixed_digits(2.00003, 4), fixed_digits(10845.2, 4)
    ('2.000', '10845')
    """
    return _with_zeros(value, significant(value, digits), digits)


def interval_texts(
    value: float | None, low: float | None, high: float | None, most: int = MOST_DIGITS
) -> tuple[str, str, str]:
    """Return a value and both ends of its interval, rounded to two digits of the half width. Missing numbers are empty.

    There are at most ``most`` digits. A one-sided bound is rounded conservatively, so that a lower bound is rounded
    down and an upper bound is rounded up.

    >>> interval_texts(2.00003, 1.99995, 2.00011), interval_texts(-20.5, -41.8, 0.836)
    (('2.000030', '1.999950', '2.000110'), ('−20.5', '−41.8', '0.836'))
    """
    given = (value, low, high)
    largest = max((abs(x) for x in given if x is not None), default=0.0)
    half = 0.0 if low is None or high is None else 0.5 * (high - low)
    digits = DIGITS
    if 0 < half < largest:
        needed = math.floor(math.log10(largest)) - math.floor(math.log10(half)) + 2
        digits = min(max(needed, DIGITS), most)
    texts = ["" if x is None else significant(x, digits) for x in given]
    if low is None and high is not None:
        texts[2] = significant(_towards(high, digits, math.ceil), digits)
    if high is None and low is not None:
        texts[1] = significant(_towards(low, digits, math.floor), digits)
    if any("." in text for text in texts):  # next to decimals, a whole number gets zeros to show its digits
        texts = [t if x is None else _with_zeros(x, t, digits) for x, t in zip(given, texts, strict=True)]
    return texts[0], texts[1], texts[2]


def _with_zeros(value: float, text: str, digits: int) -> str:
    if value == 0 or not text.strip("\N{MINUS SIGN}").isdecimal():
        return text
    places = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{places}f}".replace("-", "\N{MINUS SIGN}")

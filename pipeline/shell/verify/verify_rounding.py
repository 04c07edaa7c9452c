"""What counts as the same number or text on another machine: equal up to rounding.

Other processors, and other builds of numpy, add in another order. That moves the last digits of a sum, by which a
printed number may round the other way.
"""

from __future__ import annotations

import math
import re

RELATIVE = 1e-5
"""Relative difference that rounding explains: the place of a flat optimum is known to the root of the precision, 1e-8,
and what is left of a difference of two such numbers to fewer digits."""

PERCENT = 1e-5
"""Difference of percentages that rounding explains, for the same reason: they are differences from 100 %."""

TREND = 1e-12
"""Difference of slopes that rounding explains [unit of the estimate per N/m, Ns/m and so on]: over a tested range of
10,000 N/m it comes to 1e-8 of the estimate. Slopes of what does not drift are sums that cancel."""

NOTHING = 1e-9
"""Numbers in sentences below which all count as zero: growth of 2e-13 1/s, say, is what rounding left of none."""

_NUMBER = re.compile(r"[\N{MINUS SIGN}-]?\d+(?:\.(\d+))?(?:[eE][+\N{MINUS SIGN}-]?\d+)?")


def same_value(place: str, a: object, b: object) -> bool:
    """Tell whether two values of a JSON document differ by rounding only; ``place`` ends with the value's key."""
    if isinstance(a, str) and isinstance(b, str):
        return same_text(a, b)
    if isinstance(a, bool) or isinstance(b, bool):
        return a is b
    if not (isinstance(a, float) and isinstance(b, float)):
        return a == b
    floor = PERCENT if place.endswith("_percent") else TREND if "/trend/" in place else 0.0
    return math.isclose(a, b, rel_tol=RELATIVE, abs_tol=floor)


def same_text(a: str, b: str) -> bool:
    """Tell whether two texts differ at most by one in the last digit of numbers with a decimal point."""
    if a == b:
        return True
    first, second = list(_NUMBER.finditer(a)), list(_NUMBER.finditer(b))
    if _NUMBER.sub("#", a) != _NUMBER.sub("#", b):
        return False
    return all(_same_number(x, y) for x, y in zip(first, second, strict=True))


def _same_number(a: re.Match[str], b: re.Match[str]) -> bool:
    if a[0] == b[0]:
        return True
    first, second = (text[0].replace("\N{MINUS SIGN}", "-") for text in (a, b))
    if "e" in (first + second).lower():
        return max(abs(float(first)), abs(float(second))) < NOTHING
    places = len(a[1] or "")
    if not places or places != len(b[1] or ""):
        return False
    # counted in the last place, so that 0.2 - 0.1 is 1
    return abs(int(first.replace(".", "")) - int(second.replace(".", ""))) <= 1

"""What counts as the same number, text or drawing on another machine: equal up to rounding.

Other processors, and other builds of numpy, add in another order. That moves the last digits of a sum, by which a
printed number may round the other way, and a contour line may begin at another of its points.
"""

from __future__ import annotations

import math
import re

import numpy as np

from pipeline.base.errors import PipelineError
from pipeline.records.batch import Floats

RELATIVE = 1e-5
"""Relative difference that rounding explains: the place of a flat optimum is known to the root of the precision, 1e-8,
and what is left of a difference of two such numbers to fewer digits."""

PERCENT = 1e-5
"""Difference of percentages that rounding explains, for the same reason: they are differences from 100 %."""

TREND = 1e-12
"""Difference of slopes that rounding explains [unit of the estimate per N/m, Ns/m and so on]: over a tested range of
10,000 N/m it comes to 1e-8 of the estimate. Slopes of what does not drift are sums that cancel."""

SEEN = 5.0
"""Distance of two lines [tenths of a pixel] that is none: both leave points out that lie within 1.5 of the line, and
are rounded to 0.5; what is below half a pixel is not seen."""

NOTHING = 1e-9
"""Numbers in sentences below which all count as zero: growth of 2e-13 1/s, say, is what rounding left of none."""

_NUMBER = re.compile(r"[\N{MINUS SIGN}-]?\d+(?:\.(\d+))?(?:[eE][+\N{MINUS SIGN}-]?\d+)?")
_PATH = re.compile(r' d="([^"]*)"')
_LINES = re.compile(r"[MmlLhvz\d\s.-]*")
_TOKEN = re.compile(r"[a-zA-Z]|-?\d*\.?\d+")


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


def same_drawing(a: str, b: str) -> bool:
    """Tell whether two drawings look the same: equal texts and styles, and lines within `SEEN` of each other.

    Parameters
    ----------
    a, b : str
        ``<svg>`` elements as `rendering.svg` writes them, which counts in tenths of a pixel.
    """
    first, second = _PATH.findall(a), _PATH.findall(b)
    if len(first) != len(second) or not _same_frame(_PATH.sub("", a), _PATH.sub("", b)):
        return False
    return all(x == y or _same_path(x, y) for x, y in zip(first, second, strict=True))


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


def _same_frame(a: str, b: str) -> bool:
    """Compare what is no path: words may round otherwise, places may move by a tenth of a pixel."""
    first, second = (_TOKEN_OR_REST.findall(text) for text in (a, b))
    if len(first) != len(second):
        return False
    return all(x == y or same_text(x, y) or _near(x, y) for x, y in zip(first, second, strict=True))


_TOKEN_OR_REST = re.compile(r'(?<==")-?\d+(?=")|(?:(?!(?<==")-?\d+").)+', re.DOTALL)
"""Whole numbers that are a whole attribute, and all between them."""


def _near(a: str, b: str) -> bool:
    try:
        return abs(int(a) - int(b)) <= 1
    except ValueError:
        return False


def _same_path(a: str, b: str) -> bool:
    if not (_LINES.fullmatch(a) and _LINES.fullmatch(b)):
        return False
    one, other = _segments(a), _segments(b)
    return _farthest(one, other) <= SEEN and _farthest(other, one) <= SEEN


def _segments(data: str) -> Floats:
    """Return the segments of path data of straight lines, (n, 4): x and y of both ends; a lone point is one, too."""
    segments: list[tuple[float, float, float, float]] = []
    x = y = first_x = first_y = 0.0
    tokens = _TOKEN.findall(data)
    command, i = "", 0
    while i < len(tokens):
        if tokens[i].isalpha():
            command, i = tokens[i], i + 1
            if command == "z":
                segments.append((x, y, first_x, first_y))
                x, y = first_x, first_y
                continue
        if command in "hv":
            dx, dy = (float(tokens[i]), 0.0) if command == "h" else (0.0, float(tokens[i]))
            i += 1
        elif command in "MmlL":
            dx, dy = float(tokens[i]), float(tokens[i + 1])
            i += 2
        else:
            raise PipelineError(f"drawing: path data {data[:40]!r} are not of the commands M, m, l, h, v, z")
        new_x, new_y = (dx, dy) if command in "ML" else (x + dx, y + dy)
        if command in "Mm":
            first_x, first_y = new_x, new_y
            segments.append((new_x, new_y, new_x, new_y))
        else:
            segments.append((x, y, new_x, new_y))
        x, y = new_x, new_y
    return np.array(segments, dtype=np.float64).reshape(-1, 4)


def _farthest(points: Floats, lines: Floats) -> float:
    """Return the largest distance of an end of segments from the nearest of other segments."""
    if not len(points) or not len(lines):
        return 0.0 if len(points) == len(lines) else math.inf
    start, along = lines[:, :2], lines[:, 2:] - lines[:, :2]
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    farthest = 0.0
    # in portions: drawings with many lines would fill the memory
    for part in np.array_split(points[:, 2:], max(1, len(points) * len(lines) // 1_000_000)):
        away = part[:, None] - start
        share = np.clip((away * along).sum(axis=2) / length, 0.0, 1.0)
        rest = away - share[..., None] * along
        farthest = max(farthest, float(np.sqrt((rest**2).sum(axis=2)).min(axis=1).max(initial=0.0)))
    return farthest

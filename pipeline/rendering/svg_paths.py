"""Path data of a drawing in few characters: points that are seen, whole numbers, relative to each other.

Numbers count in tenths of a pixel (`UNIT`): whole numbers need no decimal point.
"""

from __future__ import annotations

import re

import numpy as np

from pipeline.rendering.polyline import needed_points

UNIT = 10
"""Units a pixel: a tenth of a pixel is below what any screen or printer shows of a line."""
SEEN = 1.5
"""Largest distance of a left-out point from its line [units]: 0.15 px, a tenth of the usual line."""

_SUBPATH = re.compile(r"M[^M]+")
_TOKEN = re.compile(r"[A-Za-z]|-?[\d.]+(?:e-?\d+)?")
_SIGN = re.compile(r" (?=-)")


def compact_path(data: str) -> str:
    """Return path data of lines and curves, absolute and in pixels, in relative whole units.

    Parameters
    ----------
    data : str
        Commands ``M``, ``L``, ``Q``, ``C`` and ``z`` with absolute coordinates, as a drawing library writes them.
    """
    curved = [part for part in _SUBPATH.findall(data) if "C" in part or "Q" in part]
    straight = [part for part in _SUBPATH.findall(data) if not ("C" in part or "Q" in part)]
    return "".join(_curve(part) for part in curved) + _lines(straight)


def _lines(parts: list[str]) -> str:
    """Polylines: points that are not seen are left out."""
    if not parts:
        return ""
    closed = [part.rstrip()[-1] in "zZ" for part in parts]
    numbers = [np.array(part.translate(_NO_LETTERS).split(), dtype=np.float64).reshape(-1, 2) for part in parts]
    points = np.round(np.concatenate(numbers) * UNIT)
    lengths = np.array([len(line) for line in numbers])
    starts = np.cumsum(lengths) - lengths
    whole: list[list[int]] = points.astype(np.int64).tolist()
    if (lengths > 2).any():
        keep = needed_points(points, starts, SEEN)
        whole = [point for point, kept in zip(whole, keep.tolist(), strict=True) if kept]
        lengths = np.add.reduceat(keep, starts)
    ends = np.cumsum(lengths).tolist()
    return line_data([whole[a:b] for a, b in zip([0, *ends], ends, strict=False)], closed)


_NO_LETTERS = str.maketrans("MLzZ", "    ")


def line_data(lines: list[list[list[int]]], closed: list[bool]) -> str:
    """Return path data of polylines, each a list of points in whole units, written relative to the point before."""
    text: list[str] = []
    x0 = y0 = 0
    for line, ends in zip(lines, closed, strict=True):
        first_x, first_y = x, y = line[0]
        text.append(f"{'m' if text else 'M'}{x - x0} {y - y0}")
        if ends and len(line) > 1 and line[-1] == line[0]:
            line = line[:-1]  # closing the path draws the last step
        steps = []
        for next_x, next_y in line[1:]:
            if next_x != x or next_y != y:
                steps.append((next_x - x, next_y - y))
                x, y = next_x, next_y
        text.append(_steps(steps) + ("z" if ends else "" if steps else "h0"))
        # after "z" a path stands at its beginning again
        x0, y0 = (first_x, first_y) if ends else (x, y)
    return _SIGN.sub("", "".join(text))


def _steps(steps: list[tuple[int, int]]) -> str:
    if len(steps) == 1 and 0 in steps[0]:
        across, down = steps[0]
        return f"h{across}" if down == 0 else f"v{down}"
    return "l" + " ".join(f"{across} {down}" for across, down in steps) if steps else ""


def _curve(part: str) -> str:
    """Curves keep all their points; they are the markers of a few pixels."""
    tokens = _TOKEN.findall(part)
    text = [token if token.isalpha() else str(round(float(token) * UNIT)) for token in tokens]
    return _SIGN.sub("", re.sub(r" ?([A-Za-z]) ?", r"\1", " ".join(text)))

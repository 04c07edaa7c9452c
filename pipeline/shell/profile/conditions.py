"""Units of the walls that logs state, by comparison with the walls that their commands follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.units import UNITS, split_quantity, unit_between
from pipeline.profiles.profile_model import Kind, quantity, si_unit
from pipeline.readers.file_columns import FileColumns, Scalar

SAME = 0.1
"""Part by which a number may differ from what the command obeys: names are rounded."""

MOST_AT_FAULT = 0.2
"""Part of the logs that may contradict what is proposed for all: with more of them the proposal is wrong."""

FEWEST_DIFFERENT = 2
"""Different numbers that are proportional to what commands obey, from which on that is no chance."""

Numbers = Sequence[float | None]


def factor_of(numbers: Numbers, obeyed: Sequence[float]) -> float | None:
    """Return by what most numbers have to be multiplied to be what commands obey; None where no one factor does it.

    Up to `MOST_AT_FAULT` of them may be wrong: those are named when the logs are read.

    >>> factor_of([1.0, 2.0, 0.0], [1000.0, 2000.0, 0.0]), factor_of([1.0, 2.0], [5.0, 5.0])
    (1000.0, None)
    """
    pairs = list(zip(numbers, obeyed, strict=True))
    ratios = sorted(value / number for number, value in pairs if number and value)
    if not ratios:
        return None
    middle = ratios[len(ratios) // 2]
    agree = sum(abs(ratio / middle - 1) <= SAME for ratio in ratios)
    # what makes no part of a command that is seen says nothing
    off = len(ratios) - agree + sum(bool(value and not number) for number, value in pairs)
    known = 2 * (agree + sum(not (number or value) for number, value in pairs)) > len(pairs)
    return middle if middle > 0 and known and off <= MOST_AT_FAULT * len(pairs) else None


def proved_unit(numbers: Numbers, obeyed: Sequence[float], key: str, kind: Kind) -> str | None:
    """Return the unit in which numbers are what commands obey [SI]; None where they are not."""
    middle = factor_of(numbers, obeyed)
    if middle is None:
        return None
    si = si_unit(quantity(key, kind))
    unit = si if abs(middle - 1) <= SAME else unit_between(si, middle, SAME)
    return "N/mm" if unit == "kN/m" else unit


def numbers_inside(contents: Sequence[FileColumns]) -> dict[tuple[str, str], Numbers]:
    """Return the numbers that files, or trials of a file, state: values outside the table and constant columns.

    They are by the table of a profile (``attributes``, ``condition_columns``) and their name. Those that have a unit
    behind them are in SI.
    """
    first = contents[0]
    found: dict[tuple[str, str], Numbers] = {}
    for name in first.attributes:
        numbers = [_number(each.attributes.get(name)) for each in contents]
        if any(number is not None for number in numbers):
            found["attributes", name] = numbers
    for name in first.columns:
        columns = [each.columns[name] for each in contents if name in each.columns]
        if len(columns) == len(contents) and all(c.dtype.kind != "U" and len(c) > 1 and not np.ptp(c) for c in columns):
            found["condition_columns", name] = [float(column[0]) for column in columns]
    return found


def _number(value: Scalar | None) -> float | None:
    """Return the number of a value outside the table, in SI where it has a unit; None where it is no number."""
    if isinstance(value, int | float):
        return float(value)
    try:
        found = split_quantity((value or "").replace("[", " ").replace("]", " "))
    except ParameterError:
        return None
    return None if found is None else found[0] * (UNITS[found[1]].factor if found[1] in UNITS else 1.0)


def place_of(
    inside: Mapping[tuple[str, str], Numbers], obeyed: Sequence[float], names: Sequence[str]
) -> tuple[str, str] | None:
    """Return where numbers stand that are proportional to what commands obey, by table and name; None where nowhere.

    One whose name is one of some for the condition comes first; any other needs so many different numbers that it is no
    chance.
    """
    for named in (True, False):
        for place, numbers in inside.items():
            fits = place[1].split(".")[-1].split("/")[-1].lower() in names
            if fits != named or factor_of(numbers, obeyed) is None:
                continue
            if named or len({number for number in numbers if number}) >= FEWEST_DIFFERENT:
                return place
    return None

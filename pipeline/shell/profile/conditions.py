"""Units of stated walls, found by comparison with the walls that the commands follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.units import UNITS, split_quantity, unit_between
from pipeline.profiles.profile_model import Kind, quantity, si_unit
from pipeline.readers.file_columns import FileColumns, Scalar

SAME = 0.1
"""Relative tolerance between a stated number and the gain that the command follows. Numbers in names are rounded."""

MOST_AT_FAULT = 0.2
"""Largest share of logs that may contradict a common proposal. If more contradict it, the proposal is wrong."""

FEWEST_DIFFERENT = 2
"""Smallest number of different values that must be proportional to the gains of the commands, so that agreement by
chance is excluded."""

Numbers = Sequence[float | None]


def factor_of(numbers: Numbers, followed: Sequence[float]) -> float | None:
    """Return the common factor by which numbers are multiplied to obtain the gains that commands follow, or None if
    there is none.

    At most the share `MOST_AT_FAULT` of the numbers may be wrong. Wrong numbers are reported when the logs are read.

    >>> factor_of([1.0, 2.0, 0.0], [1000.0, 2000.0, 0.0]), factor_of([1.0, 2.0], [5.0, 5.0])
    (1000.0, None)
    """
    pairs = list(zip(numbers, followed, strict=True))
    ratios = sorted(value / number for number, value in pairs if number and value)
    if not ratios:
        return None
    middle = ratios[len(ratios) // 2]
    agree = sum(abs(ratio / middle - 1) <= SAME for ratio in ratios)
    # Gains without a visible contribution to the command give no information.
    off = len(ratios) - agree + sum(bool(value and not number) for number, value in pairs)
    known = 2 * (agree + sum(not (number or value) for number, value in pairs)) > len(pairs)
    return middle if middle > 0 and known and off <= MOST_AT_FAULT * len(pairs) else None


def proved_unit(numbers: Numbers, followed: Sequence[float], key: str, kind: Kind) -> str | None:
    """Return the unit in which numbers equal the gains [SI] that commands follow, or None if there is none."""
    middle = factor_of(numbers, followed)
    if middle is None:
        return None
    si = si_unit(quantity(key, kind))
    unit = si if abs(middle - 1) <= SAME else unit_between(si, middle, SAME)
    return "N/mm" if unit == "kN/m" else unit


def numbers_inside(contents: Sequence[FileColumns]) -> dict[tuple[str, str], Numbers]:
    """Return the numbers stated in files, or in trials of a file: values outside the table, and constant columns.

    A key consists of the profile table (``attributes``, ``condition_columns``) and the name. Numbers followed by a unit
    are converted to SI.
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
    """Return a value outside the table as a number, in SI if the value has a unit, or None if it is not a number."""
    if isinstance(value, int | float):
        return float(value)
    try:
        found = split_quantity((value or "").replace("[", " ").replace("]", " "))
    except ParameterError:
        return None
    return None if found is None else found[0] * (UNITS[found[1]].factor if found[1] in UNITS else 1.0)


def place_of(
    inside: Mapping[tuple[str, str], Numbers], followed: Sequence[float], names: Sequence[str]
) -> tuple[str, str] | None:
    """Return the table and the name of numbers that are proportional to the gains of the commands, or None if there are
    none.

    A usual name of the condition is preferred. For any other name, enough different values are required, so that
    agreement by chance is excluded.
    """
    for named in (True, False):
        for place, numbers in inside.items():
            fits = place[1].split(".")[-1].split("/")[-1].lower() in names
            if fits != named or factor_of(numbers, followed) is None:
                continue
            if named or len({number for number in numbers if number}) >= FEWEST_DIFFERENT:
                return place
    return None

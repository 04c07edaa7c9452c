"""Decimal stamps of a clock that counts from a date, such as 1700000000.123456 s since 1970, as whole numbers.

Seconds since 1970 as a float are wrong by up to 0.12 us, so that steps of 1 ms would seem to jitter. Whole numbers are
exact; `pipeline.readers.time_axis` takes the first one off before it makes seconds of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.base.units import factor_to_si
from pipeline.profiles.profile_columns import TimeSource
from pipeline.records.batch import Integers

DATE_S = 2.0**28
"""Seconds from zero (8.5 years) beyond which a stamp is a date: no machine runs that long, and the origins in use
(1904, 1970, 1980, 2000) are farther away. Nearer than this, floats of seconds are right to 30 ns."""

_LONGEST = 19
"""Digits of the largest whole number of 64 bits; those that begin with 93 or more have one digit too many."""

_DECIMAL = r"^[+-]?[0-9]+[.]?[0-9]*$"


def are_dates(ticks: NDArray[Any], tick_s: float) -> bool:
    """Return whether stamps count from a date.

    Parameters
    ----------
    ticks : float64 or integers, shape (rows,)
        Stamps, none of them missing.
    tick_s : float
        Seconds of one.

    >>> are_dates(np.array([1_700_000_000_000]), 1e-3), are_dates(np.array([86_400_000]), 1e-3)
    (True, False)
    """
    return bool(len(ticks)) and float(np.abs(ticks.astype(np.float64)).min()) * tick_s > DATE_S


def whole_dates(source: TimeSource, text: pa.Array) -> tuple[Integers, int] | None:
    """Return decimal stamps as whole numbers, and how many decimals they had.

    Parameters
    ----------
    source : TimeSource
    text : Array of strings, length rows
        Stamps with a decimal point; null where there is none.

    Returns
    -------
    tuple of (int64 of shape (rows,), int), or None
        Stamp times 10^decimals (0 where there is none), and the decimals of the longest stamp; digits that do not fit
        into 64 bits are cut, which are those behind the 8th or 9th decimal of seconds. None where the stamps count
        from no date, are no plain decimals, or are counted in a way that needs no such care.
    """
    # 20 ms that native logs need not pay
    import pyarrow.compute as pc

    plain = source.kind in ("absolute", "counter", "sampled") and source.wrap is None and source.fraction is None
    if not plain or source.unit is None or not pc.all(pc.match_substring_regex(text, _DECIMAL)).as_py():
        return None
    values = pc.cast(pc.utf8_ltrim(text, "+"), pa.float64()).to_numpy(zero_copy_only=False)
    there = ~np.isnan(values) & ~np.isin(values, source.sentinels)
    tick_s = factor_to_si(source.unit, ("time",)) / (source.counts_per_unit or 1.0)
    if not are_dates(values[there], tick_s):
        return None
    kept = pc.if_else(pa.array(there), pc.utf8_ltrim(text, "+"), "0")
    whole, rest = (pc.replace_substring_regex(kept, r"^(-?[0-9]+)[.]?([0-9]*)$", part) for part in (r"\1", r"\2"))
    digits = pc.max(pc.utf8_length(pc.utf8_ltrim(whole, "-"))).as_py()
    longest = pc.max(pc.utf8_length(rest)).as_py()
    for decimals in sorted({max(min(longest, _LONGEST - digits - cut), 0) for cut in (0, 1)}, reverse=True):
        padded = pc.utf8_rpad(pc.utf8_slice_codeunits(rest, 0, decimals), decimals, "0")
        try:
            ticks = pc.cast(pc.binary_join_element_wise(whole, padded, ""), pa.int64())
        except pa.ArrowInvalid:
            continue
        return ticks.to_numpy(zero_copy_only=False), decimals
    return None

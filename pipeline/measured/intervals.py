"""Factors of 95 % intervals: of a normal distribution, and of Student's for few degrees of freedom."""

from __future__ import annotations

import numpy as np

from pipeline.records.batch import Floats

CONFIDENCE = 0.95
"""Coverage of every interval."""

NORMAL_95 = 1.959963984540054
"""Half width of the 95 % interval of a normal distribution in standard deviations."""

NORMAL_QUARTILE = 0.6744897501960817
"""Median of the absolute value of a standard normal variable."""


ROUNDING = 1e-12
"""Smallest standard error relative to the largest value: what computing a value in doubles leaves."""

SMALLEST = float(np.sqrt(np.finfo(np.float64).tiny))
"""Smallest standard error of a value that is zero: its square is still a number."""


def student_95(freedom: object) -> Floats:
    """Return the factor of a 95 % interval with few degrees of freedom (Student's t), NaN below one.

    Parameters
    ----------
    freedom : array_like, shape (...)
        Degrees of freedom, also fractional and infinite.

    Notes
    -----
    Above three the asymptotic series of the quantile in 1/freedom, good to 0.2 %; exact for one, two and three, and
    interpolated between them.

    Source: Abramowitz and Stegun 1964, eq. 26.7.5.
    """
    f = np.asarray(freedom, dtype=np.float64)
    n = np.where(f >= 1, f, np.nan)
    z = NORMAL_95
    series = (
        z
        + (z**3 + z) / (4 * n)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
        + (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / (92160 * n**4)
    )
    few = np.interp(1 / n, [1 / 3, 1 / 2, 1], [3.182446305, 4.302652730, 12.706204736])
    result: Floats = np.where(n <= 3, few, series)
    return result

"""Factors of 95 % intervals, for a normal distribution and for Student's t with few degrees of freedom."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from pipeline.records.trials import Floats

CONFIDENCE = 0.95
"""Coverage of all intervals."""

SIGMAS = 3.0
"""Number of standard deviations beyond which two values differ significantly (0.3 % of normal values exceed it)."""

NORMAL_95 = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
"""Half-width of the 95 % interval of a normal distribution in standard deviations."""

NORMAL_QUARTILE = NormalDist().inv_cdf(0.75)
"""Median of the absolute value of a standard normal variable."""

ROUNDING = 1e-12
"""Relative rounding error between equal values in double precision. It is also the smallest standard error."""

SMALLEST = float(np.sqrt(np.finfo(np.float64).tiny))
"""Smallest standard error of a value that is zero. Its square does not underflow."""


def student_95(freedom: object) -> Floats:
    """Return the factor of a 95 % interval with few degrees of freedom (Student's t). It is NaN below one degree.

    Parameters
    ----------
    freedom : array_like, shape (...)
        Degrees of freedom, which may be fractional or infinite.
    """
    from scipy.special import stdtrit

    f = np.asarray(freedom, dtype=np.float64)
    return np.asarray(stdtrit(np.where(f >= 1, f, np.nan), 0.5 + CONFIDENCE / 2))

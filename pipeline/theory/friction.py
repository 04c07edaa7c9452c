"""What linear theory cannot hold, as overlays beside it: Coulomb friction, and friction with a coarse sensor.

Both are normalised like the loop: a force is one of m (position unit)/T^2. Neither changes what is computed elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.theory.limits import limits

_SLIDING = 0.5
"""Largest friction, as a share of the mass's own force at the turning points, at which motion is taken for a sine."""

_EQUIVALENTS = 12
"""Equivalent dampings that are tried: neighbours differ by half or less."""

_SEEN = 0.1
"""Limit, as a share of the largest, of the dampings that say which equivalent dampings to try."""


def step_limits(loop: Loop, beta: Floats, share: float) -> Floats:
    """Return the limit at dampings for oscillations as large as a step's way, F_0/(K + k); nan where not valid.

    Parameters
    ----------
    loop : Loop
    beta : float64, shape (n,)
    share : float
        Friction over the step, f_c/F_0, > 0.

    Notes
    -----
    The equivalent damping 4 f_c/(pi omega A) depends on the limit and its frequency themselves. So limits at several
    equivalent dampings are found, with the friction that each belongs to, and joined by lines: to about a hundredth of
    what the friction adds. Valid where motion slides all through: f_c <= m omega^2 A/2.

    The describing function replaces the square wave of the friction by its first harmonic. The wall is the less
    stable the larger the oscillation, so the linear limit is what remains for large ones.

    Source: Slotine and Li 1991, Applied Nonlinear Control, ch. 5 (describing function of a relay).
    """
    first = limits(loop, beta, exact=False)
    typical = 4 * share * (first.alpha + loop.gamma) / (np.pi * first.angle)
    typical = typical[first.alpha > _SEEN * np.nanmax(first.alpha)]
    more = np.geomspace(0.7 * typical.min(), 5 * typical.max(), _EQUIVALENTS)
    each = [first] + [limits(replace(loop, delta=loop.delta + float(one)), beta, exact=False) for one in more]
    added = np.append(0.0, more)[:, None]
    alpha, angle = np.array([one.alpha for one in each]), np.array([one.angle for one in each])
    shares = np.pi * angle * added / (4 * (alpha + loop.gamma))
    result = np.full(len(beta), np.nan)
    for i in range(len(beta)):
        over = np.flatnonzero(shares[:, i] >= share)  # the first: softer walls let the oscillation fade
        if len(over) and over[0] > 0:
            some = slice(over[0] - 1, over[0] + 1)
            stiff, turn = (np.interp(share, shares[some, i], values[some, i]) for values in (alpha, angle))
            if share * (stiff + loop.gamma) <= _SLIDING * turn**2:
                result[i] = stiff
    return result


def quantum_limit(coulomb: float, quantum: float) -> float:
    """Return the stiffness up to which a quantum causes no limit cycle: 2 f_c/quantum, in SI.

    Sufficient, not necessary: nothing is said of stiffer walls.

    Source: Diolaiti et al. 2006; Abbott and Okamura 2005.
    """
    return 2 * coulomb / quantum

"""Theory with the damping of the logs in place of the stated one, which shows what the damping explains.

Source: Hulin 2017, Fig. 6.12 (dashed curves).
"""

from __future__ import annotations

from pipeline.records.findings import Estimate, holds
from pipeline.records.results import SourcedLoop
from pipeline.theory.predictions import Theory


def with_measured_damping(theory: Theory, damping: Estimate) -> Theory | None:
    """Return a theory with the damping of the logs, or None if it agrees with the stated damping or is unknown.

    Parameters
    ----------
    theory : Theory
    damping : Estimate
        Damping of the logs at the wall, per unit of command [Ns/m, Nms/rad], with its 95 % interval. The damping of an
        operator is part of it.

    Notes
    -----
    Theory needs a damping of at least zero. The result is None also if no wall is stable with the measured damping.
    """
    loop = theory.loop
    if damping.value is None or damping.low is None or damping.high is None:
        return None
    if holds(damping.low, loop.apparent().damping, damping.high):
        return None
    operator = loop.operator.damping if loop.operator is not None else 0.0
    own = max(damping.value * loop.force_gain - operator, 0.0)
    damped = Theory(SourcedLoop(loop=loop.with_damping(own), source=f"{theory.source}; damping of the logs"))
    return damped if damped.stabilised else None

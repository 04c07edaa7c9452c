"""Band of stability boundaries that the intervals of mass, damping and delay leave open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.loop import loop_of, wall_units
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import LoopParts
from pipeline.theory.limits import stiffness_limit

MASSES = 5
"""Masses that are tried: over m alone the limit may have an extremum inside the interval. It is flat there: for +-10 %
of m the band misses less than 1e-3 of the limit."""


IDEAL = LoopParts()


@dataclass(frozen=True)
class ParameterBox:
    """Intervals of m [kg, kg m^2], b [Ns/m, Nms/rad] and d [samples], with T [s] and k [N/m, Nm/rad]."""

    mass: tuple[float, float]
    viscous_damping: tuple[float, float]
    delay_samples: tuple[float, float]
    sampling_period_s: float
    stiffness: float = 0.0
    loop: LoopParts = IDEAL


def theory_band(box: ParameterBox, damping: Floats) -> tuple[Floats, Floats]:
    """Return the lowest and the highest stability limit [N/m, Nm/rad] over a box of parameters.

    Parameters
    ----------
    box : ParameterBox
    damping : float64, shape (n,)
        B [Ns/m, Nms/rad].

    Returns
    -------
    low, high : float64, shape (n,)
        Largest stable stiffness at each damping, 0 where none is stable.

    Raises
    ------
    ParameterError
        If an interval is reversed or a parameter outside what theory allows.

    Notes
    -----
    At given B the limit falls with d and grows with b, so that the ends of these intervals give the ends of the band.
    With m it grows on the upper part of a boundary and falls a little on the lower one; `MASSES` are tried.

    Source: Hulin 2017, sec. 3.4 (boundary); band ours.
    """
    for name in ("mass", "viscous_damping", "delay_samples"):
        low, high = getattr(box, name)
        if not low <= high:
            raise ParameterError(f"{name} from {low} to {high}: expected an interval, its lower end first.")

    def limits(b: float, d: float) -> Floats:
        found = []
        for m in np.linspace(*box.mass, MASSES):
            scale = wall_units(float(m), box.sampling_period_s, box.loop)
            loop = loop_of(float(m), b, box.stiffness, d, box.sampling_period_s, box.loop)
            alpha = stiffness_limit(loop, damping / scale.damping)
            found.append(np.maximum(alpha, 0.0) * scale.stiffness)
        return np.stack(found)

    (b_low, b_high), (d_low, d_high) = box.viscous_damping, box.delay_samples
    return limits(b_low, d_high).min(axis=0), limits(b_high, d_low).max(axis=0)

"""Curves of the boundary figures: measured and theoretical limits, conditions beside them, and what estimates allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.loop.loop import LARGEST_DELAY
from pipeline.records.figure_records import Curve
from pipeline.records.findings import Estimate
from pipeline.records.models import Device
from pipeline.records.results import ExperimentResult, UseRegion
from pipeline.theory.friction import quantum_limit, step_limits
from pipeline.theory.limits import robust_outline
from pipeline.theory.passive_curve import boundary_angle, passive_boundary
from pipeline.theory.predictions import Theory

FRICTION_POINTS = 48
"""Dampings at which a limit with friction is computed."""

PASSIVE_POINTS = 40
"""Points of the curved part of a passive region: no chord is off by a pixel."""

SEEN = 0.01
"""Width of a passive region, relative to that of the stable one, from which it is more than a dot: three pixels."""


def theory_curve(theory: Theory, label: str, kind: str = "theory") -> Curve:
    """Return the theoretical boundary in physical units, closed along K = -k."""
    border, units = theory.boundary, theory.units
    stiffness = np.append(border.alpha, -theory.loop.gamma) * units.stiffness
    damping = np.append(border.beta, border.beta[-1]) * units.damping
    return Curve(label, kind, stiffness, damping)


def measured_curve(result: ExperimentResult, label: str = "", *, open_ends: bool = False) -> Curve:
    """Return the measured boundary: the last stable stiffness at each damping, 0 where none was stable.

    Parameters
    ----------
    result : ExperimentResult
    label : str
        The experiment's name where it is not given.
    open_ends : bool
        Whether the curve has its intervals: those of 95 % by the growth rates where there are any, else from the last
        stable to the first unstable trial.
    """
    stable = [p.stable is not None for p in result.boundary]
    # dampings without a stable trial beside those with one close the curve; further ones tell nothing
    points = [p for i, p in enumerate(result.boundary) if any(stable[max(i - 1, 0) : i + 2])]
    both = [(p.low, p.high) if None not in (p.low, p.high) else (p.stable, p.unstable) for p in points]
    low, high = (np.array([ends[side] for ends in both], dtype=np.float64) for side in (0, 1))
    return Curve(
        label or f"experiment {result.experiment}",
        "measured",
        np.array([p.stable or 0.0 for p in points]),
        np.array([p.damping for p in points]),
        np.array([float(p.censored) for p in points]),
        low if open_ends else None,
        high if open_ends else None,
    )


def use_curve(use: UseRegion) -> Curve:
    """Return the outline of the walls to use."""
    K, B = (use.stiffness_low, use.stiffness_high), (use.damping_low, use.damping_high)
    corners = np.array([(K[0], B[0]), (K[1], B[0]), (K[1], B[1]), (K[0], B[1]), (K[0], B[0])])
    return Curve("walls to use", "use", corners[:, 0], corners[:, 1])


def linear_curve(theory: Theory) -> Curve:
    """Return the linear condition K = (b + B)/t_r up to the largest stable stiffness (3.25)."""
    p = theory.parameters
    effective_delay = (p.delay_samples + 0.5) * p.sampling_period_s + p.loop.actuator_lag_s
    stiffness = np.array([0.0, 0.6 * theory.boundary.alpha_max * theory.units.stiffness])
    return Curve("linear condition (3.25)", "linear", stiffness, stiffness * effective_delay - theory.wall_damping)


def passive_curve(theory: Theory) -> Curve | None:
    """Return the outline of the passive region (4.12), or None where there is none that can be seen.

    Nothing is passive with a device without damping, and with little damping the region is a dot beside the stable one.

    Source: Hulin 2017, eqs. 4.8, 4.10 and 4.12.
    """
    p = theory.parameters
    if p.damping <= 0:
        return None
    if p.loop.words() or not p.delay_samples.is_integer():  # (4.8) holds for whole samples of delay
        return _passive_of_device(theory)
    angle = np.linspace(0.0, boundary_angle(p.delay_samples), PASSIVE_POINTS)
    kappa, eta = passive_boundary(p.delay_samples, angle)
    if kappa.max() * p.damping / p.sampling_period_s < SEEN * theory.boundary.alpha_max * theory.units.stiffness:
        return None
    # the straight part leads from the angle 0 to B = -b, and K = 0 back to the other end
    stiffness = np.concatenate([[0.0], kappa, [0.0]]) * p.damping / p.sampling_period_s
    damping = np.concatenate([[-1.0], eta, [-1.0]]) * p.damping
    return Curve("passive region (4.12)", "passive", stiffness, damping)


def _passive_of_device(theory: Theory) -> Curve | None:
    """Passive region of any delay, lag and filter; none where the sensor is beyond a mode, or where it is a dot."""
    found = theory.passive_outline
    if found is None or found[0].max() < SEEN * theory.boundary.alpha_max:
        return None
    alpha, beta = found
    stiffness, damping = (
        np.append(v, v[0]) * s for v, s in ((alpha, theory.units.stiffness), (beta, theory.units.damping))
    )
    return Curve("passive region (of this loop)", "passive", stiffness, damping)


def robust_curve(theory: Theory) -> Curve | None:
    """Return the outline of the walls that are stable with every spring, None for a loop that is not ideal.

    Source: Hulin 2017, sec. 4.3.3.
    """
    p, units = theory.parameters, theory.units
    if p.damping <= 0 or p.loop.words():
        return None
    alpha, beta, _ = robust_outline(theory.loop.delta, p.delay_samples)
    stiffness, damping = np.pad(alpha, 1) * units.stiffness, np.pad(beta, 1, mode="edge") * units.damping
    return Curve("stable with every spring (4.3.3)", "robust", stiffness, damping)


def bound_curve(result: ExperimentResult) -> Curve | None:
    """Return the linear upper bound that a measured boundary shows (as (6.5)), or None where it shows none.

    Source: Hulin 2017, eq. 6.5.
    """
    bound = next((scores.bound for scores in result.scores if scores.bound is not None), None)
    if bound is None:
        return None
    damping = np.array([bound.damping_low, bound.damping_high])
    return Curve("linear upper bound", "bound", bound.stiffness - bound.slope * damping, damping)


@dataclass(frozen=True)
class FrictionFacts:
    """What friction does to a loop: f_c and F_0 [N, Nm], quantum [m, rad] (0: unknown), and where f_c comes from."""

    coulomb: float
    step: float
    quantum: float
    source: str

    def limit(self, gain: float) -> float | None:
        """Return K [N/m, Nm/rad] up to which the quantum causes no limit cycle, None without one."""
        return quantum_limit(self.coulomb, self.quantum) / gain if self.quantum > 0 else None


def friction_facts(device: Device, results: Sequence[ExperimentResult]) -> FrictionFacts | None:
    """Return the Coulomb friction of experiments by the device file, or where that has none by the first estimate."""
    for result in results:
        entry = next((e for e in device.experiments if e.name == result.experiment), None)
        stated = device.loop_of(entry).friction if entry is not None else device.loop.friction
        if stated is not None and stated.coulomb > 0:
            return FrictionFacts(stated.coulomb, device.step, device.sensor.quantum, "device file")
    for result in results:
        found = result.estimates.get("friction")
        if found is not None and found.value is not None and (found.low or 0.0) > 0:
            return FrictionFacts(found.value, device.step, device.sensor.quantum, "estimated from the logs")
    return None


def friction_curves(theory: Theory, facts: FrictionFacts) -> list[Curve]:
    """Return the limit of steps with Coulomb friction, and the line K = 2 f_c/quantum where it is in the picture.

    Source: Slotine and Li 1991, ch. 5 (describing function); Diolaiti et al. 2006.
    """
    gain, units, border = theory.parameters.loop.force_gain, theory.units, theory.boundary
    damping = np.linspace(border.beta.min(), border.beta_max, FRICTION_POINTS + 2)[1:-1]
    stiffness = step_limits(theory.loop, damping, facts.coulomb / gain / facts.step) * units.stiffness
    found = []
    if np.isfinite(stiffness).any():
        found.append(Curve("limit with Coulomb friction", "friction", stiffness, damping * units.damping))
    quiet = facts.limit(gain)
    if quiet is not None and quiet <= max(border.alpha_max * units.stiffness, np.nanmax(stiffness, initial=0.0)):
        ends = np.array([max(damping[0], 0.0), damping[-1]]) * units.damping
        found.append(Curve("2 f_c/Δ: no limit cycle below", "friction", np.full(2, quiet), ends))
    return found


def envelope_curve(result: ExperimentResult) -> Curve | None:
    """Return the band of theory that the intervals of the estimates leave open, or None without its score."""
    band = next((scores.band for scores in result.scores if scores.band is not None), None)
    if band is None:
        return None
    damping, low, high = (np.array(values) for values in (band.damping, band.low, band.high))
    return Curve("band of the estimates", "envelope", high, damping, None, low, high)


def too_late(delay: Estimate) -> bool:
    """Return whether a delay, or what its interval leaves open, is longer than theory is computed for."""
    return max(value for value in (delay.value, delay.high, 0.0) if value is not None) > LARGEST_DELAY


def normalised(curve: Curve, theory: Theory) -> Curve:
    """Return a curve in alpha and beta, with the units of a theory.

    Source: Hulin 2017, Table 3.1.
    """
    k, b = theory.units.stiffness, theory.units.damping
    return Curve(curve.label, curve.kind, curve.stiffness / k, curve.damping / b, curve.censored)

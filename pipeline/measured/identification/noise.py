"""Noise in addition to that of readings, and the Kalman filter that whitens the prediction errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.identification.kernels import filter_gains, steady_gain
from pipeline.measured.identification.motion import Transitions
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats

FORGETS = 1e-6
"""Largest excess of the largest eigenvalue of a filter's errors over 1 due to rounding: a filter forgets its initial
state."""

Gains = tuple[Floats, Floats, Floats, float]
"""K, standard deviation of the errors, transition probabilities of ages, and force of a unit command, for
`kernels.whitened`."""


@dataclass(frozen=True)
class Noise:
    """Random force, and jitter of the delay.

    Parameters
    ----------
    force : float
        Variance of the random force over a sample, relative to that of a reading.
    late : float
        Variance of the force of a unit command, relative to that of a reading; 0 without jitter.
    jitter : float
        Standard deviation of the age of the applied command [samples].
    jitter_error : float
        Standard error of the jitter.
    """

    force: float = 0.0
    late: float = 0.0
    jitter: float = 0.0
    jitter_error: float = 0.0


WHITE = Noise()
"""Noise of the readings alone."""


def gains_of(segments: Segments, transitions: Transitions, noise: Noise, command: Floats) -> Gains:
    """Return the filter for some noise: a steady one for even rows without jitter, else one with gains row by row.

    ``command`` (R,) is the one that acts.
    """
    n, none = transitions.states, np.zeros((3, 0))
    if noise == WHITE:
        return np.zeros((1, n)), np.ones(1), none, 0.0
    kind, F, _, W, _, H, _ = transitions.motion
    if segments.even and noise.late == 0:
        return *_steady(F[0], W[0], H, noise.force), none, 0.0
    ages = transitions.ages
    ageing, covariance = (ages.ageing, ages.covariance) if noise.late else (none, np.zeros((0, 0)))
    gains, spread = filter_gains(
        (segments.first, segments.behind, segments.begin, segments.edge),
        command,
        (kind, F, W, H),
        transitions.pieces[:4],
        (ageing, covariance),
        (noise.force, float(np.sqrt(noise.late))),
    )
    return gains, spread, ageing, float(np.sqrt(noise.late))


def _steady(F: Floats, W: Floats, H: Floats, force: float) -> tuple[Floats, Floats]:
    """Return the gain (1, n) and the standard deviation (1,) of the steady filter.

    They are NaN if it cannot be computed in double precision, e.g. for a device that runs away faster than its readings
    show.
    """
    gain, variance = steady_gain(F, W, H, force)
    errors = F @ (np.eye(len(H)) - np.outer(gain, H))
    computed = variance >= 1.0 and np.isfinite(errors).all()
    if not computed or np.abs(np.linalg.eigvals(errors)).max() > 1.0 + FORGETS:
        gain, variance = np.full_like(gain, np.nan), np.nan
    return gain[None], np.sqrt(np.array([variance]))

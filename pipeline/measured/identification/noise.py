"""Model of the random force and of jitter, and the Kalman filter that whitens the prediction errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.identification.kernels import filter_gains, steady_gain
from pipeline.measured.identification.motion import Transitions
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats

FORGETS = 1e-6
"""Largest amount by which rounding raises the spectral radius of a stable filter above 1."""

Gains = tuple[Floats, Floats, Floats, float]
"""Gains K, standard deviations of the errors, transition probabilities of the ages, and standard deviation of the force
per unit of command, as arguments of `kernels.whitened`."""


@dataclass(frozen=True)
class Noise:
    """Random force and jitter of the delay.

    Parameters
    ----------
    force : float
        Variance of the random force over a sample, relative to the variance of a reading.
    late : float
        Variance of the force per unit of command, relative to the variance of a reading, or 0 without jitter.
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
"""Noise that consists of reading errors only."""


def gains_of(segments: Segments, transitions: Transitions, noise: Noise, command: Floats) -> Gains:
    """Return the filter for a noise. For even rows without jitter, the filter is in steady state. Otherwise, each row
    has separate gains.

    ``command`` (R,) is the applied command.
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
    """Return the gain (1, n) and the standard deviation (1,) of the steady-state filter.

    They are NaN if double precision does not suffice, e.g. for a device that diverges faster than its readings can
    show.
    """
    gain, variance = steady_gain(F, W, H, force)
    errors = F @ (np.eye(len(H)) - np.outer(gain, H))
    computed = variance >= 1.0 and np.isfinite(errors).all()
    if not computed or np.abs(np.linalg.eigvals(errors)).max() > 1.0 + FORGETS:
        gain, variance = np.full_like(gain, np.nan), np.nan
    return gain[None], np.sqrt(np.array([variance]))

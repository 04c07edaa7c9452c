"""Decide whether ramps of a command between grid rows were sent as ramps, or result from the interpolation of steps.

After a step at time t, the displacement of a free device with the lag tau is the acceleration times z^2/2 - tau z +
tau^2 (1 - exp(-z/tau)), with z = k - t. A ramp of n rows with a zero-order hold is the mean of n such steps. Both
models are compared around each ramp. A cubic in time and friction model all other motion. Ramps that the controller
sent share one delay. A step inside an interpolated ramp has a separate delay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.recording.motion import free_response
from pipeline.recording.rows import FEWEST_KNOTS, ordinal, spacing
from pipeline.recording.samples import Samples
from pipeline.records.findings import Finding
from pipeline.records.trials import Floats, Integers

KINK = 1e-3
"""Smallest change of the slope of a command that counts as a kink, relative to its largest change per row."""

OWN_STEPS = 1.25
"""Threshold for the ratio of the residuals for an interpolated command and for a zero-order hold. Above it, the command
is treated as steps."""

SAME_DELAY = 2.5
"""The same threshold for ramps that span one grid interval. It is larger because interpolated steps on the grid have a
common delay, like real ramps."""

MOST_RAMPS = 40
"""Largest number of ramps of a command that are examined individually."""

AROUND = (10, 32)
"""Smallest and largest number of rows before and after a ramp that are used. These rows contain no other ramp."""

LAGS = (0.0, 1.0, 2.0, 4.0, 8.0)
"""Lags of a device in the search [rows]."""

LATEST = 16
"""Largest delay of a device in the search [rows]."""

LIKELIER = (-15.0, 20.0)
"""Limits of the log-likelihood ratio of steps to ramps. Up to the first limit, the command is treated as ramps. From
the second limit on, it is treated as steps."""

BETTER = 2.0
"""Threshold for the ratio of the residual sums of squares for ramps with one delay and for steps. Above it, the command
is treated as steps."""

OTHER_DELAYS = 8.0
"""Threshold for the ratio of the residual sums of squares for ramps with one delay and for steps. Above it, ramps are
in doubt, even if their shapes fit better, because their delays match steps on the grid."""

ITERATIONS = 6
"""Number of alternating estimates of the step times and their common gain. Three are sufficient."""

_DEGREE = 3


@dataclass(frozen=True)
class RampFit:
    """Fit of steps to the motion around ramps, compared with the fit of ramps.

    Parameters
    ----------
    score : float
        Log-likelihood ratio for white noise, with a separate gain and delay for each step and each ramp.
    ratio : float
        Ratio of the residual sum of squares of ramps with a common gain and delay to that of steps with a common gain.
    """

    score: float
    ratio: float

    @property
    def is_sent(self) -> bool:
        """True if the command was sent as ramps."""
        return self.score <= LIKELIER[0] and self.ratio < OTHER_DELAYS

    @property
    def is_step(self) -> bool:
        """True if the command was sent as steps."""
        return self.score >= LIKELIER[1] and self.ratio >= BETTER


def interpolated_command(samples: Samples) -> Finding | None:
    """Return a finding if the logged command interpolates a coarser command linearly, and a command in steps explains
    the motion better.

    A command that was sampled in every n-th row and interpolated linearly has kinks n rows apart. A command that is
    intended as a ramp explains the motion as logged. If noise hides the difference, the finding is a note.
    """
    if not samples.is_free:
        return None
    jumps = samples.jumps
    largest = float(np.abs(jumps).max())
    bends = np.flatnonzero(np.abs(jumps[1:] - jumps[:-1]) > KINK * largest) + 1
    factor = spacing(bends)
    if factor < 2:
        return None
    moves = np.abs(jumps) > KINK * largest / factor
    starts = np.flatnonzero(moves & ~np.concatenate([[False], moves[:-1]]))
    ends = np.flatnonzero(moves & ~np.concatenate([moves[1:], [False]])) + 1
    single = ends - starts == factor
    has_grid = len(np.union1d(bends, np.concatenate([starts, ends]))) >= FEWEST_KNOTS
    if single.any() and len(starts) <= MOST_RAMPS:
        gap = int((starts[1:] - ends[:-1]).min(initial=AROUND[1]))
        fit = compared_ramps(samples, starts[single], factor, min(max(gap, AROUND[0]), AROUND[1]))
        if fit is not None and fit.is_sent:
            return None
        is_step = (fit is not None and fit.is_step) or _was_held(samples, int(bends[0]), factor, SAME_DELAY)
    else:
        is_step = has_grid and _was_held(samples, int(bends[0]), factor, OWN_STEPS)
        has_grid = False
    if not (is_step or has_grid):
        return None
    lines = f"The command is on straight lines between every {ordinal(factor)} row, and"
    if is_step:
        return samples.finding(
            "interpolated_rows",
            "unsafe",
            f"{lines} steps within these lines explain the motion better. The command was interpolated, so it begins "
            "before its steps.",
            "Export the command as it was sent (as steps, not interpolated), at the rate of the controller.",
        )
    return samples.finding(
        "interpolated_rows",
        "note",
        f"{lines} the motion does not show whether the command was sent in this form, so a delay is uncertain by "
        f"{factor} rows.",
        "If the command was sent in steps, export it in steps, without interpolation. If ramps were intended, the log "
        "is correct.",
    )


def compared_ramps(samples: Samples, starts: Integers, rows: int, around: int) -> RampFit | None:
    """Compare the fit of steps inside ramps with the fit of the ramps. Return None if no ramp has enough rows.

    Parameters
    ----------
    samples : Samples
        Samples of a free motion.
    starts : int64, shape (ramps,)
        Last row before each ramp.
    rows, around : int
        Number of rows of a ramp, and number of rows before and after it.
    """
    starts = starts[(starts >= around) & (starts + rows + around < len(samples))]
    if not len(starts):
        return None
    jumps = samples.command[starts + rows] - samples.command[starts]
    jumps /= np.abs(jumps).max()
    every = max(1.0, rows / 16) / 2
    latest = min(LATEST, around - 2)
    k = np.arange(-around, rows + around + 1.0)
    sent = [_ramps(k, np.arange(0, latest, every), rows, lag) for lag in LAGS]
    held = [_steps(k, np.arange(0, rows + latest, every), lag) for lag in LAGS]
    curves = np.concatenate([*sent, *held], axis=1)
    products, powers, sizes = _projected(samples, starts, jumps, k, curves)
    if not sizes.any():
        return None
    ends = np.cumsum([0, *(each.shape[1] for each in (*sent, *held))])
    groups = [slice(first, behind) for first, behind in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]
    ramps, steps = groups[: len(LAGS)], groups[len(LAGS) :]

    common = [_of_one_delay(products[group], powers[group], sizes) for group in ramps]
    gain = min(common)[1]
    inside = min(_of_one_gain(products[group], powers[group], sizes, gain) for group in steps)
    alone = [min(_alone(products[group], powers[group], sizes) for group in kind) for kind in (ramps, steps)]
    # a motion without noise has only rounding errors
    least = (8 * np.finfo(np.float64).eps * float(np.abs(samples.position).max())) ** 2 * len(k) * len(starts)
    freedom = len(starts) * (len(k) - _DEGREE - 1)
    score = 0.5 * freedom * float(np.log((alone[0] + least) / (alone[1] + least)))
    return RampFit(score, float((min(common)[0] + least) / (inside + least)))


def _steps(k: Floats, times: Floats, lag: float) -> Floats:
    """Return the responses to a unit step of acceleration at the given times, shape (rows, times)."""
    z = np.maximum(k[:, None] - times, 0.0)
    motion = 0.5 * z * z
    return motion - lag * z - lag * lag * np.expm1(-z / lag) if lag else motion


def _ramps(k: Floats, times: Floats, rows: int, lag: float) -> Floats:
    """Return the responses to an acceleration that ramps to 1 over some rows, starting at the given times."""
    return np.asarray(sum(_steps(k, times + row, lag) for row in range(rows)) / rows)


def _projected(
    samples: Samples, starts: Integers, jumps: Floats, k: Floats, curves: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the products of curves and motion and the energies of the curves, shape (curves, ramps), and the energy of
    the motion, shape (ramps,). A polynomial and the motion due to Coulomb friction are removed from curves and motion
    by projection.
    """
    polynomial = np.polynomial.legendre.legvander(2 * (k - k[0]) / (k[-1] - k[0]) - 1, _DEGREE)
    products, powers = np.empty((curves.shape[1], len(starts))), np.empty((curves.shape[1], len(starts)))
    sizes = np.empty(len(starts))
    for place, (start, jump) in enumerate(zip(starts.tolist(), jumps.tolist(), strict=True)):
        first = start + int(k[0])
        x = samples.position[first : first + len(k)] - samples.position[first]
        way = np.sign(np.diff(x, prepend=x[0]))
        columns = [polynomial]
        if (way > 0).any() and (way < 0).any():
            columns.append(np.cumsum(np.cumsum(way))[:, None])
        basis, _ = np.linalg.qr(np.concatenate(columns, axis=1))
        rest, free = x - basis @ (basis.T @ x), curves - basis @ (basis.T @ curves)
        products[:, place] = jump * (free.T @ rest)
        powers[:, place] = jump * jump * np.einsum("ij,ij->j", free, free)
        sizes[place] = rest @ rest
    return products, np.maximum(powers, 1e-12 * powers.max()), sizes


def _of_one_delay(products: Floats, powers: Floats, sizes: Floats) -> tuple[float, float]:
    """Return the residual sum of squares of curves with a common delay and gain, and the gain."""
    product, power = products.sum(axis=1), powers.sum(axis=1)
    explained = np.maximum(product, 0.0) ** 2 / power
    best = int(explained.argmax())
    return float(sizes.sum() - explained[best]), float(product[best] / power[best])


def _of_one_gain(products: Floats, powers: Floats, sizes: Floats, gain: float) -> float:
    """Return the residual sum of squares of curves with a common gain and separate delays."""
    left, each = np.inf, np.arange(len(sizes))
    for _ in range(ITERATIONS):
        rest = sizes - 2 * gain * products + gain * gain * powers
        best = rest.argmin(axis=0)
        left = float(rest[best, each].sum())
        gain = float(products[best, each].sum() / powers[best, each].sum())
    return left


def _alone(products: Floats, powers: Floats, sizes: Floats) -> float:
    """Return the residual sum of squares of curves with separate delays and gains."""
    return float((sizes - (np.maximum(products, 0.0) ** 2 / powers).max(axis=0)).sum())


def _was_held(samples: Samples, first: int, factor: int, better: float) -> bool:
    """Return True if the residual for a zero-order hold of every n-th command is far smaller than for interpolation."""
    logged = free_response(samples)
    if logged is None or logged.is_at_noise:
        return False
    knots = np.arange(first % factor, len(samples), factor)
    place = np.clip(np.searchsorted(knots, np.arange(len(samples)), side="right") - 1, 0, len(knots) - 1)
    held = free_response(replace(samples, command=samples.command[knots][place]))
    return held is not None and logged.residual > better * held.residual

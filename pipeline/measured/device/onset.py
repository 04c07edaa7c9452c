"""Closed-loop delay with a fraction: the onset of the motion that the sensor's quantum hid at first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.device.delay import Delays
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

WINDOWS = (3, 4, 6, 8, 12, 16, 24)
"""Rows from the first change that are tried: three for three unknowns; after 24 damping and friction rule."""

DECAY_PER_S = 10.0
"""b/m that the fit neglects [1/s], as a contribution to the error: Falcon 7 (no operator), 14 (comfortable), 34
(firm grip)."""

LARGEST_ERROR = 1.0
"""Standard error [samples] beyond which the first change itself tells as much."""

SURE_ERROR = 0.5
"""Standard error [samples] up to which the onset is rounded to whole samples. It is twice the scatter where a coarse
quantum rules it (0.18 for 0.36 at 60 um), so that 98 of 100 such delays are rounded right."""

ITERATIONS = 12
"""Gauss-Newton steps: the response is a parabola in the onset, which half of them settle to rounding."""

SETTLED = 1e-11
"""Step of the onset [samples] below which it is settled: rounding of the time stamps is as large."""

CHUNK = 256
"""Trials fitted at once: bounds the memory of rows times commands to some 2 MB."""


@dataclass(frozen=True, eq=False)
class OnsetDelays:
    """Delay of each trial by the onset of its motion, shape (n,), NaN where there is a reason.

    Parameters
    ----------
    delay_samples : float64
        Delay in sampling periods, with a fraction.
    standard_error : float64
        Of rounding, noise and neglected damping [samples].
    reason : tuple of str
    """

    delay_samples: Floats
    standard_error: Floats
    reason: tuple[str, ...]


def motion_onset(
    batch: TrialBatch,
    response: Response,
    first: Delays,
    *,
    windows: tuple[int, ...] = WINDOWS,
) -> OnsetDelays:
    """Return the delay of each trial by extrapolating its first motion back to the onset.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    first : Delays
        What `delay.first_change` found in the same trials.
    windows : tuple of int
        Numbers of rows, from the first change on, to choose from: the one with the smallest error is taken.

    Returns
    -------
    OnsetDelays

    Notes
    -----
    Until its damping matters the device moves by 1/m times the double integral of the command, held from one
    row's time stamp to the next and delayed. The wall's answer is in the command, so that the shape holds at
    any K and B. Unknown are 1/m, the delay, and where between two steps of the sensor the device rested. The
    rest counts as one reading, however long the baseline, because a quantum rounds it every time alike. Each
    reading weighs by noise and rounding, (noise^2 + quantum^2/12)^-1/2; where the readings scatter more than
    that, the error grows with them.

    The errors hold for trials that rest anywhere between two steps of the sensor. A controller that jitters
    has a delay for each command: the result is that of the first ones. An ideal log with b = 0 and a constant
    delay gives it to rounding.

    Source: Hulin 2017, eqs. 6.2 and 6.3, whose lateness on a coarse sensor it takes back.
    """
    n = len(batch)
    value, error = np.full(n, np.nan), np.full(n, np.nan)
    known = np.flatnonzero(first.delay_samples >= 0)
    # trials of like delay together: the longest one sets the rows of its chunk
    known = known[np.argsort(first.delay_samples[known], kind="stable")]
    for start in range(0, len(known), CHUNK):
        index = known[start : start + CHUNK]
        value[index], error[index] = _fit(batch.select(index), response, index, first.first_row[index], windows)
    with np.errstate(invalid="ignore"):
        good = error <= LARGEST_ERROR
    reason = tuple("" if good[i] else first.reason[i] or _reason(error[i], min(windows)) for i in range(n))
    return OnsetDelays(
        delay_samples=np.where(good, value, np.nan),
        standard_error=np.where(good, error, np.nan),
        reason=reason,
    )


def rounded(first: Delays, onset: OnsetDelays, *, largest_error: float = SURE_ERROR) -> Integers:
    """Return integer delay factors: the onset rounded where it is sure enough, else the first change as seen.

    Parameters
    ----------
    first : Delays
    onset : OnsetDelays
        Of the same trials.
    largest_error : float
        Standard error of the onset up to which it is rounded [samples].

    Returns
    -------
    int64, shape (n,)
        -1 where neither is known. A delay of d + 0.5 or more counts as d + 1.
    """
    with np.errstate(invalid="ignore"):
        sure = (first.delay_samples >= 0) & (onset.standard_error <= largest_error)
    nearest = np.maximum(np.round(np.where(sure, onset.delay_samples, 0.0)), 0).astype(np.int64)
    return np.where(sure, nearest, first.delay_samples)


def _fit(
    batch: TrialBatch, response: Response, index: Integers, first: Integers, windows: tuple[int, ...]
) -> tuple[Floats, Floats]:
    """Delay and its error in samples of some trials, NaN and infinite where no window fits."""
    edge, period = response.edge_row[index], batch.sampling_period_s
    longest = int((first - edge).max()) + max(windows)
    row = edge[:, None] + np.arange(longest + 1)[None, :]
    at = np.minimum(row, batch.rows[:, None] - 1)
    time = np.take_along_axis(batch.time, at, axis=1)
    time = (time - time[:, :1]) / period[:, None]
    force = np.take_along_axis(batch.command, at, axis=1)
    # a device at rest feels nothing of what the controller commanded before the edge
    change = np.diff(force, axis=1, prepend=0.0) * (period**2)[:, None]
    position = np.take_along_axis(batch.displacement, at, axis=1)
    before = np.arange(batch.position.shape[1])[None, :] <= edge[:, None]
    # mean of the baseline: the reading at the edge alone would bring its noise into all others
    at_rest = np.where(before, batch.displacement, 0.0).sum(axis=1) / (edge + 1)
    away = position - at_rest[:, None]
    noise, quantum = np.nan_to_num(response.sensor_noise[index]), response.sensor_quantum[index]
    step = quantum / np.sqrt(12)
    # without sensor errors any weight does: then rounding of the positions
    smallest = 1e-9 * np.max(np.abs(away), axis=1, initial=0.0)
    reading = np.maximum(np.hypot(noise, step), smallest)
    rest = np.maximum(np.hypot(noise / np.sqrt(edge + 1), step), smallest)
    seen = first - edge
    delay, least = np.full(len(index), np.nan), np.full(len(index), np.inf)
    for window in windows:
        t = np.flatnonzero(first + window <= batch.rows)
        if not len(t):
            continue
        in_window = seen[t, None] + np.arange(window)[None, :]
        motion = _Motion(
            time=np.take_along_axis(time[t], in_window, axis=1),
            away=np.take_along_axis(away[t], in_window, axis=1),
            # a command behind the window moves nothing in it
            arrival=time[t, : in_window.max() + 1],
            change=change[t, : in_window.max() + 1],
            weight=1 / reading[t],
            rest=rest[t],
        )
        guess = time[t, seen[t] - 1]
        tau, error, mobility = _gauss_newton(motion, guess, (DECAY_PER_S * period)[t])
        better = np.isfinite(error) & (error < least[t]) & (mobility > 0)
        delay[t[better]], least[t[better]] = tau[better], error[better]
    return delay, least


@dataclass(frozen=True, eq=False)
class _Motion:
    """Readings of a window, r rows of n trials, and the commands that move the device in it, c of each.

    ``time`` (n, r) and ``arrival`` (n, c) are in samples from the edge; ``change`` (n, c) is that of the command,
    ``away`` (n, r) from rest; ``weight`` (n,) is one over the error of a reading, ``rest`` (n,) the error of the rest.
    """

    time: Floats
    away: Floats
    arrival: Floats
    change: Floats
    weight: Floats
    rest: Floats

    def select(self, which: Booleans) -> _Motion:
        return _Motion(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class _Linear:
    """Least squares about an onset: rest, 1/m times ``scale``, and that times the step of the onset (n, 3)."""

    since: Floats
    columns: Floats
    inverse: Floats
    regular: Booleans
    found: Floats
    scale: Floats
    tau: Floats


def _gauss_newton(motion: _Motion, tau: Floats, decay: Floats) -> tuple[Floats, Floats, Floats]:
    """Onset [samples], its standard error, and 1/m of the weighted least squares of each trial.

    ``decay`` is the neglected b/m times T.
    """
    tau = tau.copy()
    active, still = np.arange(len(tau)), motion
    for _ in range(ITERATIONS - 1):
        after = _linear(still, tau[active]).tau
        moving = np.abs(after - tau[active]) > SETTLED
        tau[active] = after
        if not moving.any():
            break
        if not moving.all():
            active, still = active[moving], still.select(moving)
    at = _linear(motion, tau)
    found, inverse, columns, weight = at.found, at.inverse, at.columns, motion.weight[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        per_onset = 1 / found[:, 1]
        residual = weight * motion.away - np.einsum("nri,ni->nr", columns, found)
        freedom = max(motion.time.shape[1] - 2, 1)
        chi = (np.sum(residual**2, axis=1) + (found[:, 0] / motion.rest) ** 2) / freedom
        scatter = np.sqrt(np.maximum(inverse[:, 2, 2] * np.maximum(chi, 1.0), 0.0)) * np.abs(per_onset)
        # the damping that was left out shifts the shape by its third integral
        third = -np.einsum("nrc,nc->nr", at.since**3, motion.change) / 6 * (found[:, 1] / at.scale * decay)[:, None]
        shift = np.einsum("nj,nj->n", inverse[:, 2, :], np.einsum("nri,nr->ni", columns, weight * third))
        error = np.hypot(scatter, shift * per_onset)
    return at.tau, np.where(at.regular, error, np.nan), found[:, 1] / at.scale


def _linear(motion: _Motion, tau: Floats) -> _Linear:
    """Solve for rest, 1/m and a step of the onset, and take the step."""
    since = np.maximum((motion.time - tau[:, None])[:, :, None] - motion.arrival[:, None, :], 0.0)
    pushed = since * motion.change[:, None, :]
    slope, shape = pushed.sum(axis=2), 0.5 * np.einsum("nrc,nrc->nr", pushed, since)
    # linear in rest and 1/m once the onset is fixed, and in the onset for a small step
    scale = np.sqrt(np.sum(shape**2, axis=1))
    scale = np.where(scale > 0, scale, 1.0)
    columns = np.stack([np.ones_like(shape), shape / scale[:, None], -slope / scale[:, None]], axis=2)
    columns *= motion.weight[:, None, None]
    normal = np.swapaxes(columns, 1, 2) @ columns
    normal[:, 0, 0] += motion.rest**-2
    inverse, regular = _inverse(normal)
    right = np.einsum("nri,nr->ni", columns, motion.weight[:, None] * motion.away)
    found = np.einsum("nij,nj->ni", inverse, right)
    with np.errstate(divide="ignore", invalid="ignore"):
        move = np.where(regular & (found[:, 1] > 0), found[:, 2] / found[:, 1], 0.0)
    # a step beyond one sample leaves the range in which the shape is a parabola about the onset
    tau = np.clip(tau + np.clip(move, -1.0, 1.0), 0.0, motion.time.max(axis=1))
    return _Linear(since, columns, inverse, regular, found, scale, tau)


def _inverse(normal: Floats) -> tuple[Floats, Booleans]:
    """Inverse of scaled normal equations, and where they are regular; identity elsewhere."""
    size = np.sqrt(np.einsum("nii->ni", normal))
    size = np.where(size > 0, size, 1.0)
    scaled = normal / (size[:, :, None] * size[:, None, :])
    # three unknowns to 1e-10 of a condition: beyond, the digits of the positions are gone
    regular = np.isfinite(scaled).all(axis=(1, 2)) & (np.linalg.det(np.nan_to_num(scaled)) > 1e-10)
    scaled = np.where(regular[:, None, None], scaled, np.eye(scaled.shape[1]))
    return np.linalg.inv(scaled) / (size[:, :, None] * size[:, None, :]), regular


def _reason(error: float, fewest: int) -> str:
    if not np.isfinite(error):
        return f"onset not identifiable: no window of {fewest} or more rows after the first change shows a motion"
    return f"onset not identifiable: standard error of {error:.2g} samples, at most {LARGEST_ERROR:.2g} is of use"

"""Delay, mass and damping of each trial, with 95 % intervals, by a model fitted to the whole response.

The controller logs its command exactly: an open-loop model from it to the position, m x'' + b x' = F(t - t_d).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from pipeline.base.wording import percent
from pipeline.measured.fit.fit_filter import DAMPING, DELAY, GAIN, START
from pipeline.measured.fit.fit_jitter import JitterFit, fit_window
from pipeline.measured.fit.fit_motion import LARGEST_RATE
from pipeline.measured.fit.fit_noise import portmanteau
from pipeline.measured.fit.fit_search import SMALLEST_DAMPING, inverse, starting_values
from pipeline.measured.fit.fit_window import FEWEST_ROWS, Window, cut, usable_rows
from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.measured.thesis import NO_DELAY, first_change
from pipeline.records.batch import Floats, Integers, TrialBatch

READINGS_AT_ONCE = 1_200_000
"""Readings of the trials that are fitted together, shortest windows first: some hundred rounds over the rows cost the
same for few trials as for many, and the arrays take 150 MB."""

LARGEST_MISFIT = 2.0
"""Root mean square of the errors, relative to what the sensor explains, from which on the model is wrong. Noise
from a baseline of 20 rows is known to 25 %, so that chance alone stays below."""

LARGEST_MISFIT_OF_QUANTUM = 1.5
"""As `LARGEST_MISFIT` where the quantum alone makes the error: its size is known, and noise below it adds little."""

LEAST_WHITENESS = 1e-6
"""p-value below which errors are correlated beyond chance: rounding is not exactly white, so that the level is far
below the usual ones."""

LEAST_WHITENESS_WITH_JITTER = 1e-10
"""As `LEAST_WHITENESS` where the delay jitters: successive arrivals are correlated by 0.2, which the errors of the
values allow for (`fit_jitter`)."""

LARGEST_JITTER = 1.5
"""Jitter [samples] up to which the model holds: it looks for the force error of a command within a sample of its mean
arrival. Errors that need more come from something else."""

STEADY_GAIN = 4.0
"""Fall of the deviance from jitter to a force error in every row from which on it is not jitter: odds of 7 to 1."""

NOISE_BAND = 6.0
"""Standard deviations that a single error of a right model does not reach: chance makes 1e-6 of it in 1,000 rows."""

IRREGULARITY = 0.1
"""Largest deviation of a time step from T, relative: a stamp that is late by a tenth of a sample moves a reading by
a tenth of the motion in a sample, as noise does."""

LARGEST_RELATIVE_ERROR = 0.5
"""Standard error of the mass, relative to its value, beyond which the linear error is no interval."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Model of each trial, shape (n,); an interval of 95 % is the value plus and minus 1.96 standard errors.

    NaN where there is no value; errors alone are NaN where there is one but the model does not explain the log.
    Both have a reason.

    Parameters
    ----------
    mass, mass_error : float64
        Apparent mass m [kg, kg m^2].
    damping, damping_error : float64
        Viscous damping b of the device [Ns/m, Nms/rad].
    delay, delay_error : float64
        Mean delay of the command in force [samples].
    jitter, jitter_error : float64
        Standard deviation of the delay about its mean [samples].
    start : float64
        Position x_0 before the step [m, rad].
    first_row, last_row : int64
        Rows of the log that were used; -1 where there are none.
    misfit : float64
        Root mean square of the whitened errors, relative to what quantum and baseline noise explain; NaN where
        the log has neither.
    whiteness : float64
        p-value of a test that the whitened errors are not correlated; NaN for too few.
    friction_gain : float64
        By how much Coulomb friction beside the jitter explains the log better (fall of the deviance); NaN without one.
    leaves_row : int64
        First row where the error leaves the noise band; -1 where it never does.
    reason : tuple of str
        Why values or errors are missing; empty where all are there.
    """

    mass: Floats
    mass_error: Floats
    damping: Floats
    damping_error: Floats
    delay: Floats
    delay_error: Floats
    jitter: Floats
    jitter_error: Floats
    start: Floats
    first_row: Integers
    last_row: Integers
    misfit: Floats
    whiteness: Floats
    friction_gain: Floats
    leaves_row: Integers
    reason: tuple[str, ...]


def fit_trials(batch: TrialBatch, response: Response) -> Fit:
    """Fit m x'' + b x' = F(t - t_d) to each trial and return its parameters with their errors.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.

    Returns
    -------
    Fit

    Notes
    -----
    The position is that of a device at rest in the first row used, under the command held over each sample and
    delayed by a fractional number of samples. Readings are weighted by their error: rounding (quantum^2/12) and
    baseline noise. A reading that repeats counts once: while the device moves less than a quantum, the rounding
    error is the same over the whole run, and only the average of a run tells something.

    Where the delay jitters, each change of command dF that comes early or late by eps samples leaves an impulse
    dF T eps. Its variance is estimated by maximum likelihood and the errors are whitened by a Kalman filter
    (`fit_filter`). Commands do not overtake, so that the delay is the mean one of the command in force: for
    delays drawn from d - 1, d, d + 1 that is d - 1/9.

    The command must be what the drive put out. Coulomb friction, a resonance, a saturated drive or a push from
    outside leave errors that are larger than the sensor's, or correlated: then the errors of all values are NaN.

    Source: Hulin 2017, eqs. 3.3 to 3.8 and 6.4, as a least-squares problem over the whole response.
    """
    edge = response.edge_row
    first, last = usable_rows(batch, response, edge)
    problem = problems(batch, response, edge, first, last)
    usable = np.array([not text for text in problem], dtype=np.bool_)
    lag = first_change(batch, response).delay_samples
    lag = np.where(lag == NO_DELAY, 0, lag)
    values = {field.name: np.full(len(batch), np.nan) for field in fields(Fit) if field.name != "reason"}
    reason = list(problem)
    index = np.flatnonzero(usable)
    index = index[np.argsort((last - first)[index], kind="stable")]
    for some in _portions(index, (last - first)[index] + 1):
        window = cut(batch.select(some), response.select(some), edge[some], first[some], last[some])
        start = starting_values(window, lag[some])
        fit = fit_window(window, start, lag[some])
        found, why = _describe(fit.window, fit, batch.sampling_period_s[some])
        for name, value in found.items():
            values[name][some] = value
        for i, text in zip(some, why, strict=True):
            reason[i] = text
    rows = _rows(values)
    return Fit(**values, **rows, reason=tuple(reason))  # type: ignore[arg-type]


def _portions(index: Integers, rows: Integers) -> Iterator[Integers]:
    """Cut trials, ordered by rows, into portions of at most `READINGS_AT_ONCE` readings (or of one trial)."""
    start = 0
    while start < len(index):  # ends: each portion holds a trial at least
        readings = rows[start:] * np.arange(1, len(index) - start + 1)
        count = max(int(np.searchsorted(readings, READINGS_AT_ONCE, side="right")), 1)
        yield index[start : start + count]
        start += count


ROWS = ("first_row", "last_row", "leaves_row")
"""Fields of a fit that are rows of the log."""


def _rows(values: dict[str, Floats]) -> dict[str, Integers]:
    """Take the rows of the log out of the values, as whole numbers, -1 where there are none."""
    taken = {name: values.pop(name) for name in ROWS}
    return {name: np.where(np.isfinite(row), row, NO_ROW).astype(np.int64) for name, row in taken.items()}


def problems(batch: TrialBatch, response: Response, edge: Integers, first: Integers, last: Integers) -> list[str]:
    """Say for each trial why it cannot be fitted; empty where it can."""
    moved = np.nanmax(np.abs(np.where(batch.valid, batch.displacement, 0.0)), axis=1, initial=0.0)
    step = np.diff(batch.time, axis=1)
    uneven = np.nan_to_num(np.abs(step / batch.sampling_period_s[:, None] - 1)).max(axis=1, initial=0.0)
    gaps = (~np.isfinite(batch.command) | ~np.isfinite(batch.position)) & batch.valid
    reasons = []
    for i in range(len(batch)):
        if edge[i] < 0:
            reasons.append(f"no start of the response: {response.edge_reason[i]}")
        elif last[i] - edge[i] < FEWEST_ROWS:
            reasons.append(f"{last[i] - edge[i]} rows after the command edge; a fit needs {FEWEST_ROWS}")
        elif moved[i] <= response.floor[i]:
            reasons.append(f"no motion: {moved[i]:.3g} is not above the sensor floor of {response.floor[i]:.3g}")
        elif uneven[i] > IRREGULARITY:
            reasons.append(
                f"time steps differ from T by up to {percent(uneven[i], 1)}; the model allows {percent(IRREGULARITY)}"
            )
        elif gaps[i].any():
            reasons.append(
                f"no number in row {int(np.argmax(gaps[i]))}; the model needs command and position throughout"
            )
        else:
            reasons.append("")
    return reasons


def allowed_misfit(window: Window) -> Floats:
    """Return the misfit of each trial from which on a model is wrong, shape (n,)."""
    # the share of the variance that the quantum makes is known
    allowed: Floats = LARGEST_MISFIT + window.quantum_share * (LARGEST_MISFIT_OF_QUANTUM - LARGEST_MISFIT)
    return allowed


def _describe(window: Window, fit: JitterFit, period: Floats) -> tuple[dict[str, Floats], list[str]]:
    """Return the fields of a fit in physical units, and for each trial what is wrong with it."""
    p = fit.solution.parameters
    quantities, errors = _physical(window, fit, period)
    scale = np.sqrt(np.maximum(fit.scale, 1.0))
    size = np.abs(fit.error) / np.where(window.noise_known, np.minimum(scale, LARGEST_MISFIT), scale)
    outside = size > NOISE_BAND
    leaves = np.where(outside.any(axis=0), window.first_row + np.argmax(outside, axis=0), NO_ROW)
    misfit = np.sqrt(fit.solution.scale)
    allowed = allowed_misfit(window)
    # of an ideal log only the rounding of numbers is left, which is nobody's noise
    exact = ~window.noise_known & (misfit <= 1)
    counted = np.where(fit.jitter > 0, window.inside, window.independent) & ~exact
    whiteness = portmanteau(fit.error, counted)
    lost, doubtful = [], []
    for i in range(p.shape[1]):
        error = errors["mass"][i] / quantities["mass"][i]
        lost.append(_lost(bool(fit.solution.converged[i]), float(p[DAMPING, i]), float(error)))
        doubtful.append(
            _doubtful(
                float(misfit[i]) if window.noise_known[i] else 0.0,
                float(allowed[i]),
                float(whiteness[i]),
                int(leaves[i]),
                float(fit.jitter[i]),
                float(fit.steady[i]),
            )
        )
    no_value = np.array([bool(text) for text in lost])
    no_error = no_value | np.array([bool(text) for text in doubtful])
    found = {name: np.where(no_value, np.nan, value) for name, value in quantities.items()}
    found |= {f"{name}_error": np.where(no_error, np.nan, value) for name, value in errors.items()}
    jitter_known = ~no_error & np.isfinite(fit.jitter_error)
    found["jitter"] = np.where(jitter_known | (fit.jitter > 0) & ~no_value, fit.jitter, np.nan)
    found["jitter_error"] = np.where(jitter_known, fit.jitter_error, np.nan)
    found["misfit"] = np.where(window.noise_known, misfit, np.nan)
    found["friction_gain"] = np.where(np.isfinite(fit.friction), fit.friction, np.nan)
    found["whiteness"], found["leaves_row"] = whiteness, leaves.astype(np.float64)
    found["first_row"], found["last_row"] = window.first_row.astype(np.float64), window.last_row.astype(np.float64)
    reasons = [a or b for a, b in zip(lost, doubtful, strict=True)]
    return found, reasons


def _physical(window: Window, fit: JitterFit, period: Floats) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return values and standard errors in physical units; linear propagation from the normalised parameters."""
    p = fit.solution.parameters
    covariance = inverse(fit.solution.normal) * fit.scale[:, None, None]
    covariance *= fit.inflation.T[:, :, None] * fit.inflation.T[:, None, :]
    gain = p[GAIN]
    mass = window.force_scale * period**2 / (window.travel * gain)
    damping = p[DAMPING] * mass / period
    # damping = factor * p[DAMPING], where factor is as 1/gain
    gradient = np.zeros((len(gain), len(p)))
    gradient[:, GAIN] = -damping / gain
    gradient[:, DAMPING] += mass / period
    errors = {
        "delay": np.sqrt(covariance[:, DELAY, DELAY]),
        "mass": np.abs(mass / gain) * np.sqrt(covariance[:, GAIN, GAIN]),
        "damping": np.sqrt(np.einsum("ni,nij,nj->n", gradient, covariance, gradient)),
    }
    values = {"delay": p[DELAY], "start": window.origin + window.travel * p[START], "mass": mass, "damping": damping}
    return values, errors


def _lost(converged: bool, delta: float, error: float) -> str:
    """Say why a trial has no values at all; empty where it has."""
    if not converged:
        return (
            "the search for the model's parameters did not converge; the log does not follow m x'' + b x' = F(t - t_d)"
        )
    if delta <= SMALLEST_DAMPING:
        return "the motion grows by itself: no device with a damping near or above 0 explains the log"
    if delta >= LARGEST_RATE:
        return "the motion dies within one sample; it is not sampled finely enough for this model"
    if not error < LARGEST_RELATIVE_ERROR:
        return f"the log does not tell the mass: its standard error is {percent(error)} of the value"
    return ""


def _doubtful(misfit: float, allowed: float, whiteness: float, leaves: int, jitter: float, steady: float) -> str:
    """Say why the model does not explain the log, so that its errors mean nothing; empty where it does."""
    if misfit > allowed:
        return (
            f"no interval: the model misses the readings by {misfit:.2g} times what the sensor explains "
            f"(allowed {allowed:.3g}); look for friction, a saturated drive or a resonance"
        )
    if leaves >= 0:
        return (
            f"no interval: in row {leaves} the position leaves the model by more than {NOISE_BAND:g} standard "
            "deviations; look for a push from outside or a saturated drive"
        )
    least = LEAST_WHITENESS_WITH_JITTER if jitter > 0 else LEAST_WHITENESS
    if whiteness < least:
        return (
            f"no interval: the errors of the model are correlated (p = {whiteness:.1g}, allowed {least:g}); "
            "look for friction, a spring or a resonance that the model does not have"
        )
    if jitter > LARGEST_JITTER:
        return (
            f"no interval: the errors would need a delay that jitters by {jitter:.2g} samples (allowed "
            f"{LARGEST_JITTER:g}); look for friction, a resonance or a push from outside"
        )
    if steady > STEADY_GAIN:
        return (
            "no interval: the errors of the force do not follow the changes of the command, as those of a jittering "
            f"delay do (deviance lower by {steady:.0f}, allowed {STEADY_GAIN:g}); look for friction or a resonance"
        )
    return ""

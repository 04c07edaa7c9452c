"""Mass by the momentum balance with what else takes momentum: damping, friction, offset, gravity or a spring."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.device.averaging import AveragedBalance, averaged_balance
from pipeline.measured.device.correlated import direction, score_covariance, without
from pipeline.measured.device.momentum import balance
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

TERMS = ("damping", "friction", "offset", "gravity", "spring", "start")
"""What can stand beside the mass, see `fit_balance`."""

LEAST_SHARE = 0.005
"""Part of a term that the mass and the terms before it must leave, else it is the same thing to this log: at 0.5 %
an error of 0.1 % of the term makes 20 % in its coefficient. Above, the standard error tells."""

LEAST_VARIATION = 0.05
"""Part of the impulse that must be left beside an offset, or a friction, and a start. A constant force is balanced
exactly by an offset of its own size and no mass at all; its noise, integrated, leaves 1 %. Friction of a motion one
way is such an offset."""

SEGMENTS = 10
"""Parts of the window whose readings' errors count as independent, and the inverse of the part of it over which
the wandering of the residual is read: a longer one would hardly wander, the fit takes that away."""

FEWEST_INTERVALS = 20
"""Six unknowns with fewer intervals follow the noise."""

DIRECTION_FLOORS = 2.0
"""Sensor floors that the device must move for its direction to be seen."""

LARGEST_HALF_WIDTH = 25
"""Rows on either side over which a direction may be looked for: beyond, turning points are blurred."""

CHUNK = 128
"""Trials fitted at once: bounds the memory to a few MB per term at 1,000 rows."""


@dataclass(frozen=True, eq=False)
class BalanceFit:
    """Mass and other coefficients of n trials by least squares of the momentum balance, NaN where not known.

    Parameters
    ----------
    terms : tuple of str, length p
    mass, mass_error : float64, shape (n,)
        With its standard error, the attenuation included [kg, kg m^2].
    coefficients, errors : float64, shape (n, p)
        Of each term, in its unit (see `fit_balance`), with standard errors; NaN where it was dropped.
    attenuation : float64, shape (n,)
        Share of the mass that the sensor's error of the velocity takes away, as a fraction.
    width_rows : int64, shape (n,)
        Rows over which the balance was averaged.
    dropped : tuple of str
        Terms that the trial does not carry, with why; empty where all were kept.
    reason : tuple of str
        Why there is no mass; empty where there is one.
    """

    terms: tuple[str, ...]
    mass: Floats
    mass_error: Floats
    coefficients: Floats
    errors: Floats
    attenuation: Floats
    width_rows: Integers
    dropped: tuple[str, ...]
    reason: tuple[str, ...]


def fit_balance(
    batch: TrialBatch,
    response: Response,
    delay_samples: int,
    *,
    terms: tuple[str, ...] = ("damping",),
    force: Floats | None = None,
    held: bool = True,
    window_s: tuple[float, float] = (0.0, np.inf),
    width_rows: int | None = None,
) -> BalanceFit:
    """Return the mass of each trial beside the damping, friction and other terms asked for.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials; one from `response.declare_edge` where the log has no baseline.
    delay_samples : int
        Integer delay factor by which the force is shifted; 0 for a force measured at the device.
    terms : tuple of str
        Each takes momentum from the force, the later ones what the earlier ones leave:

        ========  ===============================  ======================================
        damping   b (x - x_0)                      viscous damping [Ns/m, Nms/rad]
        friction  c integral sign(v)               Coulomb friction [N, Nm]
        offset    o t                              constant force against the step [N, Nm]
        gravity   G integral sin(x)                of a pendulum that hangs at 0 [Nm]
        spring    k integral (x - x_0)             [N/m, Nm/rad]
        start     p                                momentum missing at the start [Ns, Nms]
        ========  ===============================  ======================================
    force : float64, shape (n, N), optional
        Measured force in place of the command [N, Nm].
    held : bool
        Whether the force is held between rows, as a command is, or a reading of something continuous.
    window_s : tuple of float
        First and last time from the command edge that is used [s].
    width_rows : int, optional
        Rows over which the balance is averaged. By default the fewest (a power of two) with which the sensor
        makes at most `ATTENUATION` of the velocity's variance.

    Returns
    -------
    BalanceFit

    Raises
    ------
    ParameterError
        If a term is unknown or given twice, or the window is empty; else as `momentum.balance`.

    Notes
    -----
    m v + sum of terms = integral of the delayed force, at the mean of each interval, with the logged times.
    All are averaged over the same rows, which keeps the balance exact and takes the rounding out of the
    velocity: a velocity with errors makes the mass too small (``attenuation``).

    The balance starts from rest. Where the delay is not known, or the window begins later, ``start`` takes up
    the momentum that is then missing. Friction counts where a direction can be seen; a device that sticks is
    not described, so that long rests belong outside the window.

    A term is dropped, with a reason, where the others leave less than `LEAST_SHARE` of it; an offset, and the
    friction of a motion one way, also where the force is nearly constant: one of that size and no mass would
    explain everything.

    A force that the log does not show is integrated too: the residual wanders, and its values are alike for long.
    The standard errors add up two parts, a sandwich over `SEGMENTS` parts of the window for errors that die
    out, and that of a random walk, whose rate is read from how much farther apart the residuals of distant
    rows lie than those of near ones. Of 150 simulated trials the scatter was 0.9 to 1.7 standard errors. They
    know nothing of terms that were left out: a device that sticks at its turning points scattered by up to 2.8
    of them where the sensor was fine and nothing else disturbed it.

    Source: Hulin 2017, eq. 6.4 with further terms.
    """
    _check(batch, terms, window_s)
    parts = []
    for first in range(0, max(len(batch), 1), CHUNK):
        index = np.arange(first, min(first + CHUNK, len(batch)))
        part = batch.select(index)
        columns, impulse, weight, velocity_error = _columns(
            part,
            response,
            index,
            delay_samples,
            terms,
            None if force is None else force[index],
            held,
            window_s,
        )
        averaged = averaged_balance(columns, impulse, weight, velocity_error, width_rows)
        parts.append(_solve(averaged, terms, response, index))
    return _joined(parts)


def _check(batch: TrialBatch, terms: tuple[str, ...], window_s: tuple[float, float]) -> None:
    unknown = [term for term in terms if term not in TERMS]
    if unknown or len(set(terms)) != len(terms):
        raise ParameterError(f"terms {terms}: expected each of {TERMS} at most once, in the order of their weight.")
    if not 0 <= window_s[0] < window_s[1]:
        raise ParameterError(f"window from {window_s[0]:g} to {window_s[1]:g} s: expected 0 <= first < last.")


def _columns(
    batch: TrialBatch,
    response: Response,
    index: Integers,
    delay_samples: int,
    terms: tuple[str, ...],
    force: Floats | None,
    held: bool,
    window_s: tuple[float, float],
) -> tuple[Floats, Floats, Floats, Floats]:
    """Velocity and terms (n, N-1, p+1), impulse (n, N-1), durations inside the window, error of a velocity (n,)."""
    edge = response.edge_row[index]
    momentum = balance(batch, edge, delay_samples, force=force, held=held, logged_times=True)
    start = batch.time[np.arange(len(batch)), np.maximum(edge, 0)][:, None]
    inside = momentum.inside & (batch.time[:, :-1] >= start + window_s[0]) & (batch.time[:, 1:] <= start + window_s[1])
    duration = np.where(momentum.inside, np.diff(batch.time, axis=1), 0.0)

    def integral(rate: Floats) -> Floats:
        amount = np.where(momentum.inside, rate, 0.0) * duration
        return np.cumsum(amount, axis=1) - 0.5 * amount

    reading = np.hypot(np.nan_to_num(response.sensor_noise[index]), response.sensor_quantum[index] / np.sqrt(12))
    middle = 0.5 * (batch.position[:, :-1] + batch.position[:, 1:])

    def made(term: str) -> Floats:
        if term == "damping":
            return momentum.displacement
        if term == "start":
            return np.ones_like(duration)
        if term == "friction":
            return integral(mean_direction(batch, response.floor[index], inside))
        if term == "offset":
            return integral(np.ones_like(duration))
        if term == "gravity":
            return integral(np.sin(middle))
        return integral(momentum.displacement)

    columns = np.stack([np.where(inside, part, 0.0) for part in (momentum.velocity, *map(made, terms))], axis=1)
    return (
        # time last in memory: neighbours in time are neighbours there
        np.moveaxis(columns, 1, 2),
        np.where(inside, momentum.impulse, 0.0),
        np.where(inside, duration, 0.0),
        np.sqrt(2) * reading,
    )


def mean_direction(batch: TrialBatch, floor: Floats, inside: Booleans) -> Floats:
    """Mean sign of the velocity of each interval, 0 where it moves less than the sensor sees, shape (n, N-1).

    Slow motions are looked at over more rows, so many that the typical change passes the floor. With velocities
    a, b at the ends of an interval, straight between them, the mean sign is (a + b)/(|a| + |b|).
    """
    x = batch.displacement
    change = np.where(inside, np.nan_to_num(np.diff(x, axis=1)), 0.0)
    typical = np.sqrt((change**2).sum(axis=1) / np.maximum(inside.sum(axis=1), 1))
    least = DIRECTION_FLOORS * floor
    with np.errstate(divide="ignore", invalid="ignore"):
        rows = np.where(typical > 0, np.ceil(least / typical), 1.0)
    half = np.clip(rows // 2, 1, LARGEST_HALF_WIDTH).astype(np.int64)
    column = np.arange(x.shape[1])[None, :]
    after = np.minimum(column + half[:, None], batch.rows[:, None] - 1)
    before = np.maximum(column - half[:, None], 0)
    moved = np.take_along_axis(x, after, axis=1) - np.take_along_axis(x, before, axis=1)
    both = np.abs(moved[:, :-1]) + np.abs(moved[:, 1:])
    seen = both > least[:, None]
    return np.where(seen, (moved[:, :-1] + moved[:, 1:]) / np.where(seen, both, 1.0), 0.0)


def _kept(columns: Floats, impulse: Floats, valid: Booleans, terms: tuple[str, ...]) -> tuple[Booleans, list[str]]:
    """Which columns (n, p+1) a trial carries, velocity first, and why others were dropped."""
    kept = np.ones((len(columns), columns.shape[2]), dtype=bool)
    texts: list[list[str]] = [[] for _ in range(len(columns))]
    basis, steady = [direction(columns[:, :, 0], [])], direction(valid.astype(np.float64), [])
    for j, term in enumerate(terms, start=1):
        column = columns[:, :, j]
        size = _length(column)
        kept[:, j] = _length(without(column, basis)) > LEAST_SHARE * size
        why = np.where(size > 0, f"{term} is not told from the mass and the terms before it", f"no {term} acts")
        if term in ("offset", "friction"):
            changing = _length(without(impulse, [steady]))
            varying = _length(without(impulse, [steady, direction(column, [steady])]))
            constant = kept[:, j] & ~(varying > LEAST_VARIATION * changing)
            why = np.where(constant, f"{term} is not told from a force that is nearly constant", why)
            kept[:, j] &= ~constant
        for i in np.flatnonzero(~kept[:, j]):
            texts[i].append(str(why[i]))
        if j < len(terms):
            basis.append(direction(column * kept[:, j, None], basis))
    return kept, ["; ".join(text) for text in texts]


def _length(column: Floats) -> Floats:
    result: Floats = np.sqrt(np.einsum("nk,nk->n", column, column))
    return result


def _solve(averaged: AveragedBalance, terms: tuple[str, ...], response: Response, index: Integers) -> BalanceFit:
    """Least squares of one chunk of trials."""
    columns, impulse, valid = averaged.columns, averaged.impulse, averaged.valid
    attenuation, width = averaged.attenuation, averaged.width
    kept, dropped = _kept(columns, impulse, valid, terms)
    columns = columns * kept[:, None, :]
    scale = np.sqrt((columns**2).sum(axis=1))
    scale = np.where(scale > 0, scale, 1.0)
    scaled = columns / scale[:, None, :]
    unused = np.eye(columns.shape[2]) * ~kept[:, None, :]
    normal = np.swapaxes(scaled, 1, 2) @ scaled + unused
    # a velocity that the terms explain altogether leaves no mass; its normal equations are singular
    eigenvalue = np.linalg.eigvalsh(normal)
    regular = eigenvalue[:, 0] > LEAST_SHARE**4
    inverse = np.linalg.inv(np.where(regular[:, None, None], normal, np.eye(columns.shape[2])))
    found = (inverse @ (np.swapaxes(scaled, 1, 2) @ impulse[:, :, None]))[:, :, 0]
    residual = impulse - (scaled @ found[:, :, None])[:, :, 0]
    count = valid.sum(axis=1)
    meat = score_covariance(scaled, residual, valid, kept.sum(axis=1), width, SEGMENTS)
    variance = inverse @ meat @ inverse
    value = found / scale
    error = np.sqrt(np.maximum(np.einsum("nii->ni", variance), 0.0)) / scale
    error[:, 0] = np.hypot(error[:, 0], attenuation * value[:, 0])
    has_edge = response.has_edge[index]
    positive = value[:, 0] > 2 * error[:, 0]
    good = has_edge & (count >= FEWEST_INTERVALS) & regular & positive
    reasons = []
    for i in range(len(index)):
        if good[i]:
            reasons.append("")
        elif not has_edge[i]:
            reasons.append(f"no start of the balance: {response.edge_reason[index[i]]}")
        elif count[i] < FEWEST_INTERVALS:
            reasons.append(f"{count[i]} intervals in the window; at least {FEWEST_INTERVALS} are needed")
        elif not regular[i]:
            reasons.append("the terms explain the velocity altogether: no mass can be told from them")
        else:
            reasons.append(
                f"mass of {value[i, 0]:.3g} with a standard error of {error[i, 0]:.2g} is not above 0 with this delay"
            )
    shown = good[:, None] & kept
    return BalanceFit(
        terms=terms,
        mass=np.where(good, value[:, 0], np.nan),
        mass_error=np.where(good, error[:, 0], np.nan),
        coefficients=np.where(shown, value, np.nan)[:, 1:],
        errors=np.where(shown, error, np.nan)[:, 1:],
        attenuation=np.where(good, attenuation, np.nan),
        width_rows=width,
        dropped=tuple(dropped),
        reason=tuple(reasons),
    )


def _joined(parts: list[BalanceFit]) -> BalanceFit:
    """Fits of all chunks one after the other."""
    arrays = ("mass", "mass_error", "coefficients", "errors", "attenuation", "width_rows")
    texts: dict[str, Any] = {
        name: tuple(text for part in parts for text in getattr(part, name)) for name in ("dropped", "reason")
    }
    joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
    return BalanceFit(terms=parts[0].terms, **joined, **texts)

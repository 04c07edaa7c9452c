"""Mass, damping, friction, stiffness and a constant force from one balance of all trials of an experiment.

The balance is integrated twice, so that no reading is differentiated: a rounded position stays a small error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.device.friction import mean_direction
from pipeline.measured.intervals import student_95
from pipeline.measured.signal.response import Response
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

TERMS = ("mass", "damping", "friction", "stiffness", "constant_force", "delay", "turning")
"""What takes the force up, in the order of the columns of `balance_sums`."""

OPTIONAL = ("stiffness", "constant_force", "friction")
"""Terms that the model does without where the logs do not ask for them, in the order in which it is looked."""

_COLUMNS = len(TERMS) + 3
"""The terms, two columns that correct the force for what is found, and the force integrated twice."""

MODEL_FLOOR = 1e-4
"""Error of the balance, relative to its size, that quadrature makes: no trial is trusted to more than that."""

FEWEST_ROWS = 20
"""Rows of motion below which a trial says nothing: six unknowns would follow its noise."""

LEAST_SHARE = 1e-3
"""Part of a term that the others must leave for it to be told from them: errors of quadrature alone make 1e-4."""

LARGEST_ERROR = 0.1
"""Standard error of a friction or constant force, relative to the largest force, from which on it is not told."""

FEWEST_FREEDOM = 3
"""Degrees of freedom of an interval from few trials: each has hundreds of readings, but shares its errors."""

ASKED_FOR = 0.7
"""Share of the squared residual that may be left for a term to be asked for by the logs: a term that the model lacks
makes more of the residual than the sensor does, or it makes no difference."""

NEGLIGIBLE = 2e-3
"""Size of a term, relative to what would make all of the force, below which the model does without it."""

SIGNIFICANT = 3.0
"""Standard errors from 0 that it must lie as well."""

LARGEST_REST = 2.0
"""Samples of delay beyond the integer factor up to which the force is corrected for its square."""

LONGEST_DELAY = 5.0
"""The same, relative to `LARGEST_REST`, from which on it is no delay."""

ROUNDING = 1e-13
"""Eigenvalue of the scaled normal equations that rounding makes."""

MODEL_ERROR = 5e-4
"""Error of a value that trials share, relative to mass, damping, or to what would make all of the force."""

LEAST_REST, RESTS = 20, 20
"""A rest lasts so many rows, and so large a part of the log: a device that moves less tells nothing."""

NEARLY = 0.999
"""Mean direction of an interval from which on the device did not turn in it."""

LONGEST_TURN = 4
"""Intervals between sure directions up to which a turn is where the velocity, drawn straight, goes through 0."""

UNTOLD = 3e-5
"""Share of a term below which it is not told from the others in the fit of one trial."""

_ROUNDS = 4
"""Repetitions with the delay and friction found before, which correct the force: the change falls tenfold in each."""


def balance_sums(batch: TrialBatch, response: Response, delay_samples: int, *, pendulum: bool = False) -> Floats:
    """Return what the joint balance needs of each trial, shape (n, 55): zeros for a trial that says nothing.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.
    delay_samples : int
        Integer delay factor; the rest of the delay is an unknown of the balance.
    pendulum : bool
        Whether a spring's force may be gravity's, k sin x, the pendulum hanging at x = 0.

    Notes
    -----
    With x from rest, and all integrals from the arrival of the step on:

        m x + b int x + c int int sign(v) + k int int x - f t^2/2 = int int F(t - t_d)

    The sums are the upper triangle of the weighted products of its columns, means taken out (the first position
    is rounded as all are). A trial is weighted by what its own fit of all terms leaves, and by how far its rows
    repeat each other. Rows after the last motion are left out: a device that sticks obeys another balance.

    Source: Hulin 2017, eqs. 3.3 and 6.4, integrated.
    """
    columns, inside = _columns(batch, response, delay_samples, pendulum)
    count = inside.sum(axis=1)
    where = inside[:, None, :]
    mean = np.where(where, columns, 0.0).sum(axis=2) / np.maximum(count, 1)[:, None]
    columns = np.where(where, columns - mean[:, :, None], 0.0)
    size = np.sqrt(np.einsum("nck,nck->nc", columns, columns))
    scaled = columns / np.where(size > 0, size, 1.0)[:, :, None]
    left = _left_over(scaled[:, : len(TERMS)], columns[:, -1])
    square = (left**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = np.clip((left[:, 1:] * left[:, :-1]).sum(axis=1) / square, 0.0, 1 - 2 / np.maximum(count, 3))
        variance = square / count + (MODEL_FLOOR * size[:, -1]) ** 2 / count
        weight = (1 - alike) / (1 + alike) / variance
    weight = np.where((count >= FEWEST_ROWS) & (size[:, 0] > 0), np.nan_to_num(weight, posinf=0.0), 0.0)
    products = columns @ np.swapaxes(columns, 1, 2) * weight[:, None, None]
    result: Floats = products[:, *np.triu_indices(_COLUMNS)]
    return result


def _left_over(terms: Floats, force: Floats) -> Floats:
    """Return what terms (n, p, N) of unit size leave of a force (n, N), each trial fitted by itself.

    A sum of terms below `UNTOLD` is damped, not cut off, so that rounding decides nothing.
    """
    n, count, rows = terms.shape
    damped = np.broadcast_to(UNTOLD * np.eye(count), (n, count, count))
    basis = np.linalg.qr(np.concatenate([np.swapaxes(terms, 1, 2), damped], axis=1))[0][:, :rows]
    return force - (basis @ (np.swapaxes(basis, 1, 2) @ force[:, :, None]))[:, :, 0]


def _columns(batch: TrialBatch, response: Response, delay_samples: int, pendulum: bool) -> tuple[Floats, Booleans]:
    """Columns of the balance at each row, shape (n, 10, N), and which rows are used."""
    rows = np.arange(batch.position.shape[1])[None, :]
    # several steps, as a reversal, are no response of the loop and tell the more of its forces
    large = np.abs(np.nan_to_num(batch.command)) > 0.5 * np.abs(batch.step)[:, None]
    first = np.where(response.steps > 1, np.argmax(large, axis=1), response.edge_row)
    begin = np.where(first >= 0, first + delay_samples, rows.shape[1])[:, None]
    after = batch.valid & (rows >= begin)
    step = np.where(after[:, 1:] & after[:, :-1], np.nan_to_num(np.diff(batch.time, axis=1)), 0.0)
    arrived = np.maximum(np.arange(rows.shape[1]) - delay_samples, 0)
    force = np.where(after, np.nan_to_num(batch.command)[:, arrived], 0.0)
    x = np.where(after, np.nan_to_num(batch.displacement), 0.0)
    direction = mean_direction(batch, response.floor, after[:, :-1] & after[:, 1:])
    direction, initial, first = _surely(direction)
    direction = direction * (step > 0)

    def integral(rate: Floats, slope: Floats | float = 0.0) -> Floats:
        """Integral of what holds ``rate`` at the beginning of each interval and changes by ``slope``."""
        amount = (rate + 0.5 * slope * step) * step
        return np.concatenate([np.zeros((len(batch), 1)), np.cumsum(amount, axis=1)], axis=1)

    once = integral(force[:, :-1])
    way = integral(direction)
    # trapezoid, corrected for the change of slope at its end
    moved = 0.5 * (x[:, 1:] + x[:, :-1])
    bend = np.pad(x[:, 2:] - x[:, :-2], ((0, 0), (1, 1)), mode="edge") / 24
    path = integral(moved) - bend * np.pad(step, ((0, 0), (1, 0)))
    swing = np.where(after, np.sin(np.nan_to_num(batch.position)), 0.0)
    bent = integral(0.5 * (swing[:, 1:] + swing[:, :-1])) if pendulum else path
    elapsed = integral(np.ones_like(step))
    before = np.pad(force[:, :-1], ((0, 0), (1, 0)))
    columns = [
        x,
        path,
        integral(way[:, :-1], direction),
        integral(0.5 * (bent[:, 1:] + bent[:, :-1])),
        -0.5 * elapsed**2,
        once,
        way - initial * elapsed,
        0.5 * before,
        initial * elapsed,
        integral(once[:, :-1], force[:, :-1]),
    ]
    resting = _rests(x, response.floor) & (rows >= begin) & (rows > first)
    last = np.where(resting.any(axis=1), resting.argmax(axis=1), batch.rows - 1)
    return np.stack(columns, axis=1), after & (rows <= last[:, None]) & (first < rows.shape[1] - 1)


def _rests(x: Floats, floor: Floats) -> Booleans:
    """Rows from which on the position stays where it is for a while, as far as the sensor sees, shape (n, N).

    A device that has come to rest obeys another balance: what moves it no more, friction holds.
    """
    length = max(LEAST_REST, x.shape[1] // RESTS)
    rests = np.ones(x.shape, dtype=np.bool_)
    for part in (4, 3, 2, 1):
        later = np.minimum(np.arange(x.shape[1]) + length // part, x.shape[1] - 1)
        rests &= np.abs(x[:, later] - x) <= floor[:, None]
    rests[:, -length:] = False
    return rests


def _surely(direction: Floats) -> tuple[Floats, Floats, Integers]:
    """Directions (n, N - 1) with those that a slow motion hides, and the first one of each trial with its row (n, 1).

    Between two intervals with the same direction the device did not turn, and it began in the first that is seen.
    """
    count = direction.shape[1]
    sure = np.abs(direction) > NEARLY
    at = np.broadcast_to(np.arange(count), direction.shape)
    before = np.maximum.accumulate(np.where(sure, at, -1), axis=1)
    after = np.minimum.accumulate(np.where(sure, at, count)[:, ::-1], axis=1)[:, ::-1]
    sign = np.sign(direction)
    following = np.take_along_axis(sign, np.minimum(after, count - 1), axis=1) * (after < count)
    former = np.where(before < 0, following, np.take_along_axis(sign, np.maximum(before, 0), axis=1))
    same = ~sure & (former == following)
    # in a longer doubt the turn is taken in its middle: how far that is off is alike in all trials
    doubt = ~sure & ~same & (after - before > LONGEST_TURN)
    turned = 2 * at >= before + after
    direction = np.where(doubt, np.where(turned, following, former), direction)
    return np.where(same, former, direction), following[:, :1], after[:, :1]


@dataclass(frozen=True, eq=False)
class Forces:
    """What the joint balance of an experiment tells; a term that it does not tell is absent from ``value``.

    Parameters
    ----------
    value, half_width : dict of str to float
        By the names of `TERMS`, with half of the 95 % interval, in SI (the delay in seconds beyond the one that the
        sums were made with).
    bound : dict of str to float
        Upper ends of the 95 % intervals of mass and damping if there were no friction, where friction is not told
        from them; else empty.
    trials : int
        That say something.
    one_way : bool
        Whether friction and a constant force are one number, which ``friction`` then holds.
    asked_for : frozenset of str
        Friction, stiffness and constant force as far as the logs do not follow without them.
    """

    value: dict[str, float]
    half_width: dict[str, float]
    bound: dict[str, float]
    trials: int
    one_way: bool
    asked_for: frozenset[str]


def identify(sums: Floats, period: float) -> Forces | None:
    """Return what all trials of an experiment tell together, or None where none says anything.

    Parameters
    ----------
    sums : float64, shape (n, 55)
        By `balance_sums`; NaN for a trial without.
    period : float
        Sampling period T [s].

    Notes
    -----
    What cannot be told is found before any interval. Of a motion one way, friction and a constant force are one
    number. With friction, a motion under one constant force F tells mass and damping no more: (m, b, c) moves as
    ((1 - c/F) m_0, (1 - c/F) b_0, c), so that m_0 and b_0 are upper bounds. Of the terms that can be told, those are
    part of the model whose absence raises the squared residual, and which lie apart from 0.

    Errors add up those of the readings, the scatter between trials (by leaving out each in turn), and `MODEL_ERROR`.
    """
    if not sums.shape[1]:  # no trial has any
        sums = np.full((len(sums), _COLUMNS * (_COLUMNS + 1) // 2), np.nan)
    known = np.isfinite(sums).all(axis=1) & (sums[:, :1] > 0).any(axis=1)
    products = np.zeros((int(known.sum()), _COLUMNS, _COLUMNS))
    i, j = np.triu_indices(_COLUMNS)
    products[:, i, j] = products[:, j, i] = sums[known]
    if not len(products):
        return None
    model = _Model(products, LARGEST_REST * period)
    terms = [*TERMS] if model.turns else [*TERMS[:-1]]
    one_way = model.share(["friction", "constant_force"], "constant_force") < LEAST_SHARE
    if one_way:
        terms.remove("constant_force")
    if not model.tells(terms, "stiffness"):
        terms.remove("stiffness")
    if not (model.tells(terms, "mass") and model.believable(terms)):
        terms = [term for term in terms if term not in ("friction", "turning")]
        bound = {}
        # after a turn less friction is no longer like more mass
        if not model.turns and model.tells(terms, "mass"):
            value, error = model.fit(terms)
            bound = {term: value[term] + _half(error[term], len(products)) for term in ("mass", "damping")}
        bound = bound if min(bound.values(), default=0.0) > 0 else {}
        return Forces({}, {}, bound, len(products), one_way, frozenset())
    told = [term for term in OPTIONAL if term in terms and model.tells(terms, term)]
    for term in told:
        if not model.asks_for(terms, term):
            terms.remove(term)
    asked = frozenset(terms).intersection(told)
    if "friction" not in terms and "turning" in terms:
        terms.remove("turning")
    value, error = model.fit(terms)
    for term in OPTIONAL:
        if term in told and term not in terms:
            more = model.fit([*terms, term])
            value[term], error[term] = more[0][term], more[1][term]
        elif term not in told:
            value.pop(term, None)
    return Forces(value, {t: _half(error[t], len(products)) for t in value}, {}, len(products), one_way, asked)


def _half(error: float, trials: int) -> float:
    """Half of a 95 % interval."""
    return float(student_95(max(trials - 1, FEWEST_FREEDOM))) * error


class _Model:
    """Least squares of the summed products of trials."""

    def __init__(self, products: Floats, reach: float) -> None:
        self.reach = reach
        self.all = products.sum(axis=0)
        self.turns = bool(self.all[TERMS.index("turning"), TERMS.index("turning")] > 0)
        others = self.all - products
        self.others = others if len(products) > 2 else others[:0]

    def size(self, term: str) -> float:
        """Value with which a term alone is as large as the force."""
        at = TERMS.index(term)
        return float(np.sqrt(self.all[-1, -1] / self.all[at, at])) if self.all[at, at] > 0 else np.inf

    def solve(self, sums: Floats, terms: list[str]) -> tuple[Floats, Floats, Floats]:
        """Values (m, p), their covariance but for the variance of the residual, and its sum of squares (m,)."""
        index = [TERMS.index(term) for term in terms]
        normal = sums[:, index][:, :, index]
        size = np.sqrt(np.einsum("mii->mi", normal))
        eigenvalue, axes = np.linalg.eigh(normal / size[:, :, None] / size[:, None, :])
        # what rounding leaves of terms that are alike is a large variance, not a negative one
        axes = axes / size[:, :, None]
        inverse = (axes / np.maximum(eigenvalue, ROUNDING)[:, None, :]) @ np.swapaxes(axes, 1, 2)
        force = np.zeros((len(sums), _COLUMNS))
        force[:, -1] = 1.0
        for _ in range(_ROUNDS):
            right = np.einsum("mij,mj->mi", sums, force)
            value = np.einsum("mij,mj->mi", inverse, right[:, index])
            delay = np.clip(value[:, terms.index("delay")], -self.reach, self.reach)
            # the force arrives later than it was integrated from, and so does the friction of the first motion
            force[:, -3] = delay**2
            force[:, -2] = delay * value[:, terms.index("friction")] if "friction" in terms else 0.0
        right = np.einsum("mij,mj->mi", sums, force)
        square = np.einsum("mi,mi->m", force, right) - np.einsum("mi,mi->m", value, right[:, index])
        return value, inverse, np.maximum(square, 0.0)

    def fit(self, terms: list[str]) -> tuple[dict[str, float], dict[str, float]]:
        """Values of the terms, and their standard errors."""
        values, inverse, square = self.solve(self.all[None], terms)
        count = 1e3
        variance = np.diag(inverse[0]) * max(square[0] / count, 1.0)
        if len(self.others):
            left = self.solve(self.others, terms)[0]
            variance = variance + (len(left) - 1) * left.var(axis=0)
        sizes = [self.size(t) if t in OPTIONAL else abs(v) for t, v in zip(terms, values[0], strict=True)]
        error = np.hypot(np.sqrt(variance), MODEL_ERROR * np.array(sizes))
        return dict(zip(terms, values[0].tolist(), strict=True)), dict(zip(terms, error.tolist(), strict=True))

    def share(self, terms: list[str], term: str) -> float:
        """Part of a term that the others leave."""
        index = [TERMS.index(t) for t in terms]
        normal = self.all[np.ix_(index, index)]
        size = np.sqrt(np.diag(normal))
        if not (size > 0).all():
            return 0.0
        eigenvalue, axes = np.linalg.eigh(normal / size / size[:, None])
        at = axes[terms.index(term)]
        return float(1 / np.sqrt((at**2 / np.maximum(eigenvalue, ROUNDING)).sum()))

    def tells(self, terms: list[str], term: str) -> bool:
        """Whether a term is told from the others: they leave some of it, and its error is small."""
        if self.share(terms, term) < LEAST_SHARE:
            return False
        value, error = (found[term] for found in self.fit(terms))
        return error < LARGEST_ERROR * (self.size(term) if term in OPTIONAL else abs(value))

    def asks_for(self, terms: list[str], term: str) -> bool:
        """Whether the logs do not follow without a term, and it lies apart from 0."""
        without = [other for other in terms if other != term]
        with_it, left = (self.solve(self.all[None], some)[2][0] for some in (terms, without))
        value, error = (found[term] for found in self.fit(terms))
        missed = with_it < ASKED_FOR * left or not self.believable(without)
        # no friction helps the motion
        size = value if term == "friction" else abs(value)
        return bool(missed and size > max(NEGLIGIBLE * self.size(term), SIGNIFICANT * error))

    def believable(self, terms: list[str]) -> bool:
        """Whether the delay that the terms leave is one: what they lack, a long delay imitates."""
        return abs(self.fit(terms)[0]["delay"]) <= LONGEST_DELAY * self.reach

"""The likeliest device: start by integrated balances, then Newton's steps on the likelihood of all trials."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.measured.model.motion import SHORTEST_LAG, Physics
from pipeline.measured.model.recordings import Stretches
from pipeline.measured.model.scatter import FEWEST, Moments, Solved, solve
from pipeline.measured.model.whitening import Filter, Passage, passed
from pipeline.records.batch import Floats

SHAPE = ("delta", "gamma", "delay", "lag", "turn", "ratio", "share")
"""Numbers that the shape of a motion depends on; it is linear in the others."""

LINEAR = ("gain", "coulomb", "force")
"""Acceleration per command, by friction and by a constant force; units of `Scales`, time in samples."""

SCATTERED = ("delay", "coulomb", "force")
"""Numbers that may differ from trial to trial."""

FIXED_STEPS = 4
"""Steps at first without such scatter: far from the solution it would explain everything."""

LIMITS = {
    "gain": (1e-12, np.inf),
    "delta": (-0.01, 2.0),
    "gamma": (-1e-4, 2.0),
    "delay": (0.0, 300.0),
    "lag": (SHORTEST_LAG, 300.0),
    "turn": (0.002, 3.0),
    "ratio": (0.0, 0.5),
    "share": (1e-4, 0.97),
}
LARGEST_STEP = {"delta": 0.2, "gamma": 0.2, "delay": 1.5, "lag": 1.5, "turn": 0.1, "ratio": 0.1, "share": 0.1}
"""Change of a number in one step within which the response is near a straight line."""

SMALL = 1e-5
"""Change of a number for a slope: rounding of 1e-16 then leaves eleven digits of it."""

STEPS = 18
"""Newton's steps at most; seven are usual, a mode may take all."""

DONE = 1e-3
"""Square of a step in standard errors at which the search ends: 0.03 of the interval's half width."""

PORTIONS = 16
"""Portions of few logs, whose own numbers show what is not independent within a log; Student's t is then 2.13."""

ROBUST_ROUNDS = 4
"""Rounds of least squares and weights for a start."""

TOGETHER = 3_000_000
"""Numbers in the columns of stretches that are computed together, 24 MB."""

MEMORIES = (3e5, 1e-12)
"""Largest and least variance of the disturbing force in that of a reading, per sample: from a random walk that forgets
in a sample to one that forgets in a thousand."""


@dataclass(frozen=True, eq=False)
class Device:
    """Numbers of a device by name, and the variance of the random force, in that of a reading."""

    numbers: dict[str, float]
    disturbance: float = 0.0
    effects: Floats | None = field(default=None, repr=False)

    @property
    def shape(self) -> Physics:
        """Its numbers that shape a motion."""
        return Physics(**{name: self.numbers[name] for name in SHAPE if name in self.numbers})

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its numbers, in the order of columns."""
        return tuple(self.numbers)

    def stepped(self, step: Floats) -> Device:
        """Return the device after a step, each number within its limits."""
        moved = dict(self.numbers)
        for (name, value), change in zip(self.numbers.items(), step.tolist(), strict=True):
            most = LARGEST_STEP.get(name, 0.5 * abs(value) if name == "gain" else np.inf)
            low, high = LIMITS.get(name, (-np.inf, np.inf))
            moved[name] = float(np.clip(value + np.clip(change, -most, most), low, high))
        return replace(self, numbers=moved)

    def effect(self, name: str, trials: np.ndarray) -> Floats:
        """Return what a number is beside the common one in the trial of each stretch, shape (S,)."""
        if self.effects is None or name not in self.numbers:
            return np.zeros(len(trials))
        return np.asarray(self.effects[trials, self.names.index(name)])


@dataclass(frozen=True, eq=False)
class Fit:
    """A device with what its likelihood says: ``solved`` at the device, whose units are portions of ``few`` logs, else
    trials; ``log_spread`` is the sum over all rows."""

    device: Device
    solved: Solved
    few: bool
    log_spread: float

    @property
    def likelihood(self) -> float:
        """Restricted logarithm of the likelihood, filter included."""
        return self.solved.likelihood - self.log_spread


def chunks(held: Stretches, columns: int) -> list[np.ndarray]:
    """Return the stretches that are computed together."""
    size = max(1, int(TOGETHER / (held.position.shape[0] * columns)))
    order = np.argsort(held.rows, kind="stable") if len(held) > size else np.arange(len(held))
    return [order[i : i + size] for i in range(0, len(held), size)]


def portions_of(held: Stretches, trials: int) -> int:
    """Return into how many portions each stretch is cut; 0 with `FEWEST` trials, each of which is one unit."""
    return 0 if trials >= FEWEST else max(1, -(-PORTIONS // max(len(held), 1)))


def moments_of(held: Stretches, device: Device, trials: int) -> tuple[Moments, float]:
    """Return the moments of all units (trials, or portions) at a device, and the summed logarithms of spreads."""
    p, portions = len(device.names), portions_of(held, trials)
    units = len(held) * portions if portions else trials
    total, rows, spreads = np.zeros((units, p + 1, p + 1)), np.zeros(units), 0.0
    for some in chunks(held, p + 8):
        part = held.chosen(some)
        left, spread, starts = _columns(part, device)
        spreads += spread
        if not portions:
            np.add.at(total, part.trial, left.transpose(0, 2, 1) @ left)
            np.add.at(rows, part.trial, part.rows - starts)
            continue
        for portion in range(portions):
            first, behind = (part.rows * each // portions for each in (portion, portion + 1))
            at = np.arange(left.shape[1])
            inside = (at >= first[:, None]) & (at < behind[:, None])
            cut = left * inside[..., None]
            total[some * portions + portion] = cut.transpose(0, 2, 1) @ cut
            rows[some * portions + portion] = behind - first - starts / portions
    return Moments(total, rows), spreads


def residuals(held: Stretches, device: Device) -> tuple[Filter, Floats, Floats]:
    """Return the filter, whitened columns (N, S, 1 + 3 + starts) and the states (S, C, n) that they start from.

    Columns are the readings, what command, friction and constant force of 1 do, and the unknowns of the start.
    """
    passage = Passage(held, device.shape)
    found = Filter.of(passage, device.disturbance)
    starts = passage.starts()
    count, rows, n = len(held), len(held.position), passage.states
    columns = 4 + len(starts)
    added = np.zeros((rows, count, columns, n))
    added[:, :, 1] = passage.added(held.command, None)
    added[:, :, 2] = passage.added(None, -held.direction)
    added[:, :, 3] = passage.added(None, np.ones_like(held.direction))
    begin = np.zeros((count, columns, n))
    for place, (state, more) in enumerate(starts):
        begin[:, 4 + place] = state
        if more is not None:
            added[:, :, 4 + place] = more
    readings = np.zeros((rows, count, columns))
    readings[:, :, 0] = held.position
    errors = passed(passage, found, readings, begin, added)
    errors[:, :, 1:] *= -1
    return found, errors, begin


def _columns(held: Stretches, device: Device) -> tuple[Floats, float, Floats]:
    """Return columns and errors without the start (S, N, p + 1), the filter's spreads, and unknowns of each start."""
    found, errors, begin = residuals(held, device)
    numbers = device.numbers
    own = {name: numbers.get(name, 0.0) + device.effect(name, held.trial) for name in LINEAR}
    whole = sum(own[name][None, :] * errors[:, :, 1 + i] for i, name in enumerate(LINEAR))
    starts = errors[:, :, 4:].transpose(1, 0, 2)
    left = (errors[:, :, 0] - whole).T
    q, r = np.linalg.qr(starts)
    fitted = np.linalg.pinv(r, rcond=1e-11) @ np.einsum("snc,sn->sc", q, left)[..., None]
    base = {name: errors[:, :, 1 + i].T for i, name in enumerate(LINEAR)}
    base |= _slopes(held, device, found, own, fitted[..., 0], begin[:, 4:], left - (starts @ fitted)[..., 0])
    error = errors[:, :, 0] - sum(numbers.get(name, 0.0) * errors[:, :, 1 + i] for i, name in enumerate(LINEAR))
    error = error.T
    columns = np.stack([*(base[name] for name in device.names), error], axis=-1)
    reduced = columns - q @ (q.transpose(0, 2, 1) @ columns)
    spread = np.log(np.broadcast_to(found.spread, held.position.shape)[held.valid]).sum()
    return reduced, float(spread), np.full(len(held), starts.shape[2]) - held.rests * (starts.shape[2] - 1)


def _slopes(
    held: Stretches,
    device: Device,
    found: Filter,
    own: dict[str, Floats],
    fitted: Floats,
    begin: Floats,
    base: Floats,
) -> dict[str, Floats]:
    """Return the slope of the prediction along each number of the shape, (S, N) by name; starts stay as fitted."""
    start = np.einsum("sc,scn->sn", fitted, begin)[:, None]
    result = {}
    for name in (each for each in SHAPE if each in device.numbers):
        passage = Passage(held, device.shape.moved(name, SMALL))
        force = own["force"][None, :] - own["coulomb"][None, :] * held.direction
        added = passage.added(held.command * own["gain"][None, :], force)
        if held.rests.any():
            added = added + fitted[None, :, :1] * passage.holding()
        errors = passed(passage, found, held.position[..., None], start, added[:, :, None])
        result[name] = -(errors[:, :, 0].T - base) / SMALL
    return result


def refined(held: Stretches, device: Device, trials: int, steps: int = STEPS) -> Fit:
    """Return the likeliest device near one, with the random force that makes its errors independent.

    Parameters
    ----------
    held : Stretches
    device : Device
    trials : int
        Number of trials, of which some may have no stretch.
    steps : int
        Most steps.
    """
    scattered = SCATTERED if trials >= FEWEST else ()
    places = np.array([i for i, name in enumerate(device.names) if name in scattered], dtype=np.int64)
    free = np.empty(0, dtype=np.int64)
    best: Fit | None = None
    for count in range(steps):
        if count % FIXED_STEPS == 1:
            device = replace(device, disturbance=disturbing(held, device, narrow=count > 1))
        moments, spread = moments_of(held, device, trials)
        if not np.isfinite(moments.products).all():
            break
        solved = solve(moments, places if count >= FIXED_STEPS else free)
        effects = solved.effects if trials >= FEWEST and count >= FIXED_STEPS else None
        fit = Fit(replace(device, effects=effects), solved, trials < FEWEST, spread)
        if best is None or count == FIXED_STEPS or fit.likelihood > best.likelihood:
            best = fit
        square = float(solved.step @ solved.total @ solved.step)
        if square < DONE and count > FIXED_STEPS + 1:
            return fit
        device = replace(device.stepped(solved.step), effects=effects)
    assert best is not None
    return best


def disturbing(held: Stretches, device: Device, narrow: bool = False) -> float:
    """Return the variance of the random force [readings' variance] under which the errors are likeliest."""
    from scipy.optimize import minimize_scalar

    some = held.chosen(_spread(held, 60))

    def cost(log: float) -> float:
        found, errors, _ = residuals(some, replace(device, disturbance=float(np.exp(log))))
        own = [device.numbers.get(name, 0.0) + device.effect(name, some.trial) for name in LINEAR]
        left = (errors[:, :, 0] - sum(each * errors[:, :, 1 + i] for i, each in enumerate(own))).T
        # the constant force of each stretch is free, so that it is not taken for a random one
        starts = np.concatenate([errors[:, :, 4:], errors[:, :, 3:4]], axis=2).transpose(1, 0, 2)
        q, _ = np.linalg.qr(starts)
        left = left - (q @ (q.transpose(0, 2, 1) @ left[..., None]))[..., 0]
        squares = np.maximum((left**2).sum(axis=1), 1e-300)
        rows = np.maximum(some.rows - starts.shape[2], 1)
        spread = np.log(np.broadcast_to(found.spread, some.position.shape)[some.valid]).sum()
        return float(0.5 * (rows * np.log(squares / rows)).sum() + spread)

    high, low = (float(np.log(each)) for each in MEMORIES)
    if narrow and device.disturbance > 0:
        low, high = np.log(device.disturbance) - 2.5, np.log(device.disturbance) + 1.5
    options = {"xatol": 0.03 if narrow else 0.5, "maxiter": 10}
    found = minimize_scalar(cost, bounds=(low, high), method="bounded", options=options)
    none = cost(-np.inf)
    return 0.0 if none <= found.fun + 1.0 else float(np.exp(found.x))


def _spread(held: Stretches, most: int) -> np.ndarray:
    """Return the places of at most so many stretches, evenly among all."""
    return np.unique(np.linspace(0, len(held) - 1, min(most, len(held))).round().astype(int))


def begun(held: Stretches, names: tuple[str, ...], most_delay: float) -> Device:
    """Return a device from which a search starts: the best integer delay for the twice integrated balance of forces.

    With y the position, y = start + gain u'' - delta y' - gamma y'' - coulomb s'' + force t^2/2, where ' is an integral
    from the stretch's start: linear, and errors of readings enter almost undisturbed.
    """
    some = held.chosen(_spread(held, 60))
    rows = len(some.position)
    t = np.where(some.valid, some.time[some.lead : some.lead + rows] - some.time[some.lead], 0.0)
    dt = np.diff(some.time[some.lead : some.lead + rows + 1], axis=0)
    y = some.position
    behind = np.vstack([y[1:], y[-1:]])
    middle = np.where(np.vstack([some.valid[1:], np.zeros((1, len(some)), bool)]), 0.5 * (y + behind), y)
    once = np.vstack([np.zeros((1, len(some))), np.cumsum(middle * dt, axis=0)[:-1]])
    best: tuple[float, dict[str, float]] = (np.inf, {})
    for delay in np.arange(0.0, most_delay + 0.5) if "delay" in names else (0.0,):
        passage = Passage(some, Physics(delay=float(delay)))
        forces = [passage.added(some.command, None)]
        forces += [passage.added(None, each) for each in (middle, some.direction, np.ones_like(y))]
        none = Filter(np.zeros((rows, 1, 2)), np.ones((rows, 1)))
        start = np.zeros((len(some), 4, 2))
        twice = -passed(passage, none, None, start, np.stack(forces, axis=2))
        known = {"gain": twice[..., 0], "delta": -once, "gamma": -twice[..., 1], "coulomb": -twice[..., 2]}
        known["force"] = twice[..., 3]
        known = {name: known[name] for name in names if name in known}
        columns = np.stack([*known.values(), y], axis=-1) * some.valid[..., None]
        starts = [np.ones_like(t), *([] if some.rests.all() else [t * ~some.rests])]
        q, _ = np.linalg.qr(np.stack([each * some.valid for each in starts], axis=-1).transpose(1, 0, 2))
        columns = columns.transpose(1, 0, 2)
        columns = columns - q @ (q.transpose(0, 2, 1) @ columns)
        found, left = _robust(columns.transpose(0, 2, 1) @ columns)
        if left < best[0]:
            best = left, dict(zip(known, found.tolist(), strict=True)) | {"delay": float(delay)}
    start_at = {"delta": 0.0, "force": 0.0, "lag": 0.5} | best[1]
    if not start_at.get("gain"):
        start_at["gain"] = 1e-3
    return Device({name: float(np.clip(start_at[name], *LIMITS.get(name, (-np.inf, np.inf)))) for name in names})


def _robust(products: Floats) -> tuple[Floats, float]:
    """Return least squares over stretches, and what is left; one that is left much more than most weighs little."""
    weight = np.ones(len(products))
    for _ in range(ROBUST_ROUNDS):
        total = (products * weight[:, None, None]).sum(axis=0)
        found = np.linalg.lstsq(total[:-1, :-1], total[:-1, -1], rcond=1e-12)[0]
        whole = np.append(-found, 1.0)
        left = np.maximum(np.einsum("i,tij,j->t", whole, products, whole), 1e-300)
        middle = float(np.median(left))
        weight = middle / (middle + left)
    return found, float(np.log(left).sum())

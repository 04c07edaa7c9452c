"""Evaluate the likelihood of a device for all trials, with its derivatives along the numbers of the device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pipeline.measured.identification import kernels
from pipeline.measured.identification.drive import DRIVE, applied_command
from pipeline.measured.identification.free_runs import free_runs
from pipeline.measured.identification.motion import (
    GRAVITY,
    LARGEST_LOAD,
    SHAPE_NUMBERS,
    SHORTEST_LAG,
    PlantShape,
    Transitions,
)
from pipeline.measured.identification.noise import WHITE, Noise, gains_of
from pipeline.measured.identification.scatter import FEWEST, Moments, Solved, inverse, solve
from pipeline.measured.identification.segments import Segments
from pipeline.records.trials import Floats, Integers

LINEAR = ("gain", "coulomb", "force")
"""Numbers in which the motion is linear: acceleration per unit of command, due to friction and due to a constant force.
They are in `LogUnits`, with time in samples."""

FREE_STARTS = 3
"""Number of Newton steps for the initial states of free runs, which are linear except for friction."""

SETTLED = 1e-4
"""Threshold for the predicted decrease of the squared errors of a free run, relative to its mean squared error. Below
it, the initial state of the run is settled. The log-likelihood then changes by half of this value."""

DIVERGED = 1e6
"""Position of a free run that overflows from all initial states, in units of the largest travel of the logs."""

NUDGE = 1e-4
"""Perturbation for numerical derivatives of free runs, relative to the size of the number."""

SCATTERED = ("delay", "coulomb", "force")
"""Numbers that may vary from trial to trial."""

LIMITS = {
    "limit": (1e-3, 1.0),
    "asymmetry": (-0.95, 0.95),
    "curvature": (-1.0, 0.6),
    "gain": (1e-12, np.inf),
    "delta": (-0.01, 2.0),
    "gamma": (-1e-4, 2.0),
    "delay": (0.0, 300.0),
    "lag": (SHORTEST_LAG, 300.0),
    "mode_frequency": (2e-4, 3.0),
    "mode_damping_ratio": (1e-4, 0.5),
    "load_mass_fraction": (1e-4, LARGEST_LOAD),
    "load_damping": (-0.01, 2.0),
    "load_coulomb": (0.0, np.inf),
    "spring_damping_fraction": (1e-4, 0.999),
}
FREE_LIMITS = LIMITS | {"coulomb": (0.0, np.inf)}
"""Limits in free runs, in which friction acts against the simulated motion and negative friction has no effect."""

BEFORE = {"spring_damping_fraction": (0.5, 12.0)}
"""Mean and information of the prior of a number. The prior of a fraction covers all values between 0 and 1."""

LARGEST_STEP = {
    "limit": 0.05,
    "asymmetry": 0.2,
    "curvature": 0.1,
    "delta": 0.2,
    "gamma": 0.2,
    "delay": 1.5,
    "lag": 1.5,
    "mode_frequency": 0.1,
    "load_mass_fraction": 0.1,
    "load_damping": 0.2,
    "spring_damping_fraction": 0.3,
}
"""Largest change of a number in one step. Up to this change, the response is approximately linear."""

BY_HALF = ("gain", "mode_damping_ratio", "mode_frequency")
"""Numbers that change by at most one half of their value in a step. A lightly damped mode is so sharply determined that
a full step would lose it."""

DONE = 1e-3
"""Squared step, in standard errors, at which the search ends. The step is then 0.03 standard errors."""

PORTIONS = 16
"""Number of portions into which few logs are divided. Their separate estimates show the correlation within a log, with
a Student's t of 2.13."""

PHASES = 8
"""Number of phases of the motion. Unmodelled effects differ between phases. Damping depends on the direction, the force
of a hand on the displacement, and backlash on the speed."""

TOGETHER = 3_000_000
"""Largest number of values in the columns of segments that are computed together (24 MB)."""

ROUNDED_ROW = 0.01
"""Gain of log-likelihood per row up to which a random force is attributed to rounding. Neither jitter nor another part
is then searched for."""

LARGEST_FACTOR = 1e30
"""Largest root sum of squares of a column, in units near 1. If it is larger, other columns cannot be computed in double
precision."""

WORTH = 5.0
"""Smallest gain of log-likelihood for which a part of the device or of its noise is accepted (odds of 150 to 1)."""


@dataclass(frozen=True, eq=False)
class Device:
    """Numbers of a device by name, and its noise.

    ``effects`` (T, p) are deviations of the trials. ``reading`` is the variance of a reading from a fit, or infinite.
    """

    numbers: dict[str, float]
    noise: Noise = WHITE
    effects: Floats | None = field(default=None, repr=False)
    reading: float = np.inf

    @property
    def shape(self) -> PlantShape:
        """Numbers that determine the shape of the motion."""
        return PlantShape.of(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in the order of the columns."""
        return tuple(self.numbers)

    def stepped(self, step: Floats, limits: Mapping[str, tuple[float, float]] = LIMITS) -> Device:
        """Return the device after a step, with each number within its limits."""
        moved = dict(self.numbers)
        for (name, value), change in zip(self.numbers.items(), step.tolist(), strict=True):
            most = min(LARGEST_STEP.get(name, np.inf), 0.5 * abs(value) if name in BY_HALF else np.inf)
            low, high = limits.get(name, (-np.inf, np.inf))
            moved[name] = min(max(value + min(max(change, -most), most), low), high)
        return replace(self, numbers=moved)

    def own(self, name: str, trials: np.ndarray) -> Floats:
        """Return a number for the trial of each segment, shape (S,), or 0 if the device does not have this number."""
        common = self.numbers.get(name, 0.0)
        if self.effects is None or name not in self.numbers:
            return np.full(len(trials), common)
        return np.asarray(common + self.effects[trials, self.names.index(name)])


@dataclass(frozen=True, eq=False)
class Fit:
    """Device with its likelihood and derived results.

    Parameters
    ----------
    device : Device
    solved : Solved
        Solution at the device, from its ``moments``.
    moments : Moments
    places : int64
        Indices of the numbers that vary between trials.
    few : bool
        Whether there are few logs. Units are then portions instead of trials.
    repeats : float
        Mean number of consecutive equal readings, which count as one reading.
    open : float64, shape (p,)
        Change of the numbers if the jitter is larger by its standard error; computed by `search.ended`.
    phases : float64, shape (8, p)
        Contribution of each phase of the motion, which is only noise if the model is complete; computed by
        `search.ended`.
    optima : float64, shape (k, p)
        Steps to other optima of the likelihood that the logs do not exclude.
    """

    device: Device
    solved: Solved
    moments: Moments
    places: Integers
    few: bool
    repeats: float
    open: Floats
    phases: Floats
    optima: Floats

    @property
    def likelihood(self) -> float:
        """Restricted log-likelihood."""
        return self.solved.likelihood


CODES = {
    "gain": kernels.GAIN,
    "coulomb": kernels.COULOMB,
    "force": kernels.FORCE,
    **{name: kernels.FIELDS + place for place, name in enumerate((*GRAVITY, "spring"))},
    **{name: -1 - place for place, name in enumerate(DRIVE)},
}
"""Codes of the columns of `kernels.whitened` for the numbers in which the motion is linear, and for the drive."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Whitened prediction errors of segments with their derivatives, after elimination of the initial states.

    Parameters
    ----------
    values : float64, shape (rows of all segments + S q, p + 1)
        Derivatives of the predictions along p numbers, and the errors. The rows of each segment are followed by q rows
        for the prior of its initial state.
    first, behind : int64, shape (S,)
        Rows of each segment in ``values``, without the rows of the initial states.
    starts : int
        Number q of unknowns in an initial state.
    known : float64, shape (S,)
        Number of these unknowns that the readings determine.
    lost : float
        Reduction of the log-likelihood due to the innovation variances of the filter and the unknown initial states.
    spread : float64, shape (rows of all segments,), or (1,)
        Standard deviations of the errors, relative to the standard deviation of a reading.
    """

    values: Floats
    first: Integers
    behind: Integers
    starts: int
    known: Floats
    lost: float
    spread: Floats


def columns_of(
    segments: Segments,
    device: Device,
    names: tuple[str, ...],
    transitions: Transitions | None = None,
    whole: Segments | None = None,
) -> Columns:
    """Return the whitened prediction errors of segments, with derivatives along some numbers of the device.

    ``transitions`` are the transitions with derivatives along ``names``, if already computed. ``whole`` contains all
    segments if ``segments`` is a subset of them; it determines the prior of the initial state.
    """
    whole, shape, noise = whole or segments, device.shape, device.noise
    if segments.free:
        return _free_columns(segments, device, names, whole)
    along = [name for name in SHAPE_NUMBERS if name in names]
    if transitions is None:
        transitions = Transitions.of(segments, shape, noise.jitter, along)
    own = np.empty((len(segments), len(LINEAR)))
    for place, name in enumerate(LINEAR):
        own[:, place] = device.own(name, segments.trial)
    shifts = np.zeros((len(segments), len(names)))
    for place, name in enumerate(names):
        if device.effects is not None and name in LINEAR:
            shifts[:, place] = own[:, LINEAR.index(name)] - device.numbers[name]
    # third differences of logs without noise contain the motion
    gain, variance = abs(device.numbers["gain"]), min(whole.white, device.reading)
    mode = [gain / shape.mode_frequency**2, gain / shape.mode_frequency] if shape.load_mass else []
    sizes = np.array([1.0 + whole.largest, 1.0, *mode, *([gain] if shape.lag else [])])
    if segments.rests.all():
        sizes = sizes[:1]
    constants = [shape.gamma, shape.lag, shape.delay, variance, segments.lead]
    driven = any(name in device.numbers for name in DRIVE)
    commands = applied_command(segments.command, device.numbers) if driven else segments.command[None]
    gains = gains_of(segments, transitions, noise, commands[0])
    values, known, lost = kernels.whitened(
        (segments.time, commands, segments.position, _weight(segments, device)),
        (segments.first, segments.behind, segments.begin, segments.edge, segments.direction, own, shifts),
        transitions.motion,
        transitions.pieces,
        gains,
        (
            np.array([CODES[name] if name in CODES else kernels.SHAPE + along.index(name) for name in names], np.int64),
            np.array([along.index(name) if name in along else -1 for name in ("gamma", "lag", "delay")], np.int64),
            np.array(constants, dtype=np.float64),
            sizes,
        ),
    )
    ends = np.cumsum(segments.rows + len(sizes))
    return Columns(values, ends - len(sizes) - segments.rows, ends - len(sizes), len(sizes), known, lost, gains[1])


def _weight(segments: Segments, device: Device) -> Floats:
    """Return the acceleration due to gravity and its derivatives along `GRAVITY`, (3, R), or (1, 0) without gravity.

    The angles are those of the readings. Their errors hardly affect the acceleration.
    """
    if GRAVITY[0] not in device.numbers:
        return np.empty((1, 0))
    columns = np.stack([-np.sin(segments.angle), -np.cos(segments.angle)])
    return np.concatenate([(np.array([device.numbers[name] for name in GRAVITY]) @ columns)[None], columns])


def _unknown_starts(segments: Segments, device: Device, largest: float) -> tuple[Floats, Floats]:
    """Return the sizes (q,) of the unknown initial values, and the states of both sides per unit of each, (n, q)."""
    shape, gain = device.shape, abs(device.numbers["gain"])
    mode = [gain / shape.mode_frequency**2, gain / shape.mode_frequency] if shape.load_mass else []
    sizes = np.array([1.0 + largest, 1.0, *mode, *([gain] if shape.lag else [])])
    states = np.eye(len(sizes))
    if mode:
        # the position of the load is relative to the motor
        states[2, 0], states[3, 1] = 1.0, 1.0
    return sizes, states


@np.errstate(all="ignore")  # as in `moments_of`
def free_motion(segments: Segments, device: Device, variance: float, largest: float) -> tuple[Floats, Floats, Floats]:
    """Return free runs from their maximum-likelihood initial states, derivatives along the unknowns, and the unknowns.

    The shapes are (rows,), (rows, q) and (S, q) for q unknowns.
    """
    sizes, states = _unknown_starts(segments, device, largest)
    q, ends = len(sizes), np.cumsum(segments.rows)[:-1]
    readings = np.split(segments.position[segments.places], ends)
    prior = np.diag(np.sqrt(variance) / sizes)
    nudges = np.diag(NUDGE * np.minimum(sizes, 1.0))
    tried = np.zeros((len(segments), q))
    for s, (y, rests) in enumerate(zip(readings, segments.rests, strict=True)):
        few = min(len(y) - 1, 5)
        tried[s, :2] = y[0], 0.0 if rests else (y[few] - y[0]) / max(few, 1)
    starts, least, ahead = tried.copy(), np.full(len(tried), np.inf), np.full(len(tried), np.inf)
    motion, along = [np.full(len(y), DIVERGED) for y in readings], [np.zeros((len(y), q)) for y in readings]
    for _ in range(FREE_STARTS + 1):
        versions = np.concatenate([tried[:, None], tried[:, None] + nudges], axis=1)
        runs = np.split(_runs(segments, device, versions @ states.T), ends)
        for s, (y, run) in enumerate(zip(readings, runs, strict=True)):
            error = np.concatenate([y - run[:, 0], -prior @ tried[s]])
            columns = np.vstack([(run[:, 1:] - run[:, :1]) / np.diagonal(nudges), prior])
            cost = float(error @ error)
            if cost < least[s] and np.isfinite(columns).all():
                least[s], starts[s], motion[s], along[s] = cost, tried[s], run[:, 0], columns[: len(y)]
                step = np.linalg.lstsq(columns, error, rcond=None)[0]
                tried[s], ahead[s] = tried[s] + step, float(((columns @ step) ** 2).sum())
            else:
                tried[s] = 0.5 * (starts[s] + tried[s])
        if (ahead <= SETTLED * least / segments.rows).all():
            break
    return np.concatenate(motion), np.concatenate(along), starts


def _runs(segments: Segments, device: Device, starts: Floats) -> Floats:
    """Return free runs of a device from initial states (S, V, n), shape (rows, V)."""
    gain, coulomb, force = (device.own(name, segments.trial) for name in LINEAR)
    load = np.full(len(segments), device.numbers.get("load_coulomb", 0.0))
    forces = [(float(g), each) for g, each in zip(gain, np.stack([force, coulomb, load], axis=1), strict=True)]
    return free_runs(segments, device.numbers, forces, starts)


def whitened_errors(columns: Floats, coefficients: tuple[float, ...], first: int) -> tuple[Floats, Floats]:
    """Return columns of one segment after the filter that whitens its errors, split before the column ``first``."""
    whole = columns.copy()
    for back, coefficient in enumerate(coefficients[1:], start=1):
        whole[back:] += coefficient * columns[:-back]
    return whole[:, :first], whole[:, first:]


@np.errstate(all="ignore")  # as in `moments_of`
def _free_columns(segments: Segments, device: Device, names: tuple[str, ...], whole: Segments) -> Columns:
    """Return the errors of free runs, with numerical derivatives along some numbers of the device."""
    variance = min(whole.white, device.reading)
    motion, along, unknown = free_motion(segments, device, variance, whole.largest)
    sizes, states = _unknown_starts(segments, device, whole.largest)
    starts, q, p = (unknown @ states.T)[:, None], len(sizes), len(names)
    columns = np.empty((len(motion), p + 1))
    columns[:, p] = segments.position[segments.places] - motion
    for place, name in enumerate(names):
        value = device.numbers[name]
        _, high = LIMITS.get(name, (-np.inf, np.inf))
        size = (
            device.numbers["gain"] if name in (*LINEAR, *GRAVITY, "load_coulomb") else 1.0 if name == "delay" else 0.01
        )
        step = NUDGE * max(abs(value), 0.1 * size)
        step = -step if value + step > high else step
        nudged = replace(device, numbers=device.numbers | {name: value + step})
        columns[:, place] = (_runs(segments, nudged, starts)[:, 0] - motion) / step
    ends, blocks_, known, lost = np.cumsum(segments.rows), [], np.zeros(len(segments)), 0.0
    prior = np.diag(np.sqrt(variance) / sizes)
    for s, behind in enumerate(ends.tolist()):
        inside = slice(behind - int(segments.rows[s]), behind)
        errors, free = whitened_errors(np.hstack([columns[inside], along[inside]]), segments.free, p + 1)
        free = np.vstack([free, prior])
        block = np.vstack([errors, np.column_stack([np.zeros((q, p)), -prior @ unknown[s]])])
        Q, R = np.linalg.qr(free)
        blocks_.append(block - Q @ (Q.T @ block))
        information = (np.diagonal(R) * sizes) ** 2
        share = np.maximum(1 - variance / information, 0.0)
        known[s] = share.sum()
        lost += 0.5 * float((np.log(information) - (1 - share) * np.log(variance)).sum())
    behind = np.cumsum(segments.rows + q) - q
    return Columns(np.concatenate(blocks_), behind - segments.rows, behind, q, known, lost, np.ones(1))


def blocks(segments: Segments, columns: int) -> list[Segments]:
    """Split the segments into blocks whose columns fit into memory together."""
    most = max(1, TOGETHER // columns)
    if segments.rows.sum() <= most:
        return [segments]
    part = (np.cumsum(segments.rows) - segments.rows) // most
    cuts = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(segments)]
    return [segments.select(slice(a, b)) for a, b in pairwise(cuts)] if len(cuts) > 2 else [segments]


def portions_of(segments: Segments) -> int:
    """Return the number of portions of each segment, or 0 for at least `FEWEST` trials, which then are the units."""
    return 0 if segments.trials >= FEWEST else max(1, -(-PORTIONS // max(len(segments), 1)))


def groups_of(segments: Segments) -> Integers:
    """Return the group (U,) of each unit: its log, or the half of its log for fewer than `FEWEST` logs."""
    portions = portions_of(segments)
    if not portions:
        return np.arange(segments.trials)
    share = (np.arange(portions) + 0.5) / portions
    middle = (segments.first[:, None] + segments.rows[:, None] * share).ravel()
    trial = np.repeat(segments.trial, portions)
    first, behind = segments.offsets[trial], segments.offsets[trial + 1]
    groups = 2 * trial + (middle > 0.5 * (first + behind))
    return np.asarray(np.unique(groups, return_inverse=True)[1], dtype=np.int64)


@np.errstate(all="ignore")  # numbers far from the solution may cause overflow; a search then rejects them
def moments_of(
    segments: Segments, device: Device, names: tuple[str, ...] | None = None, *, phased: bool = False
) -> Moments:
    """Return the moments of all units (trials or portions) at a device, without information after an overflow.

    ``names`` are the numbers along which the moments are computed, by default all numbers. ``phased`` states whether
    the products of each phase of the motion are computed.
    """
    names = device.names if names is None else names
    p, portions = len(names), portions_of(segments)
    phase, row = _phase_of_rows(segments) if phased else np.zeros(0, dtype=np.int64), 0
    units = len(segments) * portions if portions else segments.trials
    factors, rows, lost, place = np.zeros((units, p + 1, p + 1)), np.zeros(units), 0.0, 0
    of_phases = np.zeros((units if phased else 0, PHASES, p, p + 1))
    for part in blocks(segments, p + 1):
        columns = columns_of(part, device, names, whole=segments)
        lost += columns.lost
        first, behind, unit, known = columns.first, columns.behind + columns.starts, part.trial, columns.known
        if portions:
            cuts = part.rows[:, None] * np.arange(portions + 1) // portions
            first, behind = (
                (columns.first[:, None] + cuts)[:, :-1].ravel(),
                (columns.first[:, None] + cuts)[:, 1:].ravel(),
            )
            unit, known = place + np.arange(len(first)), np.repeat(known / portions, portions)
            rows[unit] = np.diff(cuts, axis=1).ravel() - known
        else:
            np.add.at(rows, unit, part.rows - known)
        if phased:
            inside = columns.first if portions == 0 else first, columns.behind if portions == 0 else behind
            here, row = phase[row : row + int(part.rows.sum())], row + int(part.rows.sum())
            kernels.add_products(of_phases, columns.values, *inside, unit, here)
        kernels.triangles(factors, columns.values, first, behind, unit)
        place += len(first)
    before = np.array([BEFORE.get(name, (0.0, 0.0)) for name in names]).T
    before = np.stack([before[1], before[1] * (before[0] - [device.numbers[name] for name in names])])
    if not (np.abs(factors) < LARGEST_FACTOR).all() or not np.isfinite(lost):
        factors, rows, lost = np.zeros_like(factors), np.ones(units), np.inf
    return Moments(factors, rows, segments.usual_least, lost, before, of_phases)


def fitted(segments: Segments, device: Device, places: Integers, *, phased: bool = False) -> Fit:
    """Return the fit at a device. The numbers at ``places`` may vary between trials. ``phased`` as in `moments_of`."""
    moments = moments_of(segments, device, phased=phased)
    solved = solve(moments, places)
    repeats = float(segments.rows.sum() / max(segments.distinct.sum(), 1.0)) if device.noise == WHITE else 1.0
    device = replace(device, effects=solved.effects if len(places) else None, reading=solved.noise)
    p = len(device.names)
    return Fit(
        device,
        solved,
        moments,
        places,
        segments.trials < FEWEST,
        repeats,
        np.zeros(p),
        np.zeros((PHASES, p)),
        np.zeros((1, p)),
    )


def phases_of(fit: Fit) -> Floats:
    """Return the step of the numbers due to the errors of each phase of the motion, shape (8, p), with a sum of zero.

    The step of a phase is the inverse information times the sum of its scores. The scatter of these steps shows the
    uncertainty of the numbers. It is only noise if the model is complete. The fit must contain the products of each
    phase.

    Source: White 1982, "Maximum likelihood estimation of misspecified models" (sandwich estimate, with few clusters).
    """
    solved, products = fit.solved, fit.moments.of_phases
    information = products[..., :-1] * (solved.weight / solved.noise)[:, None, None, None]
    score = products[..., -1] * (solved.weight / solved.noise)[:, None, None]
    score = (score - (information @ solved.effects[:, None, :, None])[..., 0]).sum(axis=0)
    total = information.sum(axis=(0, 1)) + np.diag(fit.moments.before[0])
    return np.asarray(score @ inverse(total))


def _phase_of_rows(segments: Segments) -> Integers:
    """Return the phase of the motion of each row of the segments.

    There are eight phases: positions below and above the median, both directions, slow and fast motion.
    """
    rate, position = _rate(segments), segments.position[segments.places]
    middle, usual = float(np.median(position)), float(np.median(np.abs(rate)))
    return np.asarray(4 * (position > middle) + 2 * (rate > 0) + (np.abs(rate) > usual), dtype=np.int64)


def _rate(segments: Segments) -> Floats:
    """Return the change of the position over the four intervals around each row of the segments."""
    first, last = (np.repeat(ends, segments.rows) for ends in (segments.first, segments.behind - 1))
    ahead, before = np.minimum(segments.places + 2, last), np.maximum(segments.places - 2, first)
    return np.asarray(segments.position[ahead] - segments.position[before])

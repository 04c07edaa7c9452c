"""The likeliest device: start by integrated balances, then Newton's steps on the likelihood of all trials."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.model.motion import LARGEST_LOAD, SHORTEST_LAG, PlantShape
from pipeline.measured.model.recordings import Stretches
from pipeline.measured.model.scatter import FEWEST, Moments, Solved, inverse, solve
from pipeline.measured.model.whitening import WHITE, Column, Filter, Noise, Passage, passed, slopes
from pipeline.records.batch import Floats, Integers

LINEAR = ("gain", "coulomb", "force")
"""Acceleration per command, by friction and by a constant force, in which the motion is linear; `LogUnits`, time in
samples."""

SCATTERED = ("delay", "coulomb", "force")
"""Numbers that may differ from trial to trial."""

FIXED_STEPS = 2
"""Steps at first without such scatter, before each search for noise."""

LIMITS = {
    "limit": (1e-3, 1.0),
    "gain": (1e-12, np.inf),
    "delta": (-0.01, 2.0),
    "gamma": (-1e-4, 2.0),
    "delay": (0.0, 300.0),
    "lag": (SHORTEST_LAG, 300.0),
    "mode_frequency": (0.002, 3.0),
    "mode_damping_ratio": (1e-4, 0.5),
    "load_mass_fraction": (1e-4, LARGEST_LOAD),
    "load_damping": (-0.01, 2.0),
    "spring_damping_fraction": (1e-4, 0.999),
}
BEFORE = {"spring_damping_fraction": (0.5, 12.0)}
"""Mean of a number without logs, and information of it: a part that is anywhere between 0 and 1."""

LARGEST_STEP = {
    "limit": 0.05,
    "delta": 0.2,
    "gamma": 0.2,
    "delay": 1.5,
    "lag": 1.5,
    "mode_frequency": 0.1,
    "load_mass_fraction": 0.1,
    "load_damping": 0.2,
    "spring_damping_fraction": 0.3,
}
"""Change of a number in one step within which the response is near a straight line."""

BY_HALF = ("gain", "mode_damping_ratio")
"""Numbers that change by half of themselves at most: a mode without damping is known so well that no step leaves it."""

STEPS = 18
"""Newton's steps at most; seven are usual, a mode may take all."""

LAST_STEPS = 3
"""Steps on all logs from what some of them have shown: the last one is smaller than rounding."""

CUTS = (1.0, 0.3, 0.1)
"""Parts of a step that are tried."""

DONE = 1e-3
"""Square of a step in standard errors at which the search ends: 0.03 of the interval's half width."""

PORTIONS = 16
"""Portions of few logs, whose own numbers show what is not independent within a log; Student's t is then 2.13."""

PHASES = 8
"""Phases of the motion, between which what the model leaves out differs: damping by direction, a hand by the way, play
by the speed."""

ROBUST_ROUNDS = 4
"""Rounds of least squares and weights for a start."""

TOGETHER = 3_000_000
"""Numbers in the columns of stretches that are computed together, 24 MB."""

MEMORIES = (1e-12, 3e5)
"""Least and largest variance of the disturbing force in that of a reading, per sample: from a random walk that forgets
in a thousand samples to one that forgets in one."""

JITTERS = (0.02, 1.5)
"""Least and largest jitter of the delay that is looked for [samples]: with nine ages of the command in force; of eight
whole delays that are drawn alike it is 1.5."""

READINGS = (0.1, 10.0)
"""Least and largest variance of a reading that is looked for beside a jitter, in that by third differences."""

ROUGH = 0.7
"""Change of the logarithm of a variance that is near enough for a start: intervals grow with its root."""

NEAR = 0.05
"""Change of the logarithm of a variance, or of a jitter, within which the likelihood is a parabola."""

ASIDE = 0.2
"""Change of the logarithm of a variance, or of a jitter, to another one that is tried first."""

MOST_COSTS = 40
"""Most likelihoods in the search for a jitter beside the noise of readings, and a random force."""

ROUNDED_ROW = 0.01
"""Gain of log-likelihood, a row, up to which a random force is rounding: no jitter is looked for, nor another part."""

OTHER_AGES = 0.08
"""Error of a jitter by the shape of its distribution, relative, for each sample from half of one on: of delays drawn
from two to four whole ones it is off by up to 0.15."""

LEAST_JITTER = 0.05
"""Jitter [samples] from which on one is believed: what rounding leaves may look like less."""

NOISE_ROUNDS = 4
"""Most searches for the noise behind the steps: with a mode the random force fell by a third to a tenth in each."""

NOISE_STRETCHES, NOISE_ROWS = 24, 150
"""Stretches by which the noise is found, cut into parts of so many rows: a variance from 8,000 rows is known to 2 %."""

ALIKE = 0.7
"""Share of the fall of the logarithm of what is left, by the best delay, from which on a shorter one may be it, too."""

MIRRORED = 2.0
"""Fall of the logarithm of what is left from which on a device moves against its command: 8 and more where a sign is
wrong, below 0 where it is right."""

IMPOSSIBLE = 1e30
"""Cost, as a logarithm of a likelihood, of a noise under which a device cannot be computed: any other is less."""

LARGEST_PRODUCT = 1e60
"""Largest sum of squares of a column, in units near 1, from which sums over others can be computed in doubles."""

SMALLEST_SHARE = 1e-6
"""Share of a column, as the square root of that of `numpy.linalg.lstsq`, below which it is rounding of the others."""

VISIBLE = 4.0
"""Squares of a segment's deviations from a straight line, in those of its noise, from which on its motion is visible:
a plateau at constant speed has no information on the mass, however long it is."""

RESTING = (
    "the position changes in no part of a log that is long enough: static friction or a stop may fix the device. "
    "Record larger commands"
)

WORTH = 5.0
"""Gain of log-likelihood from which on a part, of the device or of its noise, is one: odds of 150 to 1."""


@dataclass(frozen=True, eq=False)
class Device:
    """Numbers of a device by name, and the noise beside it; ``effects`` (T, p) are what trials differ by, ``reading``
    the variance of a reading where a fit has one."""

    numbers: dict[str, float]
    noise: Noise = WHITE
    effects: Floats | None = field(default=None, repr=False)
    reading: float = np.inf

    @property
    def shape(self) -> PlantShape:
        """Its numbers that shape a motion."""
        return PlantShape.of(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its numbers, in the order of columns."""
        return tuple(self.numbers)

    def stepped(self, step: Floats) -> Device:
        """Return the device after a step, each number within its limits."""
        moved = dict(self.numbers)
        for (name, value), change in zip(self.numbers.items(), step.tolist(), strict=True):
            most = LARGEST_STEP.get(name, 0.5 * abs(value) if name in BY_HALF else np.inf)
            low, high = LIMITS.get(name, (-np.inf, np.inf))
            moved[name] = float(np.clip(value + np.clip(change, -most, most), low, high))
        return replace(self, numbers=moved)

    def driven(self, held: Stretches) -> Floats:
        """Return the command as far as it has the force for it, shape (lead + N, S)."""
        limit = self.numbers.get("limit", np.inf)
        return np.asarray(np.clip(held.driven, -limit, limit))

    def passage(self, held: Stretches, name: str = "") -> Passage:
        """Return how it moves in stretches, or changes along one of its numbers."""
        return Passage(held, self.shape.along(name) if name else self.shape, self.noise.jitter)

    def own(self, name: str, trials: np.ndarray) -> Floats:
        """Return a number of the trial of each stretch, shape (S,); 0 where the device has none."""
        common = np.full(len(trials), self.numbers.get(name, 0.0))
        if self.effects is None or name not in self.numbers:
            return common
        return np.asarray(common + self.effects[trials, self.names.index(name)])


@dataclass(frozen=True, eq=False)
class Fit:
    """A device with what its likelihood says.

    ``solved`` at the device, with its ``moments`` and the ``places`` of numbers that scatter; units are portions of
    ``few`` logs, else trials. ``alike`` is the mean number of equal readings in a row, which count as one, ``open``
    (p,) how far the numbers move with a jitter that is larger by its error, ``phases`` (8, p) what each phase of the
    motion adds to them: nothing but noise where the model holds all. None of a fit that has not `ended`. ``optima``
    (k, p) are the steps to other optima of the likelihood that the logs do not exclude.
    """

    device: Device
    solved: Solved
    moments: Moments
    places: Integers
    few: bool
    alike: float
    open: Floats
    phases: Floats
    optima: Floats

    @property
    def likelihood(self) -> float:
        """Restricted logarithm of the likelihood."""
        return self.solved.likelihood


def chunks(held: Stretches, columns: int) -> list[np.ndarray]:
    """Return the stretches that are computed together."""
    size = max(1, int(TOGETHER / (held.position.shape[0] * columns)))
    order = np.argsort(held.rows, kind="stable") if len(held) > size else np.arange(len(held))
    return [order[i : i + size] for i in range(0, len(held), size)]


def portions_of(held: Stretches, trials: int) -> int:
    """Return into how many portions each stretch is cut; 0 with `FEWEST` trials, each of which is one unit."""
    return 0 if trials >= FEWEST else max(1, -(-PORTIONS // max(len(held), 1)))


@np.errstate(all="ignore")  # numbers far off overflow: they are impossible, and a search leaves them
def moments_of(held: Stretches, device: Device, trials: int) -> Moments:
    """Return the moments of all units (trials, or portions) at a device."""
    p, portions = len(device.names), portions_of(held, trials)
    units = len(held) * portions if portions else trials
    total, rows, spreads = np.zeros((units, p + 1, p + 1)), np.zeros(units), 0.0
    for some in chunks(held, p + 8):
        part = held.chosen(some)
        left, spread, known = _columns(part, device, held)
        spreads += spread
        if not portions:
            np.add.at(total, part.trial, left.transpose(0, 2, 1) @ left)
            np.add.at(rows, part.trial, part.rows - known)
            continue
        for portion in range(portions):
            first, behind = (part.rows * each // portions for each in (portion, portion + 1))
            at = np.arange(left.shape[1])
            inside = (at >= first[:, None]) & (at < behind[:, None])
            cut = left * inside[..., None]
            total[some * portions + portion] = cut.transpose(0, 2, 1) @ cut
            rows[some * portions + portion] = behind - first - known / portions
    before = np.array([BEFORE.get(name, (0.0, 0.0)) for name in device.names]).T
    before = np.stack([before[1], before[1] * (before[0] - list(device.numbers.values()))])
    return Moments(total, rows, float(np.median(held.least)), spreads, before)


@dataclass(frozen=True, eq=False)
class Starts:
    """What whitened errors tell of the c unknowns of each start.

    Of these it is known before that they are no larger than the readings' range, and what a lag or a mode holds no
    larger than what the largest command makes: c rows below the N of the errors. ``basis`` (S, N + c, c) and
    ``triangle`` (S, c, c) are those of all of them, ``known`` (S,) is how many unknowns the errors tell, ``lost`` by
    how much that makes them less likely.
    """

    basis: Floats
    triangle: Floats
    known: Floats
    lost: float

    @classmethod
    def of(cls, held: Stretches, device: Device, errors: list[Floats]) -> Starts:
        """Return the estimates by whitened columns (N, S) of the unknowns, in the order of the states.

        ``held`` are all segments: they give the variance of a reading and the range of the positions.
        """
        # third differences of logs without noise are those of the motion
        gain, shape, variance = abs(device.numbers["gain"]), device.shape, min(held.white, device.reading)
        mode = [gain / shape.mode_frequency**2, gain / shape.mode_frequency] if shape.load_mass else []
        farthest = 1.0 + float(np.abs(held.position).max())
        sizes = np.array([farthest, 1.0, *mode, *([gain] if shape.lag else [])])[: len(errors)]
        columns = -np.stack(errors, axis=-1).transpose(1, 0, 2)
        before = np.broadcast_to(np.diag(np.sqrt(variance) / sizes), (len(columns), len(sizes), len(sizes)))
        basis, triangle = np.linalg.qr(np.concatenate([columns, before], axis=1))
        known = (np.diagonal(triangle, axis1=1, axis2=2) * sizes) ** 2
        share = np.maximum(1 - variance / known, 0.0)
        lost = 0.5 * float((np.log(known) - (1 - share) * np.log(variance)).sum())
        return cls(basis, triangle, share.sum(axis=1), lost)

    def within(self, columns: Floats) -> Floats:
        """Return the products of whitened columns (S, N, k) with the basis, (S, c, k)."""
        return np.asarray(self.basis[:, : columns.shape[1]].transpose(0, 2, 1) @ columns)

    def without(self, columns: Floats) -> Floats:
        """Return what the likeliest starts leave of whitened columns (S, N, k), and of what is known before."""
        left = -self.basis @ self.within(columns)
        left[:, : columns.shape[1]] += columns
        return np.asarray(left)


def errors_of(
    held: Stretches,
    device: Device,
    passage: Passage,
    found: Filter,
    columns: list[Column],
    whole: Stretches | None = None,
) -> tuple[list[Floats], Starts]:
    """Return whitened columns (N, S) each, and the estimates of the unknown starts.

    ``whole`` are all segments where ``held`` are some of them: what is known of a start before is the same for all.
    """
    errors = passed(passage, found, [*columns, *passage.starts()])
    return errors[: len(columns)], Starts.of(whole or held, device, errors[len(columns) :])


def force_of(held: Stretches, device: Device) -> Column:
    """Return all that is logged of stretches and acts on a device, as one column."""
    gain, coulomb, force = (device.own(name, held.trial) for name in LINEAR)
    return Column(held.position, device.driven(held) * gain, force - coulomb * held.direction)


def _log_spread(held: Stretches, found: Filter) -> float:
    """Return the sum of the logarithms of the errors' spreads."""
    if found.spread.size == 1:
        return float(held.rows.sum() * np.log(found.spread[0, 0]))
    return float(np.log(np.broadcast_to(found.spread, held.position.shape)[held.valid]).sum())


def _columns(held: Stretches, device: Device, whole: Stretches) -> tuple[Floats, float, Floats]:
    """Return columns and errors without the starts (S, N + c, p + 1), the logarithms that make them less likely, and
    how many unknowns of each start the readings determine; ``whole`` are all segments, of which ``held`` are some."""
    passage, nothing = device.passage(held), np.ones(len(held))
    found = Filter.of(passage, device.noise)
    linear = {
        "gain": Column(command=device.driven(held)),
        "coulomb": Column(direct=-held.direction),
        "force": Column(direct=nothing),
    }
    if "limit" in device.numbers:
        clipped = np.sign(held.driven) * (np.abs(held.driven) > device.numbers["limit"])
        linear["limit"] = Column(command=clipped * device.own("gain", held.trial))
    asked = [name for name in device.names if name in linear]
    force = force_of(held, device)
    entering = [force, *(linear[name] for name in asked)]
    (left, *base), starts = errors_of(held, device, passage, found, entering, whole)
    columns = {name: -each for name, each in zip(asked, base, strict=True)}
    common = left
    if device.effects is not None:
        for name, each in columns.items():
            common = common + (device.own(name, held.trial) - device.numbers[name]) * each
    fitted = np.linalg.solve(starts.triangle, starts.within(left.T[..., None]))[..., 0]
    start = np.zeros((len(held), passage.states))
    for place, column in enumerate(passage.starts()):
        assert column.start is not None
        start += column.start * fitted[:, place, None]
    shaped = [each.name for each in fields(PlantShape) if each.name in device.numbers]
    along = [device.passage(held, name) for name in shaped]
    # of the prediction with its start
    columns |= dict(zip(shaped, slopes(passage, found, replace(force, start=start), along), strict=True))
    stacked = np.stack([*(columns[name] for name in device.names), common], axis=-1).transpose(1, 0, 2)
    return starts.without(stacked), _log_spread(held, found) + starts.lost, starts.known


def refined(
    held: Stretches,
    device: Device,
    trials: int,
    steps: int = STEPS,
    *,
    far: bool = True,
    noisy: bool = True,
    jitters: bool = True,
) -> Fit:
    """Return the likeliest device near one, with the noise that makes its errors independent.

    Parameters
    ----------
    held : Stretches
    device : Device
    trials : int
        Number of trials, of which some may have no stretch.
    steps : int
        Most steps.
    far : bool
        Whether it starts far from the solution, where scatter between trials would explain everything.
    noisy : bool
        Whether the noise is looked for, too; else it stays as it is.
    jitters : bool
        Whether a jitter of the delay may be part of it.
    """
    scattered = SCATTERED if trials >= FEWEST else ()
    places = np.array([i for i, name in enumerate(device.names) if name in scattered], dtype=np.int64)
    if far:
        for late in (False, jitters):
            device = _climbed(_fit(held, device, trials, places[:0]), held, trials, FIXED_STEPS).device
            device = replace(device, noise=noise_and_jitter(held, device, jitters=late)) if noisy else device
    elif noisy:
        device = replace(device, noise=noise_and_jitter(held, device, jitters=jitters))
    start = _fit(held, device, trials, places)
    found = _climbed(start, held, trials, steps)
    for _ in range(NOISE_ROUNDS if noisy else 0):
        if found.likelihood - start.likelihood < WORTH:
            break
        # what was noise where the search began may be motion where it ends
        device = replace(found.device, noise=noise_and_jitter(held, found.device, jitters=jitters))
        start = _fit(held, device, trials, places)
        again = _climbed(start, held, trials, steps)
        if again.likelihood <= found.likelihood:
            break
        found = again
    if noisy and found.device.noise != WHITE:
        plain = _climbed(_fit(held, replace(found.device, noise=WHITE), trials, places), held, trials, steps)
        found = plain if plain.likelihood > found.likelihood else found
    return found


def climbed(held: Stretches, device: Device, trials: int, steps: int = STEPS) -> Device:
    """Return the local optimum of the likelihood near a device, with its noise fixed and no scatter between trials."""
    return _climbed(_fit(held, device, trials, np.empty(0, dtype=np.int64)), held, trials, steps).device


def ended(held: Stretches, device: Device, trials: int) -> Fit:
    """Return the likeliest fit from a device on that is near it, with what its jitter leaves open."""
    fit = refined(held, device, trials, LAST_STEPS, far=False, noisy=False)
    fit = replace(fit, phases=phases_of(held, fit, trials))
    noise = fit.device.noise
    if not noise.jitter:
        return fit
    other = replace(noise, jitter=noise.jitter + noise.jitter_error)
    return replace(fit, open=_fit(held, replace(fit.device, noise=other), trials, fit.places).solved.step)


def _fit(held: Stretches, device: Device, trials: int, places: Integers) -> Fit:
    """Return what the likelihood says at a device, with scatter between trials of the numbers at some places."""
    moments = moments_of(held, device, trials)
    if not (np.abs(moments.products) < LARGEST_PRODUCT).all() or not np.isfinite(moments.log_spread):
        nothing, rows = np.zeros_like(moments.products), np.ones(len(moments.products))
        moments = replace(moments, products=nothing, rows=rows, log_spread=np.inf)
    solved = solve(moments, places)
    alike = float(held.rows.sum() / max(held.distinct.sum(), 1.0)) if device.noise == WHITE else 1.0
    device = replace(device, effects=solved.effects if len(places) else None, reading=solved.noise)
    p = len(device.names)
    return Fit(
        device, solved, moments, places, trials < FEWEST, alike, np.zeros(p), np.zeros((PHASES, p)), np.zeros((1, p))
    )


def phases_of(held: Stretches, fit: Fit, trials: int) -> Floats:
    """Return the step of the numbers that the errors in each phase of the motion ask for, shape (8, p); together none.

    Phases are both directions on both sides of the middle of all readings, each slow and fast. Each adds the product of
    the inverse information and its own sum of scores, whose scatter between phases is that of the numbers: what a model
    that holds all leaves in them is noise.

    Source: the sandwich estimate with few clusters; White 1982, "Maximum likelihood estimation of misspecified models".
    """
    solved, p, portions = fit.solved, len(fit.device.names), portions_of(held, trials)
    rate = _rate(held.position)
    middle, usual = np.median(held.position[held.valid]), np.median(np.abs(rate[held.valid]))
    total, score = np.diag(fit.moments.before[0]), np.zeros((PHASES, p))
    for some in chunks(held, p + 8):
        part = held.chosen(some)
        left = _columns(part, fit.device, held)[0]
        unit = part.trial[:, None]
        if portions:
            ends = (np.arange(left.shape[1]) + 1) * portions - 1
            unit = some[:, None] * portions + np.minimum(ends // part.rows[:, None], portions - 1)
        columns = left[..., :p]
        error = left[..., p] - (columns * solved.effects[unit]).sum(axis=-1)
        weighted = columns * (solved.weight[unit] / solved.noise)[..., None]
        total += np.einsum("snp,snq->pq", weighted, columns)
        rows = len(part.position)
        weighted, error, speed = weighted[:, :rows], error[:, :rows], rate[:rows, some]
        phase = 4 * (part.position > middle) + 2 * (speed > 0) + (np.abs(speed) > usual)
        for which in range(PHASES):
            score[which] += np.einsum("snp,sn->p", weighted, error * (phase == which).T)
    return np.asarray(score @ inverse(total))


def _rate(position: Floats) -> Floats:
    """Return by how much a position changes in the four rows around each."""
    ahead = np.pad(position, ((2, 2), (0, 0)), mode="edge")
    return np.asarray(ahead[4:] - ahead[:-4])


def _climbed(fit: Fit, held: Stretches, trials: int, steps: int) -> Fit:
    """Return the likeliest fit that Newton's steps lead to, each of them cut until the likelihood does not fall."""
    for _ in range(steps):
        for cut in CUTS:
            device = fit.device.stepped(cut * fit.solved.step)
            change = np.array(list(device.numbers.values())) - np.array(list(fit.device.numbers.values()))
            if float(change @ fit.solved.total @ change) < DONE:
                return fit
            tried = _fit(held, device, trials, fit.places)
            gain = tried.solved.here - fit.solved.here
            if gain > 0:
                break
        else:
            return fit
        fit = tried
        if gain < 0.5 * DONE:
            break
    return fit


def noise_and_jitter(held: Stretches, device: Device, *, jitters: bool) -> Noise:
    """Return the noise under which the errors of a device are likeliest, without what is worth nothing.

    A random force is looked for, and a jitter of the delay if asked for.
    """
    some = held.chosen(spread(held, NOISE_STRETCHES)).shorter(NOISE_ROWS)
    constant, command = Column(direct=np.ones(len(some))), device.numbers["gain"] ** 2
    white = some.white

    @np.errstate(all="ignore")  # as in `moments_of`
    def cost(force: float, jitter: float = 0.0, reading: float = 1.0) -> float:
        noise = Noise(force, command / (reading * white) if jitter else 0.0, jitter)
        passage = Passage(some, device.shape, jitter)
        found, whole = Filter.of(passage, noise), force_of(some, device)
        # the constant force of each stretch is free, so that it is not taken for a random one
        (left, push), starts = errors_of(some, device, passage, found, [whole, constant])
        both = starts.without(np.stack([left, push], axis=-1).transpose(1, 0, 2))
        products = both.transpose(0, 2, 1) @ both
        pushed = np.maximum(products[:, 1, 1], 1e-300)
        squares = np.maximum(products[:, 0, 0] - products[:, 0, 1] ** 2 / pushed, 1e-300)
        rows = np.maximum(some.rows - starts.known - 1, 1)
        # the strength of a jitter is that of its forces, beside the noise of a reading
        variance = reading * white if jitter else np.maximum(squares / rows, some.least)
        lost = 0.5 * (rows * np.log(variance) + squares / variance + np.log(pushed)).sum()
        whole_cost = float(lost) + _log_spread(some, found) + starts.lost
        return whole_cost if np.isfinite(whole_cost) else IMPOSSIBLE

    if cost(0.0) >= IMPOSSIBLE:
        return WHITE
    none, (force, by_force) = cost(0.0), _likeliest(cost, MEMORIES)
    # what rounding leaves may look like a little of either
    still, least = (Noise(force), by_force) if by_force < none - WORTH else (WHITE, none)
    if not jitters or none - by_force <= WORTH + ROUNDED_ROW * float(some.rows.sum()):
        return still
    near = device.noise.jitter or _likeliest(lambda jitter: cost(0.0, jitter), JITTERS)[0]
    numbers, lost = _minimum(lambda *numbers: cost(0.0, *numbers), (near, 1.0), (JITTERS, READINGS))
    beside, more = _likeliest(lambda force: cost(force, *numbers), MEMORIES)
    strength = 0.0
    if more < lost - WORTH:
        (strength, *numbers), lost = _minimum(cost, (beside, *numbers), (MEMORIES, JITTERS, READINGS))
    jitter, reading = numbers
    if lost >= least - WORTH or jitter < LEAST_JITTER:
        return still
    # half a sample beside a delay of half a sample is at a bend of the likelihood: its flatter side tells the error
    falls = min(cost(strength, jitter * float(np.exp(sign * NEAR)), reading) for sign in (-1, 1)) - lost
    error = float(np.hypot(NEAR / np.sqrt(2 * max(falls, 1e-3)), OTHER_AGES * max(jitter - 0.5, 0.0)))
    return Noise(strength, command / (reading * white), jitter, jitter * error)


def _likeliest(cost: Callable[[float], float], limits: tuple[float, float]) -> tuple[float, float]:
    """Return roughly the number within limits that costs least, and that cost."""
    from scipy.optimize import minimize_scalar

    bounds, options = tuple(np.log(limits).tolist()), {"xatol": ROUGH, "maxiter": 9}
    found = minimize_scalar(lambda log: cost(float(np.exp(log))), bounds=bounds, method="bounded", options=options)
    return float(np.exp(found.x)), float(found.fun)


def _minimum(
    cost: Callable[..., float], near: tuple[float, ...], limits: tuple[tuple[float, float], ...]
) -> tuple[list[float], float]:
    """Return the positive numbers within limits that cost least, from some near them on, and that cost."""
    from scipy.optimize import minimize

    bounds = np.log(limits)
    start = np.clip(np.log(near), bounds[:, 0], bounds[:, 1] - ASIDE)
    simplex = start + ASIDE * np.vstack([np.zeros(len(start)), np.eye(len(start))])
    options = {"maxfev": MOST_COSTS, "xatol": 0.4 * NEAR, "fatol": 0.5, "initial_simplex": simplex}
    found = minimize(
        lambda logs: cost(*np.exp(logs).tolist()), start, method="Nelder-Mead", bounds=bounds, options=options
    )
    return np.exp(found.x).tolist(), float(found.fun)


def spread(held: Stretches, most: int) -> np.ndarray:
    """Return the places of at most so many stretches, evenly among all."""
    return np.unique(np.linspace(0, len(held) - 1, min(most, len(held))).round().astype(int))


def first_guess(held: Stretches, names: tuple[str, ...], most_delay: float) -> Device:
    """Return a device from which a search starts: the best integer delay for the twice integrated balance of forces.

    With y the position, y = start + gain u'' - delta y' - gamma y'' - coulomb s'' + force t^2/2, where ' is an integral
    from the stretch's start: linear, and errors of readings enter almost undisturbed.

    Raises
    ------
    ParameterError
        If it moves against its command.
    """
    some = held.chosen(spread(held, 60))
    rows = len(some.position)
    t = np.where(some.valid, some.time[some.lead : some.lead + rows] - some.time[some.lead], 0.0)
    dt = np.diff(some.time[some.lead : some.lead + rows + 1], axis=0)
    y = some.position
    behind = np.vstack([y[1:], y[-1:]])
    middle = np.where(np.vstack([some.valid[1:], np.zeros((1, len(some)), bool)]), 0.5 * (y + behind), y)
    # from rest the way counts from there; else it is one of the unknown starts
    way = middle - y[0] * some.rests
    once = np.vstack([np.zeros((1, len(some))), np.cumsum(way * dt, axis=0)[:-1]])
    tried: list[tuple[float, dict[str, float]]] = []
    signs: list[Floats] = []
    noise = some.rows * some.white
    for delay in np.arange(0.0, most_delay + 0.5) if "delay" in names else (0.0,):
        passage = Passage(some, PlantShape(delay=float(delay)))
        forces = [
            Column(command=some.driven),
            *(Column(direct=each) for each in (middle, some.direction, np.ones(len(some)))),
        ]
        twice = [-each for each in passed(passage, Filter.of(passage, Noise()), forces)]
        known = {"gain": twice[0], "delta": -once, "gamma": -twice[1], "coulomb": -twice[2], "force": twice[3]}
        known = {name: known[name] for name in names if name in known}
        columns = np.stack([*known.values(), y], axis=-1) * some.valid[..., None]
        starts = [np.ones_like(t), *([] if some.rests.all() else [t * ~some.rests])]
        q, _ = np.linalg.qr(np.stack([each * some.valid for each in starts], axis=-1).transpose(1, 0, 2))
        columns = columns.transpose(1, 0, 2)
        columns = columns - q @ (q.transpose(0, 2, 1) @ columns)
        products = columns.transpose(0, 2, 1) @ columns
        moved = products[:, -1, -1]
        seen = moved > (VISIBLE * noise if (moved > VISIBLE * noise).any() else 0.0)
        if not seen.any():
            raise ParameterError(RESTING)
        products, floor = products[seen], noise[seen]
        found, left, weight = _robust(products)
        if found[list(known).index("gain")] < 0:
            # late by half a period, or over rows far apart, a motion is that of a force the other way round as well
            fits = [_bounded(products, weight, tuple(known), sign) for sign in (1.0, -1.0, 0.0)]
            signs.append(np.array([_left(products, each, floor) for each in fits]))
            found, left = fits[0], _left(products, fits[0])
            if found[list(known).index("gain")] == 0:
                left = np.inf
        else:
            signs.append(np.array([_left(products, found, floor), np.inf, np.inf]))
        tried.append((left, dict(zip(known, found.tolist(), strict=True)) | {"delay": delay}))
    lefts = np.array([left for left, _ in tried])
    along, against, unmoved = np.min(signs, axis=0).tolist()
    if against < min(along, unmoved, 0.0) - MIRRORED:
        raise ParameterError(
            "the device moves against its command, so that one of the two has the wrong sign. Set the other `sign` of "
            "columns.command in the profile"
        )
    first = shortest(lefts)
    best = tried[first][1] if np.isfinite(lefts[first]) else {}
    start_at = dict.fromkeys(names, 0.0) | {"gain": 1e-3, "lag": 0.5} | best
    return Device({name: float(np.clip(start_at[name], *LIMITS.get(name, (-np.inf, np.inf)))) for name in names})


def shortest(lefts: Floats) -> int:
    """Return the place of the shortest delay, from the shortest on, that is about as likely as the best of all.

    Where a mode makes most of the motion, all explain little, and a late one hardly more than the true one.

    >>> shortest(np.array([-0.054, -0.058, -0.057, -0.004, -0.053, -0.064])), shortest(np.array([-2.0, -6.0, -9.0]))
    (1, 2)
    """
    first = int(np.argmax(lefts <= ALIKE * lefts.min()))
    while first + 1 < len(lefts) and lefts[first + 1] < lefts[first]:
        first += 1
    return first


def _robust(products: Floats) -> tuple[Floats, float, Floats]:
    """Return least squares over segments, the logarithm of the share of the motion that is left, and the weights.

    A segment of which much more is left than of most has little weight. The share is a mean over segments by how far
    they move, up to what most of them do: one that grows without bound would decide alone.
    """
    way = _ways(products)
    weight = np.ones(len(products))
    for _ in range(ROBUST_ROUNDS):
        total = (products * weight[:, None, None]).sum(axis=0)
        # columns of unit size: the integrals of long segments differ by many orders
        scale = 1 / np.sqrt(np.maximum(np.diagonal(total)[:-1], 1e-300))
        scaled = total[:-1, :-1] * scale[:, None] * scale[None, :]
        found = scale * np.linalg.lstsq(scaled, scale * total[:-1, -1], rcond=1e-12)[0]
        whole = np.append(-found, 1.0)
        left = np.maximum(np.einsum("i,tij,j->t", whole, products, whole), 1e-300)
        order = np.argsort(left)
        reached = int(np.searchsorted(np.cumsum(way[order]), 0.5))
        middle = float(left[order[min(reached, len(left) - 1)]])
        weight = middle / (middle + left)
    return found, _left(products, found), weight


def _ways(products: Floats) -> Floats:
    """Return the weight of each segment in a mean: how far it moves, up to the median, with a sum of 1."""
    way = np.sqrt(products[:, -1, -1])
    way = np.minimum(way, np.median(way))
    return np.asarray(way / max(float(way.sum()), 1e-300))


def _left(products: Floats, found: Floats, floor: Floats | float = 1e-300) -> float:
    """Return the mean logarithm of the share of the motion of segments that a balance of forces leaves.

    ``floor`` is what the noise of readings leaves at least of each.
    """
    whole = np.append(-found, 1.0)
    left = np.maximum(np.einsum("i,tij,j->t", whole, products, whole), floor)
    moved = np.maximum(products[:, -1, -1], floor)
    return float(_ways(products) @ np.log(np.maximum(left, 1e-300) / np.maximum(moved, 1e-300)))


def _bounded(products: Floats, weight: Floats, names: tuple[str, ...], sign: float) -> Floats:
    """Return least squares over segments for a gain of one sign, or of 0, and no negative friction.

    Damping, stiffness and Coulomb friction are not negative: with all of them reversed a device would follow its
    command as well.
    """
    from scipy.optimize import nnls

    total = (products * weight[:, None, None]).sum(axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    values, vectors = np.linalg.eigh(total * scale[:, None] * scale[None, :])
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    ways = {"gain": [sign] if sign else [], "force": [1.0, -1.0]}
    signed = [(place, way) for place, name in enumerate(names) for way in ways.get(name, [1.0])]
    columns = np.stack([way * root[:, place] for place, way in signed], axis=1)
    # where two columns are the same, as of friction and a constant force in one direction, both are small
    columns = np.vstack([columns, SMALLEST_SHARE * np.eye(columns.shape[1])])
    amounts, _ = nnls(columns, np.append(root[:, -1], np.zeros(columns.shape[1])))
    found = np.zeros(len(names))
    for (place, way), amount in zip(signed, amounts.tolist(), strict=True):
        found[place] += way * amount * scale[place] / scale[-1]
    return found

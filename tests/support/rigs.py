"""Simulated rigs whose walls are tried one by one: ways to limits and best wall that the planner is held against."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from kinds import kinds

from pipeline.device_data.devices import load_device
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.measured.cost.costs import settling
from pipeline.measured.identification.parts import choose_parts
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.planning.campaign import Campaign, LearntDevice, PlanOptions, learn, wanted_dampings
from pipeline.planning.next_wall import TriedWalls, bracket
from pipeline.planning.planner import plan_of
from pipeline.records.trials import Floats, Trial, Trials
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.optimum import optimal_point

KINDS = {
    "ideal": "ideal",
    "frictional": "friction weak",
    "lagging": "actuator lag",
    "filtered": "butterworth filter",
    "vibrating": "mode at the motor",
}
"""Kinds of devices by their names here, as in `kinds`."""

WALLS, HIGHEST = 200, 20_000.0
"""Walls by which the true limit of a damping is told, up to a stiffness [N/m] that no such device bears."""


class Rig:
    """A variation of the Falcon, with its trials; the planner has its file without what the kind adds."""

    def __init__(self, kind: str, seed: int) -> None:
        self.case, self.seed = kinds(load_device("falcon"))[KINDS[kind]](seed), seed
        self.setup = setup_of(self.case.device, self.case.device.experiments[0])
        self.trials: list[Trial] = []
        self.verdicts: list[tuple[str, float]] = []
        self.learnt: LearntDevice | None = None

    def try_walls(self, stiffness: Floats, damping: Floats, repetition: int = 0) -> np.ndarray:
        """Return the verdicts of walls, which are not kept."""
        trials = simulate(self.setup, stiffness, damping, seed=self.seed, repetition=repetition)
        return np.array([judge(trial).verdict for trial in trials])

    def measure(self, stiffness: float, damping: float) -> None:
        """Try a wall, keep the trial, and learn from it."""
        wall = np.array([stiffness]), np.array([damping])
        again = sum(trial.stiffness == stiffness and trial.damping == damping for trial in self.trials)
        (trial,) = simulate(self.setup, *wall, seed=self.seed, repetition=again)
        judged = judge(trial)
        self.trials.append(trial)
        self.verdicts.append((judged.verdict, judged.growth_per_s))
        self.learnt = learn(Trials.of(self.trials), len(self.trials), self.learnt, choose_parts)

    @property
    def tried(self) -> TriedWalls:
        """The trials so far."""
        if not self.trials:
            nothing = np.empty(0)
            return TriedWalls(nothing, nothing, np.empty(0, dtype="<U9"), nothing)
        verdict, growth = (np.array(column) for column in zip(*self.verdicts, strict=True))
        walls = (np.array([getattr(trial, name) for trial in self.trials]) for name in ("stiffness", "damping"))
        stiffness, damping = walls
        return TriedWalls(stiffness, damping, verdict, growth)

    def with_costs(self, tried: TriedWalls) -> TriedWalls:
        """Return the trials with their settling times, with the delay that the logs show."""
        if not self.trials:
            return tried
        return replace(tried, cost=self.settling(self.trials))

    def settling(self, trials: Iterable[Trial]) -> Floats:
        """Return measured settling times of trials [samples]."""
        delay, costs = int(self.case.stated.experiments[0].delay_samples), []
        for trial in trials:
            response = find_response(trial)
            costs.append(settling(trial, response, judge(trial, response), delay)["settle_2pct"].value)
        return np.array(costs)

    def campaign(self, *, costs: bool = False) -> Campaign:
        """Return the trials so far as the planner reads them."""
        stated, tried = self.case.stated, self.tried
        return Campaign(
            name="case",
            experiment=stated.experiments[0].name,
            tried=self.with_costs(tried) if costs else tried,
            device=stated,
            of_file=stated.experiments[0],
            sampling_period_s=stated.sampling_period_s,
            trial_s=stated.duration_s - stated.baseline_s,
            step=stated.step,
            motion="translation",
            found=self.learnt.device if self.learnt else None,
        )

    def truth(self, dampings: Sequence[float]) -> tuple[Floats, Floats]:
        """Return lower and upper end of the true limit of each damping.

        Verdicts of `WALLS` walls: where they are undecided or contradict each other, each limit between is true.
        """
        walls = np.linspace(0, HIGHEST, WALLS + 1)[1:]
        K, B = np.tile(walls, len(dampings)), np.repeat(dampings, WALLS)
        verdicts = self.try_walls(K, B).reshape(-1, WALLS)
        ends = []
        for said in verdicts:
            first = walls[said == "unstable"].min(initial=HIGHEST)
            last = walls[said == "stable"].max(initial=0.0)
            below = walls[(said == "stable") & (walls < first)].max(initial=0.0)
            ends.append((below, walls[(said == "unstable") & (walls > last)].min(initial=HIGHEST)))
        low, high = np.array(ends).T
        return low, high


MOST_TRIALS = 150
"""Trials after which a course of the planner is given up."""

RANGE = 1.3
"""Range of stiffness in which bisection and random walls look, relative to the largest limit: they are told it."""

COARSE_STEP, FINE_STEPS = 200.0, 5
"""Of the thesis's procedure for the Falcon [N/m] (6.1.1)."""


@dataclass(frozen=True, eq=False)
class Known:
    """Limits after some trials, NaN where they are not told; and whether the search says that it is done."""

    trials: int
    limit: Floats
    done: bool = False
    unstable: float = float("nan")


def planned(rig: Rig, options: PlanOptions) -> Iterator[Known]:
    """Yield what is known after each trial that the planner asks for."""
    while True:
        answer = plan_of(rig.campaign(), options)
        said = [verdict == "unstable" for verdict, _ in rig.verdicts]
        limit = np.array([point.estimate for point in answer.boundary], dtype=np.float64)
        yield Known(answer.trials_used, limit, answer.done, float(np.mean(said)) if said else 0.0)
        if answer.done or answer.trials_used >= MOST_TRIALS:
            return
        rig.measure(answer.next[0].stiffness, answer.next[0].damping)


def bisected(rig: Rig, dampings: Sequence[float], largest: float, accuracy: float) -> Iterator[Known]:
    """Yield what is known after each round of a bisection at all dampings."""
    low, high = np.zeros(len(dampings)), np.full(len(dampings), RANGE * largest)
    trials = 0
    while (high - low).max() > 2 * accuracy * largest:
        middle = 0.5 * (low + high)
        unstable = rig.try_walls(middle, np.array(dampings)) == "unstable"
        low, high = np.where(unstable, low, middle), np.where(unstable, middle, high)
        trials += len(dampings)
        yield Known(trials, 0.5 * (low + high))


def at_random(rig: Rig, dampings: Sequence[float], largest: float, counts: Sequence[int]) -> Iterator[Known]:
    """Yield what is known after some numbers of random walls."""
    random = np.random.default_rng(rig.seed)
    K, place = random.uniform(0, RANGE * largest, max(counts)), random.integers(len(dampings), size=max(counts))
    verdict = rig.try_walls(K, np.array(dampings)[place])
    for count in counts:
        found = [
            bracket(K[:count][own], verdict[:count][own]) for own in (place[:count] == i for i in range(len(dampings)))
        ]
        yield Known(count, np.array([0.5 * (of.bottom + min(of.top, RANGE * largest)) for of in found]))


def as_in_the_thesis(low: Floats, high: Floats, coarsen: Sequence[int]) -> Iterator[Known]:
    """Yield what the procedure of sec. 6.1.1 tells with steps of so many times its own, from the true limits.

    Coarse steps up to the first unstable wall, then fine ones from the last stable wall on.
    """
    for factor in coarsen:
        coarse = COARSE_STEP * factor
        fine = coarse / FINE_STEPS
        climbed = np.ceil(np.maximum(high, 1.0) / coarse)
        start = (climbed - 1) * coarse
        steps = np.clip(np.ceil((0.5 * (low + high) - start) / fine), 1, FINE_STEPS)
        trials = int((climbed + np.minimum(steps, FINE_STEPS - 1)).sum())
        yield Known(trials, start + (steps - 0.5) * fine)


def error_of(known: Known, ends: tuple[Floats, Floats]) -> float:
    """Return the largest error of the limits that are told, relative to the largest true one; NaN where none is."""
    if not np.isfinite(known.limit).any():
        return float("nan")
    off = np.maximum(np.maximum(ends[0] - known.limit, known.limit - ends[1]), 0.0)
    return float(np.nanmax(off) / max(float(ends[0].max()), 1.0))


CRITERION = "settle_2pct"

MOST_TRIALS_OF_BEST = 80
"""Trials after which the search is given up."""

GRID = 60
"""Walls along each axis among which the best one of a device with friction is looked for: theory has none."""

LONGEST = 20_000
"""Samples within which the exact responses have settled."""


@dataclass(frozen=True)
class FoundBest:
    """Trials of a search, whether it said that it is done, and the cost of its best wall over the least, less 1."""

    trials: int
    done: bool
    above: float


def look_for_best(rig: Rig) -> FoundBest:
    """Run a search for the best settling time."""
    wish = PlanOptions(goal="optimum", criterion=CRITERION)
    while True:
        answer = plan_of(rig.campaign(costs=True), wish)
        if answer.done or answer.trials_used >= MOST_TRIALS_OF_BEST:
            break
        rig.measure(answer.next[0].stiffness, answer.next[0].damping)
    if answer.optimum is None:
        return FoundBest(answer.trials_used, answer.done, float("inf"))
    wall = answer.optimum.stiffness, answer.optimum.damping
    cost = _cost(rig, *wall)
    return FoundBest(answer.trials_used, answer.done, cost / min(_least(rig), cost) - 1)


def _loop(rig: Rig) -> tuple[NormalisedLoop, LoopUnits] | None:
    loop = rig.case.device.loop_for(rig.case.device.experiments[0])
    return None if loop.friction is not None else (NormalisedLoop.of(loop), LoopUnits.of(loop))


def _cost(rig: Rig, stiffness: float, damping: float) -> float:
    """Return the cost of a wall: exact, or with friction the measured one."""
    known = _loop(rig)
    K, B = np.array([stiffness]), np.array([damping])
    if known is None:
        return float(rig.settling(simulate(rig.setup, K, B, seed=rig.seed))[0])
    loop, units = known
    return float(point_costs_by_name(loop, K / units.stiffness, B / units.damping, [CRITERION], LONGEST)[CRITERION][0])


def _least(rig: Rig) -> float:
    """Return the least cost of any wall: exact, or with friction the least of a dense grid."""
    known = _loop(rig)
    if known is not None:
        return optimal_point(known[0], CRITERION).cost
    dampings = wanted_dampings(rig.campaign(), PlanOptions())
    largest = float(rig.truth(dampings)[0].max())
    K, B = np.meshgrid(np.linspace(0, largest, GRID + 1)[1:], np.linspace(dampings[0], dampings[-1], GRID))
    return float(np.nanmin(rig.settling(simulate(rig.setup, K.ravel(), B.ravel(), seed=rig.seed))))

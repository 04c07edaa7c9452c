"""A simulated device whose walls are tried one after the other, and the limits that its verdicts have in truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.device_data.devices import load_device
from pipeline.measured.cost.settling_overshoot import settling
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.plan.course import Course
from pipeline.plan.fitted import Fitted, at_once, learn
from pipeline.plan.verdicts import Tried
from pipeline.records.batch import Floats, TrialBatch
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.studies.coverage.kinds import kinds

KINDS = {
    "ideal": "ideal",
    "frictional": "friction weak",
    "lagging": "actuator lag",
    "filtered": "butterworth filter",
    "vibrating": "mode at the motor",
}
"""Kinds of devices by their names here, as in `coverage.kinds`."""

WALLS, HIGHEST = 200, 20_000.0
"""Walls by which the true limit of a damping is told, up to a stiffness [N/m] that no such device bears."""


class Rig:
    """A variation of the Falcon, with its trials; the planner has its file without what the kind adds."""

    def __init__(self, kind: str, seed: int) -> None:
        self.case, self.seed = kinds(load_device("falcon"))[KINDS[kind]](seed), seed
        self.setup = setup_of(self.case.device, self.case.device.experiments[0])
        self.trials: list[TrialBatch] = []
        self.verdicts: list[tuple[str, float]] = []
        self.fitted: Fitted | None = None

    def try_walls(self, stiffness: Floats, damping: Floats, repetition: int = 0) -> np.ndarray:
        """Return the verdicts of walls, which are not kept."""
        return np.asarray(
            judge(simulate(self.setup, stiffness, damping, seed=self.seed, repetition=repetition)).verdict
        )

    def measure(self, stiffness: float, damping: float) -> None:
        """Try a wall, keep the trial, and learn from it."""
        wall = np.array([stiffness]), np.array([damping])
        again = sum(bool(trial.stiffness[0] == stiffness and trial.damping[0] == damping) for trial in self.trials)
        batch = simulate(self.setup, *wall, seed=self.seed, repetition=again)
        found = judge(batch)
        self.trials.append(batch)
        self.verdicts.append((str(found.verdict[0]), float(found.growth_per_s[0])))
        self.fitted = learn(TrialBatch.joined(self.trials), self.fitted, at_once)

    @property
    def tried(self) -> Tried:
        """The trials so far."""
        if not self.trials:
            nothing = np.empty(0)
            return Tried(nothing, nothing, np.empty(0, dtype="<U9"), nothing)
        verdict, growth = (np.array(column) for column in zip(*self.verdicts, strict=True))
        walls = (np.array([float(getattr(each, name)[0]) for each in self.trials]) for name in ("stiffness", "damping"))
        stiffness, damping = walls
        return Tried(stiffness, damping, verdict, growth)

    def with_costs(self, tried: Tried) -> Tried:
        """Return the trials with their settling times, with the delay that the logs show."""
        if not self.trials:
            return tried
        batch = TrialBatch.joined(self.trials)
        return replace(tried, cost=self.settling(batch))

    def settling(self, batch: TrialBatch) -> Floats:
        """Return measured settling times of trials [samples]."""
        response = find_response(batch)
        delay = int(self.case.stated.experiments[0].delay_samples)
        return settling(batch, response, judge(batch, response), delay).samples["settle_2pct"]

    def course(self, *, costs: bool = False) -> Course:
        """Return the trials so far as the planner reads them."""
        stated, tried = self.case.stated, self.tried
        return Course(
            name="case",
            experiment=stated.experiments[0].name,
            tried=self.with_costs(tried) if costs else tried,
            device=stated,
            of_file=stated.experiments[0],
            sampling_period_s=stated.sampling_period_s,
            trial_s=stated.duration_s - stated.baseline_s,
            step=stated.step,
            rotation=False,
            fitted=self.fitted,
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

"""Trials that the planner needs for the limits at 12 dampings, beside bisection, random walls and the thesis's way.

    python benchmarks/plan.py [--seeds 20] [--kind ideal] [--out FILE.json]

Devices are variations of the Falcon (`pipeline.studies.coverage.kinds`), whose file the planner is given without what
the kind adds. The true limit of a damping is where the verdicts of 200 simulated walls change; where they contradict
each other, any limit between counts as true. A row a kind, medians over the seeds; nothing here fails.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.device_data.devices import load_device
from pipeline.measured.signal.verdict import judge
from pipeline.plan.planner import Course, Wish, plan_of, wanted_dampings
from pipeline.plan.verdicts import Tried, bracket
from pipeline.records.batch import Floats
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.studies.coverage.kinds import kinds

KINDS = {
    "ideal": ("ideal", 30),
    "frictional": ("friction weak", 50),
    "lagging": ("actuator lag", 50),
    "filtered": ("butterworth filter", 50),
    "vibrating": ("mode at the motor", 50),
}
"""Kind by its name here, and the median of trials that it may take."""

GENTLE_TRIALS, GENTLE_UNSTABLE, WRONG, ACCURACY = 65, 0.25, 0.05, 0.02
MOST_TRIALS = 150
WALLS, HIGHEST = 200, 20_000.0
COARSE_STEP, FINE_STEPS = 200.0, 5
"""Of the thesis's procedure for the Falcon (6.1.1) [N/m]."""


Ends = tuple[Floats, Floats]


class Rig:
    """A simulated device with its trials."""

    def __init__(self, kind: str, seed: int) -> None:
        self.case, self.seed = kinds(load_device("falcon"))[KINDS[kind][0]](seed), seed
        self.setup = setup_of(self.case.device, self.case.device.experiments[0])
        self.rows: list[tuple[float, float, str, float]] = []

    def try_walls(self, stiffness: Floats, damping: Floats, repetition: int = 0) -> tuple[np.ndarray, Floats]:
        """Return verdicts and growth rates."""
        batch = simulate(self.setup, stiffness, damping, seed=self.seed, repetition=repetition)
        found = judge(batch)
        return np.asarray(found.verdict), found.growth_per_s

    def measure(self, stiffness: float, damping: float) -> None:
        """Try a wall and keep the trial."""
        again = sum(row[:2] == (stiffness, damping) for row in self.rows)
        verdict, growth = self.try_walls(np.array([stiffness]), np.array([damping]), again)
        self.rows.append((stiffness, damping, str(verdict[0]), float(growth[0])))

    def course(self) -> Course:
        """Return the trials so far as the planner reads them."""
        columns = [np.array(column) for column in zip(*self.rows, strict=True)] or [np.empty(0)] * 4
        stated = self.case.stated
        length = stated.duration_s - stated.baseline_s
        return Course(
            *("case", stated.experiments[0].name, Tried(*columns), stated, stated.experiments[0]),
            *(stated.sampling_period_s, length, stated.step, False),
        )

    def truth(self, dampings: Sequence[float]) -> tuple[Floats, Floats]:
        """Return lower and upper end of the true limit of each damping."""
        walls = np.linspace(0, HIGHEST, WALLS + 1)[1:]
        K, B = np.tile(walls, len(dampings)), np.repeat(dampings, WALLS)
        verdicts = self.try_walls(K, B)[0].reshape(-1, WALLS)
        ends = []
        for said in verdicts:
            first = walls[said == "unstable"].min(initial=HIGHEST)
            last = walls[said == "stable"].max(initial=0.0)
            below = walls[(said == "stable") & (walls < first)].max(initial=0.0)
            ends.append((below, walls[(said == "unstable") & (walls > last)].min(initial=HIGHEST)))
        low, high = np.array(ends).T
        return low, high


def planned(rig: Rig, gentle: bool) -> dict[str, Any]:
    """Run a course as the planner says."""
    wish = Wish(gentle=gentle)
    began = time.process_time()
    asked = 0.0
    while True:
        start = time.process_time()
        answer = plan_of(rig.course(), wish)
        asked = max(asked, time.process_time() - start)
        if answer.done or not answer.next or answer.trials_used >= MOST_TRIALS:
            break
        rig.measure(answer.next[0].stiffness, answer.next[0].damping)
    estimate = np.array([point.estimate for point in answer.boundary], dtype=np.float64)
    unstable = float(np.mean([row[2] == "unstable" for row in rig.rows]))
    return {
        "trials": answer.trials_used,
        "done": answer.done,
        "unstable": unstable,
        "estimate": estimate,
        "slowest_s": asked,
        "cpu_s": time.process_time() - began,
    }


def bisected(rig: Rig, dampings: Sequence[float], largest: float) -> int:
    """Return the trials of a bisection at each damping from 0 to 1.3 times the largest limit."""
    low, high = np.zeros(len(dampings)), np.full(len(dampings), 1.3 * largest)
    trials = 0
    while (high - low).max() > 2 * ACCURACY * largest:
        middle = 0.5 * (low + high)
        unstable = rig.try_walls(middle, np.array(dampings))[0] == "unstable"
        low, high = np.where(unstable, low, middle), np.where(unstable, middle, high)
        trials += len(dampings)
    return trials


def random_error(
    rig: Rig, dampings: Sequence[float], largest: float, trials: int, ends: tuple[Floats, Floats]
) -> float:
    """Return the largest error of limits by random walls, relative to the largest limit."""
    random = np.random.default_rng(rig.seed)
    K, place = random.uniform(0, 1.3 * largest, trials), random.integers(len(dampings), size=trials)
    verdict = rig.try_walls(K, np.array(dampings)[place])[0]
    found = [bracket(K[place == i], verdict[place == i]) for i in range(len(dampings))]
    middle = np.array([0.5 * (of.bottom + min(of.top, 1.3 * largest)) for of in found])
    return float(np.maximum(ends[0] - middle, middle - ends[1]).max(initial=0.0) / largest)


def run(kind: str, seed: int) -> dict[str, Any]:
    """Run one device by all methods."""
    rig, spared = Rig(kind, seed), Rig(kind, seed)
    dampings = wanted_dampings(rig.course(), Wish())
    ends = rig.truth(dampings)
    largest = float(ends[0].max())
    found: dict[str, Any] = {"kind": kind, "seed": seed}
    for name, of, gentle in (("plan", rig, False), ("gentle", spared, True)):
        result = planned(of, gentle)
        estimate = result.pop("estimate")
        error = np.maximum(ends[0] - estimate, estimate - ends[1]).max(initial=0.0) / max(largest, 1.0)
        found |= {f"{name}_{key}": value for key, value in result.items()} | {f"{name}_error": float(error)}
    found["bisection_trials"] = bisected(rig, dampings, largest)
    found["random_error"] = random_error(rig, dampings, largest, found["plan_trials"], ends)
    found["thesis_trials"] = int((np.ceil(ends[1] / COARSE_STEP) + FINE_STEPS - 1).sum())
    return found


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--kind", action="append", choices=list(KINDS))
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    rows = []
    print(
        f"{'kind':12s} {'trials':>6s} {'limit':>5s} {'most':>5s} {'wrong':>6s}  | {'gentle':>6s} {'limit':>5s} "
        f"{'unstable':>8s} {'wrong':>6s}  | {'bisection':>9s} {'thesis':>6s} {'random off':>10s}  slowest answer"
    )
    for kind in asked.kind or KINDS:
        of = [run(kind, seed) for seed in range(asked.seeds)]
        rows += of

        def median(key: str, of: list[dict[str, Any]] = of) -> float:
            return float(np.median([row[key] for row in of]))

        wrong = {name: np.mean([row[f"{name}_error"] > ACCURACY for row in of]) for name in ("plan", "gentle")}
        print(
            f"{kind:12s} {median('plan_trials'):6.1f} {KINDS[kind][1]:5d} {max(row['plan_trials'] for row in of):5d} "
            f"{wrong['plan']:6.0%}  | {median('gentle_trials'):6.1f} {GENTLE_TRIALS:5d} "
            f"{median('gentle_unstable'):8.0%} {wrong['gentle']:6.0%}  | {median('bisection_trials'):9.0f} "
            f"{median('thesis_trials'):6.0f} {median('random_error'):10.1%}  "
            f"{max(row['plan_slowest_s'] for row in of):.2f} s",
            flush=True,
        )
    if asked.out:
        asked.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()

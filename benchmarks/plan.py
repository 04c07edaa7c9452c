"""Trials that the planner needs for the limits at 12 dampings, beside bisection, random walls and the thesis's way.

    python benchmarks/plan.py [--seeds 20] [--first 0] [--kind ideal] [--goal gentle] [--out FILE.json]

Devices are variations of the Falcon (`tests/support/rigs.py`), whose file the planner is given without what the
kind adds. Verdicts are those of simulated logs of 0.4 s with quantum and noise, as a rig would give them, also for the
truth: where the verdicts of 200 walls of a damping change. Costs are measured from the same logs; the true best cost is
the exact one of theory, with friction that of a dense grid of logs. A row a kind, medians over the seeds; nothing
here fails. Times are those of the processor: some 10 minutes for ``boundary`` of 5 kinds and 20 seeds, some 10 for each
other goal. Parts of a run (--kind, --first, --out) are put together by --read FILE.json ...
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.planning.campaign import PlanOptions, wanted_dampings

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from rigs import KINDS, Rig, as_in_the_thesis, at_random, bisected, error_of, look_for_best, planned

MOST = dict.fromkeys(KINDS, 50) | {"ideal": 30}
GENTLE_TRIALS, GENTLE_UNSTABLE, OPTIMUM_TRIALS, WRONG, ACCURACY, COST = 65, 0.25, 60, 0.05, 0.02, 0.05
"""What is asked for: medians of trials, share of unstable ones, runs that say done and are wrong, accuracies."""

GOALS = ("boundary", "gentle", "optimum")


def searched(rig: Rig, dampings: Sequence[float], ends: Any, name: str) -> dict[str, Any]:
    """Run a campaign of the planner to its end."""
    began, slowest, last = time.process_time(), 0.0, time.process_time()
    campaign = []
    for known in planned(rig, PlanOptions(gentle=name == "gentle")):
        slowest, last = max(slowest, time.process_time() - last), time.process_time()
        campaign.append(known)
    known = campaign[-1]
    return {
        "trials": known.trials,
        "done": known.done,
        "unstable": known.unstable,
        "untold": int(np.isnan(known.limit).sum()),
        "error": error_of(known, ends),
        "slowest_s": slowest,
        "cpu_s": time.process_time() - began,
    }


def run(kind: str, seed: int, goals: Sequence[str]) -> dict[str, Any]:
    """Run one device by all methods."""
    found: dict[str, Any] = {"kind": kind, "seed": seed}
    rig = Rig(kind, seed)
    dampings = wanted_dampings(rig.campaign(), PlanOptions())
    if set(goals) & {"boundary", "gentle"}:
        ends = rig.truth(dampings)
        largest = float(ends[0].max())
    if "boundary" in goals:
        found["plan"] = searched(rig, dampings, ends, "plan")
        *_, halved = bisected(rig, dampings, largest, ACCURACY)
        (random,) = at_random(rig, dampings, largest, [found["plan"]["trials"]])
        (thesis,) = as_in_the_thesis(*ends, [1])
        for name, known in (("bisection", halved), ("random", random), ("thesis", thesis)):
            found[name] = {"trials": known.trials, "error": error_of(known, ends)}
    if "gentle" in goals:
        found["gentle"] = searched(Rig(kind, seed), dampings, ends, "gentle")
    if "optimum" in goals:
        began = time.process_time()
        best = look_for_best(Rig(kind, seed))
        found["optimum"] = {**vars(best), "cpu_s": time.process_time() - began}
    return found


def _column(rows: list[dict[str, Any]], method: str, name: str) -> np.ndarray:
    return np.array([row[method][name] for row in rows if method in row], dtype=np.float64)


def line(kind: str, rows: list[dict[str, Any]]) -> str:
    """Return the row of a kind."""
    text = f"{kind:11s} {len(rows):3d}"
    for method, most in (("plan", MOST[kind]), ("gentle", GENTLE_TRIALS)):
        trials, error, done = (_column(rows, method, name) for name in ("trials", "error", "done"))
        if not len(trials):
            text += " | " + "-".center(38)
            continue
        wrong = float(np.mean((error > ACCURACY) & (done > 0)))
        text += (
            f" | {np.median(trials):5.1f} <= {most:2d} {trials.max():4.0f}"
            f" {np.median(_column(rows, method, 'unstable')):5.0%} {wrong:5.0%} {np.mean(done == 0):5.0%}"
            f" {_column(rows, method, 'untold').sum():3.0f}"
        )
    trials, above, done = (_column(rows, "optimum", name) for name in ("trials", "above", "done"))
    if len(trials):
        text += f" | {np.median(trials):4.1f} <= {OPTIMUM_TRIALS} {trials.max():3.0f}"
        text += f" {np.median(above):5.1%} {above.max():6.1%}"
        text += f" {np.mean((above > COST) & (done > 0)):5.0%} {np.mean(done == 0):5.0%}"
    if len(_column(rows, "bisection", "trials")):
        others = (f"{np.median(_column(rows, name, 'trials')):5.0f}" for name in ("bisection", "thesis"))
        text += " | " + " ".join(others) + f" {np.median(_column(rows, 'random', 'error')):6.1%}"
        text += f" {_column(rows, 'plan', 'slowest_s').max():5.2f} s"
    return text


HEAD = (
    "kind          n | plan: median, most, unstable, wrong, not done, untold | gentle: the same | "
    "optimum: median, most, cost above the least (median, worst), wrong, not done | bisection, thesis, random's error, "
    "slowest answer"
)


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=list(KINDS))
    parser.add_argument("--goal", action="append", choices=GOALS)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--read", type=Path, nargs="+", help="Print what earlier runs found, and run nothing.")
    asked = parser.parse_args()
    merged: dict[tuple[str, int], dict[str, Any]] = {}
    for file in asked.read or ():
        for row in json.loads(file.read_text(encoding="utf-8")):
            merged.setdefault((row["kind"], row["seed"]), {}).update(row)
    print(HEAD)
    chosen = asked.kind or list(KINDS)
    for seed in range(asked.first, asked.first + asked.seeds) if not asked.read else ():
        for kind in chosen:
            merged[kind, seed] = run(kind, seed, asked.goal or GOALS)
            if asked.out:
                asked.out.write_text(json.dumps(list(merged.values()), indent=1), encoding="utf-8")
    for kind in chosen:
        own = [row for (of, _), row in merged.items() if of == kind]
        if own:
            print(line(kind, own), flush=True)


if __name__ == "__main__":
    main()

"""Speed and memory of the measured branch: all estimates, verdicts and costs of simulated Falcon trials on one core.

    python benchmarks/measured.py [--trials 2200] [--rows 1000]

Trials are simulated as the thesis recorded them, with a delay that jitters, and once more without jitter. Each set is
then computed in a process of its own with one thread for linear algebra. A row a function; nothing here fails on a slow
machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from timing import run

TRIALS, ROWS = 2200, 1000
LIMIT_S = 6.0
"""Sum of all functions, one core, with and without jitter."""

FREE_TRIALS = 20
"""Trials at K = 0, B < 0, which tell the damping by its limit."""

DELAY, MASS, MASS_ERROR = 4, 0.58, 0.001
"""Delay factor, mass [kg] and its standard error that the costs are computed with; the range of the delay is +-1."""

Result = TypeVar("Result")


def simulate_trials(file: Path, trials: int, rows: int, jitter: bool) -> None:
    """Write trials of Falcon experiment 1 at (K, B) drawn from the range that the thesis tested."""
    from pipeline.device_data.devices import load_device
    from pipeline.simulation.setup import setup_of
    from pipeline.simulation.simulate import simulate

    device = load_device("falcon")
    setup = replace(setup_of(device, device.experiments[0]), rows=rows)
    setup = setup if jitter else replace(setup, jitter_samples=())
    random = np.random.default_rng(0)
    stiffness, damping = random.uniform(200, 14_000, trials), random.uniform(0, 184, trials)
    stiffness[:FREE_TRIALS], damping[:FREE_TRIALS] = 0, -random.uniform(0, 6, FREE_TRIALS)
    batch = simulate(setup, stiffness, damping, seed=1)
    np.savez(file, **{name: value for name, value in vars(batch).items() if isinstance(value, np.ndarray)})


def compute(file: Path) -> dict[str, Any]:
    """Return processor time [s] of each function, wall time [s] of all, and peak memory [MiB] of this process."""
    from pipeline.measured.cost import settling_overshoot, step_metrics
    from pipeline.measured.cost.cost_intervals import overshoot_interval, settling_interval
    from pipeline.measured.cost.energy_intervals import energy_interval
    from pipeline.measured.cost.reading_error import reading_error
    from pipeline.measured.device import damping, delay, friction, mass, onset
    from pipeline.measured.experiment.boundary_band import boundary_band
    from pipeline.measured.fit import fit
    from pipeline.measured.fit.ghost import simulate_ghost
    from pipeline.measured.signal import outcome, verdict
    from pipeline.measured.signal.response import find_response
    from pipeline.measured.stages.stage_mass import BALANCE_TERMS
    from pipeline.records.batch import TrialBatch

    with np.load(file) as stored:
        arrays = dict(stored)
    batch = TrialBatch(tuple(str(i) for i in range(len(arrays["rows"]))), **arrays)
    times: dict[str, float] = {}

    def timed(name: str, work: Callable[[], Result]) -> Result:
        began = time.process_time()
        result = work()
        times[name] = time.process_time() - began
        return result

    span = (DELAY - 1, DELAY + 1)
    began = time.perf_counter()
    found = timed("response", lambda: find_response(batch))
    judged = timed("verdict", lambda: verdict.judge(batch, found))
    timed("outcome", lambda: outcome.classify(batch, found, judged))
    timed("boundary", lambda: boundary_band(batch.stiffness, batch.damping, judged.verdict, judged.growth_per_s))
    first = timed("delay by first change", lambda: delay.first_change(batch, found))
    timed("delay by onset", lambda: onset.motion_onset(batch, found, first))
    model = timed("fit of the response", lambda: fit.fit_trials(batch, found))
    timed("fit beside the log", lambda: simulate_ghost(batch, found, model.mass, model.damping, model.delay))
    timed("damping", lambda: damping.from_trials(batch, found, DELAY))
    timed("mass by momentum", lambda: mass.by_momentum(batch, found, DELAY))
    timed("mass by balance", lambda: friction.fit_balance(batch, found, DELAY, terms=BALANCE_TERMS))
    error = timed("error of readings", lambda: reading_error(batch, found, DELAY))
    settled = timed("settling", lambda: settling_overshoot.settling(batch, found, judged, DELAY))
    timed("settling interval", lambda: settling_interval(batch, found, error, settled, DELAY, delay_range=span))
    passed = timed("overshoot", lambda: settling_overshoot.overshoot(batch, found, judged))
    timed("overshoot interval", lambda: overshoot_interval(batch, found, error, passed))
    timed(
        "energy interval",
        lambda: energy_interval(batch, found, judged, error, DELAY, MASS, mass_error=MASS_ERROR, delay_range=span),
    )
    timed("as other tools define", lambda: step_metrics.reconcile(batch, found, judged, DELAY))
    return {"times": times, "wall_s": time.perf_counter() - began}


def measure(folder: Path, trials: int, rows: int, jitter: bool) -> tuple[dict[str, Any], float]:
    """Return what a process of its own computed, and its peak memory [MiB]."""
    file = folder / f"{jitter}.npz"
    simulate_trials(file, trials, rows, jitter)
    spent = run([sys.executable, __file__, "--compute", str(file)])
    return json.loads(spent.output), spent.mebibytes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--rows", type=int, default=ROWS)
    parser.add_argument("--compute", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.compute is not None:
        print(json.dumps(compute(arguments.compute)))
        return
    with tempfile.TemporaryDirectory() as name:
        cases = [measure(Path(name), arguments.trials, arguments.rows, jitter) for jitter in (True, False)]
    (jitter, jitter_mib), (steady, steady_mib) = cases
    head = f"{arguments.trials} trials x {arguments.rows} rows, one core"
    print(f"{head:40} {'jitter [s]':>11} {'none [s]':>11} {'limit [s]':>10}")
    for function, seconds in jitter["times"].items():
        print(f"{function:40} {seconds:11.2f} {steady['times'][function]:11.2f}")
    sums = [sum(case["times"].values()) for case in (jitter, steady)]
    verdict = "" if (arguments.trials, arguments.rows) != (TRIALS, ROWS) else " over" * (max(sums) > LIMIT_S)
    print(f"{'all estimates, verdicts and costs':40} {sums[0]:11.2f} {sums[1]:11.2f} {LIMIT_S:10.2f}{verdict}")
    print(f"{'wall time':40} {jitter['wall_s']:11.2f} {steady['wall_s']:11.2f}")
    print(f"{'peak memory [MiB]':40} {jitter_mib:11.0f} {steady_mib:11.0f}")


if __name__ == "__main__":
    main()

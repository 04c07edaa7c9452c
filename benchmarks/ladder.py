"""Processor time of the stages that tell what device the logs show, for 2,200 trials of 1,000 rows and each kind of it.

    python benchmarks/ladder.py [--trials 2200] [--rows 1000] [--kind NAME ...]

Walls are drawn over the range that the thesis tested on Falcon 1. Wanted: 8 s where the ideal loop explains the logs,
40 s for the whole ladder, for the fit of each trial and that of one device together.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from pipeline.comparison.scene.scene import open_scene
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.records.models import Device
from pipeline.simulation.course import Course, write_course
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate

KINDS = {
    "ideal": {},
    "lag": {"actuator_lag_s": 0.002},
    "mode": {"mode": {"frequency_hz": 40.0, "damping_ratio": 0.03, "mass": 0.1, "sensor": "motor"}},
    "friction": {"friction": {"coulomb": 0.3}},
    "stiction": {"friction": {"coulomb": 0.3, "stiction": 0.6, "stribeck_velocity": 0.01}},
}
STAGES = ("response", "wall_law", "delay", "model", "ladder", "damping", "mass", "settling", "overshoot", "energy")
FIT, IDEAL_S, LADDER_S = ("model", "ladder"), 8.0, 40.0


def course_of(kind: str, trials: int, rows: int) -> Course:
    """Return trials of a Falcon with the parts of a kind, at walls drawn over the tested range."""
    plain = load_device("falcon").model_copy(update={"tables": (), "name": kind})
    document = plain.model_dump(mode="json", by_alias=True, exclude_unset=True, exclude={"tables"})
    document |= {"loop": KINDS[kind], "experiment": document["experiment"][:1]}
    document["experiment"][0] |= {"jitter_samples": []}
    device = Device.model_validate(document)
    (experiment,) = device.experiments
    setup, random = replace(setup_of(device, experiment), rows=rows), np.random.default_rng(0)
    batch = simulate(setup, random.uniform(200, 14_000, trials), random.uniform(0, 184, trials), seed=1)
    batch = replace(batch, trial_id=tuple(f"t{i}" for i in range(trials)))
    return Course(device, experiment, setup, 1, batch, np.ones(trials, int), np.full(trials, "stable"))


def main(kinds: list[str], trials: int, rows: int) -> None:
    """Print a line a kind."""
    print(f"{trials} trials x {rows} rows, one core; processor time [s]")
    print(f"{'kind':<10}{'parts':<22}" + "".join(f"{name:>10}" for name in (*STAGES, "fit", "all")))
    for kind in kinds:
        with tempfile.TemporaryDirectory() as name:
            write_course(course_of(kind, trials, rows), Path(name, "raw"))
            ingest([Path(name, "raw")], Path(name, "processed"), jobs=1)
            (stages,) = open_scene(kind, Path(name, "processed"), None, None).experiments
            taken = {}
            for stage in STAGES:
                begin = time.process_time()
                stages.table(stage)
                taken[stage] = time.process_time() - begin
            parts = [*stages.texts("ladder", "parts"), ""][0]
        fit = sum(taken[stage] for stage in FIT)
        over = "  over" if fit > (IDEAL_S if kind == "ideal" else LADDER_S) else ""
        cells = [*taken.values(), fit, sum(taken.values())]
        print(f"{kind:<10}{parts:<22}" + "".join(f"{cell:>10.1f}" for cell in cells) + over, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--kind", action="append", choices=KINDS)
    parser.add_argument("--trials", type=int, default=2200)
    parser.add_argument("--rows", type=int, default=1000)
    given = parser.parse_args()
    main(given.kind or list(KINDS), given.trials, given.rows)

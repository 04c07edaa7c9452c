"""Intervals of randomly drawn experiments and whether they contain the truth; as a script it prints the rows to store.

    python tests/support/interval_draws.py FIRST COUNT > rows.csv

Each seed is an experiment of 1 to 12 trials of one device, behind walls or free, with the sensor, friction and steps
that it draws; a row is one 95 % interval: seed, name, truth, low, high.
"""

from __future__ import annotations

import sys

import numpy as np
from any_experiment import Rig, Trial, recorded

from pipeline.base.errors import ParameterError
from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.recordings import Recording

Row = tuple[int, str, float, float, float]


def drawn(seed: int) -> tuple[Rig, list[Trial]]:
    """Return the device and the trials of a seed."""
    rng = np.random.default_rng(seed)
    mass = 10 ** rng.uniform(-1.5, 0.7)
    rig = Rig(
        mass=mass,
        damping=mass * rng.uniform(1, 8),
        friction=float(rng.choice([0.0, 1.0]) * rng.uniform(0.02, 0.4)),
        period=float(rng.choice([1e-3, 5e-4])),
        delay=float(round(rng.uniform(0, 6) * 20) / 20),
        resolution=float(rng.choice([0.0, 1e-6, 1e-5])),
        noise=float(rng.choice([0.0, 1e-6])),
    )
    one_way = rng.random() < 0.4
    trials = []
    for _ in range(int(rng.integers(1, 13))):
        damping = rng.uniform(0, 0.3) * mass / rig.period / (1 + rig.delay)
        stiffness = rng.uniform(0.02, 0.4) * (damping + rig.damping) / rig.period / (0.5 + rig.delay)
        size = float(rng.choice([1.0, 2.0, 4.0]) * (1 if one_way else rng.choice([1, -1])))
        trials.append(Trial(stiffness * (rng.random() < 0.9), damping, size, rows=int(rng.integers(120, 300))))
    return rig, trials


def intervals(seed: int) -> list[Row]:
    """Return the intervals of the parameters that can be identified from the experiment of a seed."""
    rig, trials = drawn(seed)
    logs = [Recording(str(i), *recorded(rig, trial, 1000 * seed + i), rig.period) for i, trial in enumerate(trials)]
    try:
        found = identified(logs)
    except ParameterError:
        return []
    truth = {"mass": rig.mass, "damping": rig.damping, "delay_samples": rig.delay, "friction.coulomb": rig.friction}
    return [
        (seed, name, value, each.low, each.high)
        for name, value in truth.items()
        if name not in found.unidentifiable and (each := found.parameters.get(name)) is not None
    ]


if __name__ == "__main__":
    first, count = int(sys.argv[1]), int(sys.argv[2])
    for seed in range(first, first + count):
        for row in intervals(seed):
            print(",".join(map(repr, row)).replace("'", ""), flush=True)

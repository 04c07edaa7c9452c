"""Draw `img/scatter.svg`: the inertia that ten steps tell over the scatter of friction from run to run."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from pipeline.device.parts import Friction
from pipeline.loop.motion import FrictionalMotion
from pipeline.loop.state_space import Plant
from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.recordings import Recording

FILE = Path(__file__).parent / "img" / "scatter.svg"
T, ROWS, EDGE, DELAY, NOISE = 1e-3, 300, 20, 2, 2e-4
INERTIA, DAMPING, FRICTION = 1.1e-4, 7e-5, 0.034
STEPS = np.array([0.05, -0.05, 0.06, -0.07, 0.08, -0.09, 0.1, -0.1, 0.12, -0.12])
SCATTER = (0.0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.13, 0.16, 0.2, 0.25, 0.3)


def recorded(scatter: float, seed: int) -> list[Recording]:
    """Return ten runs of a turning device, whose friction differs from run to run by a share."""
    random, runs = np.random.default_rng(seed), []
    for run, step in enumerate(STEPS):
        coulomb = FRICTION * max(1 + scatter * random.standard_normal(), 0.0)
        motion = FrictionalMotion(Plant(INERTIA, DAMPING, 0.0), Friction(coulomb=coulomb))
        state, seen, sent = motion.rest(np.zeros(1)), np.zeros(ROWS), step * (np.arange(ROWS) >= EDGE)
        for row in range(ROWS):
            seen[row] = state[0, 0] + NOISE * random.standard_normal()
            state = motion.advance(state, sent[[max(row - DELAY, 0)]], 0.0, T)
        runs.append(Recording(str(run), T * np.arange(ROWS), sent, seen, T))
    return runs


def main() -> None:
    """Identify courses of three seeds at each scatter, and draw value and interval."""
    plt.rcParams |= {"svg.hashsalt": "pipeline", "svg.fonttype": "none"}
    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    for seed in range(3):
        told = [identified(recorded(scatter, seed)).parameters["mass"] for scatter in SCATTER]
        value, low, high = (1e4 * np.array([getattr(each, end) for each in told]) for end in ("value", "low", "high"))
        place = 100 * np.array(SCATTER) + 0.3 * (seed - 1)
        axes.errorbar(place, value, [value - low, high - value], fmt="o", markersize=3, label=f"seed {seed}")
        print(seed, np.round(value, 4), np.round(0.5 * (high - low) / value, 4))
    axes.axhline(1e4 * INERTIA, color="black", linewidth=0.8, label="true")
    axes.set_xlabel("scatter of friction from run to run [%]")
    axes.set_ylabel("inertia [1e-4 kg m²], 95 %")
    axes.legend(loc="lower left", fontsize="small", ncols=4, frameon=False)
    figure.savefig(FILE, metadata={"Date": None})


if __name__ == "__main__":
    main()

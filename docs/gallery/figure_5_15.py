"""Optimal by largest stable parameters over delay.

The figure shows stiffness (left) and damping (right) of the optima as a share of the largest stable values, for γ = δ =
0 and whole delay factors. All shares tend to constants. They stay within about 49 % of the stiffness and 61 % of the
damping.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

groups = [("settle_2pct", "overshoot", "pole_radius")]
groups += [[f"energy_{signal}_w{w}" for w in range(3)] for signal in ("step", "impulse")]
delays = range(9)
loops = [pipeline.Loop(1, 0, 1, delay) for delay in delays]
largest = [loop.boundary().attrs for loop in loops]
figure, grid = plt.subplots(3, 2, figsize=(9, 9), layout="constrained")
for row, criteria in zip(grid, groups, strict=True):
    for criterion, style in zip(criteria, ("o-", "s--", "^-."), strict=True):
        optima = [loop.optimum(criterion) for loop in loops]
        for axes, name in zip(row, ("stiffness", "damping"), strict=True):
            share = [getattr(best, name) / top[f"{name}_max"] for best, top in zip(optima, largest, strict=True)]
            axes.plot(
                delays, 100 * np.array(share), style, ms=4, label=f"{criterion}: {100 * share[-1]:.1f} % at d = 8"
            )
    for axes, name in zip(row, ("stiffness", "damping"), strict=True):
        axes.set(xlabel="delay factor d", ylabel=f"optimal by largest {name} [%]", ylim=(-2, 92))
        axes.legend(fontsize=7, loc="upper right")
figure.savefig("figure_5_15.svg")

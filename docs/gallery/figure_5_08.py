"""Overshoot.

The figure shows lines of equal overshoot, every 10 percentage points, for γ = δ = 0. The upper row refers to the
samples, and the lower row to the motion between them. In the shaded region there is no overshoot. This region reaches
up to the plus and over nearly all dampings. Inside it, the curve is its middle. Fig. 5.9 shows both sides of the
largest jump of the solid curve.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

figure, grid = plt.subplots(2, 2, figsize=(9, 7), layout="constrained")
for row, criterion in zip(grid, ("overshoot_discrete", "overshoot"), strict=True):
    for axes, delay in zip(row, (0, 1), strict=True):
        loop = pipeline.Loop(1, 0, 1, delay)
        border, best = loop.boundary(), loop.optimum(criterion)
        percent = 100 * loop.map(121, [criterion]).pivot(index="damping", columns="stiffness", values=criterion)
        lines = axes.contour(
            percent.columns, percent.index, percent, np.arange(10, 100, 10), cmap="viridis", linewidths=0.8
        )
        axes.clabel(lines, lines.levels[:6:2], fmt="%g %%")
        curve = loop.best_damping(np.linspace(0.01, 0.99, 60) * border["stiffness"].max(), criterion)
        free = curve[curve["cost"] == 0]
        axes.plot(border["stiffness"], border["damping"], "k")
        axes.fill_between(free["stiffness"], free["damping_low"], free["damping_high"], color="C5", alpha=0.3)
        axes.plot(curve["stiffness"], curve["damping"], "C0", label="best β for given α")
        axes.plot(best.stiffness, best.damping, "C2+", ms=10, mew=2, label="stiffest without overshoot")
        kind = "sampled" if criterion.endswith("discrete") else "continuous"
        axes.set(title=f"{kind}, d = {delay}: up to α = {best.stiffness:.3f}", xlabel="stiffness α", ylabel="damping β")
grid[0, 0].legend()
figure.savefig("figure_5_08.svg")

"""Settling time into 2 %.

The figure shows lines of equal settling time, five samples apart, for γ = δ = 0. The upper row refers to the samples,
and the lower row to the motion between them. The sampled settling time is an integer. Therefore, its best dampings are
strips (shaded), and its optimum is a region, whose corners are marked. The optimal settling times are 6 and 10 samples
(sampled), and 5.139 and 9.909 samples (continuous). Beyond the optimum, the solid curve jumps wherever an extremum of
the response crosses the band. Fig. 5.6 shows both sides of the first jump.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

figure, grid = plt.subplots(2, 2, figsize=(9, 7), layout="constrained")
for row, criterion in zip(grid, ("settle_2pct_discrete", "settle_2pct"), strict=True):
    for axes, delay in zip(row, (0, 1), strict=True):
        loop = pipeline.Loop(1, 0, 1, delay)
        border, best = loop.boundary(), loop.optimum(criterion)
        time = loop.map(121, [criterion]).pivot(index="damping", columns="stiffness", values=criterion)
        # half a sample aside: sampled costs are whole numbers, on which a line would fray
        levels = 5 * (np.floor(best.cost / 5) + 1 + np.arange(8)) + 0.5 * criterion.endswith("discrete")
        axes.contour(time.columns, time.index, time, levels, cmap="viridis", linewidths=0.8)
        curve = loop.best_damping(np.linspace(0.01, 0.99, 60) * border["stiffness"].max(), criterion)
        reverse = loop.best_stiffness(np.linspace(0.01, 0.99, 20) * border["damping"].max(), criterion)
        axes.plot(border["stiffness"], border["damping"], "k")
        axes.fill_between(curve["stiffness"], curve["damping_low"], curve["damping_high"], color="C5", alpha=0.5)
        axes.plot(curve["stiffness"], curve["damping"], "C0", label="best β for given α")
        axes.plot(reverse["stiffness"], reverse["damping"], "C1--", label="best α for given β")
        low, high, bottom, top = best.box or (best.stiffness, best.stiffness, best.damping, best.damping)
        axes.plot([low, high], [bottom, top], "C2+", ms=10, mew=2, label="optimum")
        kind = "sampled" if criterion.endswith("discrete") else "continuous"
        axes.set(title=f"{kind}, d = {delay}: {best.cost:.4g} samples", xlabel="stiffness α", ylabel="damping β")
grid[0, 0].legend()
figure.savefig("figure_5_04.svg")

"""Largest pole radius.

The figure shows lines of equal radius inside the stable region for γ = δ = 0, the best damping for a given stiffness
(solid), the best stiffness for a given damping (dashed) and the optimum (plus). Below: the radius along the solid
curve. The smallest radius is 0.587 for d = 0 and 0.752 for d = 1. From the origin to this optimum, both curves
coincide.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

figure, grid = plt.subplots(2, 2, figsize=(9, 6), sharex="col", height_ratios=(2, 1), layout="constrained")
for (upper, lower), delay in zip(grid.T, (0, 1), strict=True):
    loop = pipeline.Loop(1, 0, 1, delay)
    border, best = loop.boundary(), loop.optimum("pole_radius")
    radius = loop.map(121, ["pole_radius"]).pivot(index="damping", columns="stiffness", values="pole_radius")
    lines = upper.contour(radius.columns, radius.index, radius, np.arange(0.6, 1, 0.05), cmap="viridis", linewidths=0.8)
    upper.clabel(lines, lines.levels[::2], fmt="%.2f")
    solid = loop.best_damping(np.linspace(0.01, 0.99, 60) * border["stiffness"].max(), "pole_radius")
    dashed = loop.best_stiffness(np.linspace(0.01, 0.99, 60) * border["damping"].max(), "pole_radius")
    upper.plot(border["stiffness"], border["damping"], "k")
    upper.plot(solid["stiffness"], solid["damping"], "C0", label="best β for given α")
    upper.plot(dashed["stiffness"], dashed["damping"], "C1--", label="best α for given β")
    upper.plot(best.stiffness, best.damping, "C2+", ms=10, mew=2, label="optimum")
    lower.plot(solid["stiffness"], solid["cost"], "C0")
    lower.plot(best.stiffness, best.cost, "C2+", ms=10, mew=2)
    upper.set(title=f"d = {delay}: least radius {best.cost:.3f}", ylabel="damping β")
    lower.set(xlabel="stiffness α", ylabel="radius r")
grid[0, 0].legend()
figure.savefig("figure_5_02.svg")

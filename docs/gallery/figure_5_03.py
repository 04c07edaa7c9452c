"""Damping ratio of the poles.

The figure shows lines of equal damping ratio ζ for γ = δ = 0, and curves as in Fig. 5.2. Without delay, no pole
oscillates inside the shaded region. Its stiffest point is marked. With delay, this region does not exist. The best
stiffness then lies on the left boundary, and the optimum is the origin, as a limit.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

figure, grid = plt.subplots(2, 2, figsize=(9, 6), sharex="col", height_ratios=(2, 1), layout="constrained")
for (upper, lower), delay in zip(grid.T, (0, 1), strict=True):
    loop = pipeline.Loop(1, 0, 1, delay)
    border, best = loop.boundary(), loop.optimum("damping")
    ratio = loop.map(121, ["damping"]).pivot(index="damping", columns="stiffness", values="damping_ratio")
    lines = upper.contour(ratio.columns, ratio.index, ratio, np.arange(0.1, 1, 0.1), cmap="viridis", linewidths=0.8)
    upper.clabel(lines, lines.levels[::2], fmt="%.1f")
    solid = loop.best_damping(np.linspace(0.01, 0.99, 60) * border["stiffness"].max(), "damping")
    dashed = loop.best_stiffness(np.linspace(0.01, 0.99, 60) * border["damping"].max(), "damping")
    upper.plot(border["stiffness"], border["damping"], "k")
    upper.plot(solid["stiffness"], solid["damping"], "C0", label="best β for given α")
    upper.plot(dashed["stiffness"], dashed["damping"], "C1--", label="best α for given β")
    upper.plot(best.stiffness, best.damping, "C2+", ms=10, mew=2, label="optimum")
    flat = solid[solid["cost"] == 1]
    upper.fill_between(flat["stiffness"], flat["damping_low"], flat["damping_high"], color="C5", alpha=0.3)
    lower.plot(solid["stiffness"], solid["cost"], "C0")
    lower.plot(best.stiffness, best.cost, "C2+", ms=10, mew=2)
    upper.set(title=f"d = {delay}: largest ratio {best.cost:.3g}", ylabel="damping β")
    lower.set(xlabel="stiffness α", ylabel="ratio ζ")
grid[0, 0].legend()
figure.savefig("figure_5_03.svg")

"""Pole radius against settling time.

The figure shows the optimal curves of the largest pole radius and of the 2 % settling time of the response, for γ = δ =
0. Below: settling times along the solid curves. The settling time of the radius is −4/ln r (5.4). The response settles
fastest with more than twice the stiffness that is optimal for the poles.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

figure, grid = plt.subplots(2, 2, figsize=(9, 6), sharex="col", height_ratios=(2, 1), layout="constrained")
for (upper, lower), delay in zip(grid.T, (0, 1), strict=True):
    loop = pipeline.Loop(1, 0, 1, delay)
    border = loop.boundary()
    upper.plot(border["stiffness"], border["damping"], "k")
    for criterion, name, colour in (("pole_radius", "pole radius", "C1"), ("settle_2pct", "settling time", "C0")):
        solid = loop.best_damping(np.linspace(0.01, 0.99, 60) * border["stiffness"].max(), criterion)
        dashed = loop.best_stiffness(np.linspace(0.01, 0.99, 40) * border["damping"].max(), criterion)
        best = loop.optimum(criterion)
        upper.plot(solid["stiffness"], solid["damping"], colour, label=f"{name}: best β")
        upper.plot(dashed["stiffness"], dashed["damping"], colour + "--", label=f"{name}: best α")
        upper.plot(best.stiffness, best.damping, colour + "+", ms=10, mew=2)
        lower.plot(solid["stiffness"], -4 / np.log(solid["cost"]) if colour == "C1" else solid["cost"], colour)
    upper.set(title=f"d = {delay}", ylabel="damping β")
    lower.set(xlabel="stiffness α", ylabel="settling time / T", ylim=(0, 40 * (delay + 1)))
grid[0, 0].legend()
figure.savefig("figure_5_07.svg")

"""Energy criteria.

The figure shows lines of equal energy cost for the step (upper row) and the impulse (lower row), for the weights w = 0,
1, 2, d = 0 and γ = δ = 0. From the optimum on, there are two lines for each doubling. The curves do not jump, and they
cross in the optimum. Its cost is in the title. For the impulse with w = 0, the best stiffness lies on the left
boundary. With w = 1, the best damping hardly depends on stiffness.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

loop = pipeline.Loop(mass=1, damping=0, sampling_period_s=1, delay_samples=0)
border, share = loop.boundary(), np.linspace(0.01, 0.99, 40)
figure, grid = plt.subplots(2, 3, figsize=(11, 6.5), layout="constrained")
for row, signal in zip(grid, ("step", "impulse"), strict=True):
    for w, axes in enumerate(row):
        criterion = f"energy_{signal}_w{w}"
        best = loop.optimum(criterion)
        cost = loop.map(101, [criterion]).pivot(index="damping", columns="stiffness", values=criterion)
        levels = best.cost * 2 ** (np.arange(1, 11) / 2)
        axes.contour(cost.columns, cost.index, cost, levels, cmap="viridis", linewidths=0.8)
        solid = loop.best_damping(share * border["stiffness"].max(), criterion)
        dashed = loop.best_stiffness(share * border["damping"].max(), criterion)
        axes.plot(border["stiffness"], border["damping"], "k")
        axes.plot(solid["stiffness"], solid["damping"], "C0", label="best β for given α")
        axes.plot(dashed["stiffness"], dashed["damping"], "C1--", label="best α for given β")
        axes.plot(best.stiffness, best.damping, "C2+", ms=10, mew=2, label="optimum")
        axes.set(
            title=f"{signal}, w = {w}: {best.cost:.4g}", xlabel="stiffness α", xlim=(-0.02, 0.72), ylabel="damping β"
        )
grid[0, 0].legend(fontsize=7)
figure.savefig("figure_5_10.svg")

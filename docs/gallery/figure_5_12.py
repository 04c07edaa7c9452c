"""Damping rules of continuous time against optimal curves.

The figure shows the best damping for a given stiffness (solid, with dots at the optima), critical damping β + δ = 2 √(α
+ γ), and β + δ = √(2 (α + γ)) (both dashed), for γ = δ = 0. Up to its optimum, the settling time follows the lower
rule. The energy curves of the step lie between both rules. Critical damping leaves the region without overshoot near
its tip. None of this is true for the impulse.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

groups = [("settle_2pct", "overshoot")]
groups += [[f"energy_{signal}_w{w}" for w in range(3)] for signal in ("step", "impulse")]
figure, grid = plt.subplots(3, 2, figsize=(9, 11), layout="constrained")
for row, criteria in zip(grid, groups, strict=True):
    for axes, delay in zip(row, (0, 1), strict=True):
        loop = pipeline.Loop(1, 0, 1, delay)
        border = loop.boundary()
        alpha = border["stiffness"].max() * np.linspace(0, 1, 81) ** 2
        axes.plot(border["stiffness"], border["damping"], "k")
        axes.plot(alpha, 2 * np.sqrt(alpha), "C1--", lw=1, label="critical damping")
        axes.plot(alpha, np.sqrt(2 * alpha), "C2--", lw=1, label="damping ratio 1/√2")
        for criterion, colour in zip(criteria, ("C0", "C3", "C4"), strict=False):
            curve, best = loop.best_damping(alpha[2:-1:2], criterion), loop.optimum(criterion)
            curve = curve[(curve["cost"] > 0) | (criterion != "overshoot")]  # without any, it is the region's middle
            axes.plot(curve["stiffness"], curve["damping"], colour, label=criterion)
            axes.plot(best.stiffness, best.damping, colour + "o")
        axes.set(
            title=f"d = {delay}", xlabel="stiffness α", ylabel="damping β", ylim=(0, 1.05 * border["damping"].max())
        )
    row[0].legend(fontsize=7, loc="upper right")
figure.savefig("figure_5_12.svg")

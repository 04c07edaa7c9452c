"""Damping rules of continuous time against the optimal curves of the poles.

This figure corresponds to Fig. 5.12 for the largest pole radius and the damping ratio. Neither of them follows one of
the rules beyond the origin.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

groups = [("pole_radius", "damping")]
figure, grid = plt.subplots(1, 2, figsize=(9, 4), layout="constrained", squeeze=False)
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
figure.savefig("figure_5_13.svg")

"""Stability boundaries around the origin.

This is a close-up of Fig. 3.6 with five values of γ, for δ = 0.02 (solid) and δ = 0 (dashed). The stiffness of the
device shifts the left boundary to α = −γ. Its damping shifts the lower boundary by −δ. The lower boundary does not
depend visibly on γ.
"""

import matplotlib.pyplot as plt
import pandas as pd

import pipeline

figure, pair = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axes, delay in zip(pair, (0, 1), strict=True):
    for colour, gamma in enumerate((0, 0.25e-3, 0.5e-3, 0.75e-3, 1e-3)):
        for delta, dash in ((0.02, "-"), (0, "--")):
            loop = pipeline.Loop(1, delta, 1, delay, gamma)
            border = loop.boundary(4000)
            border = pd.concat([border, border[:1]])  # α = −γ closes it
            label = f"γ = {gamma:g}" if delta else None
            axes.plot(border["stiffness"], border["damping"], dash, color=f"C{colour}", label=label)
    axes.set(
        title=f"d = {delay}", xlabel="stiffness α", ylabel="damping β", xlim=(-1.4e-3, 4.2e-3), ylim=(-0.024, 0.012)
    )
    axes.legend(loc="lower right")
figure.savefig("figure_3_07.svg")

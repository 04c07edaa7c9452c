"""Stability boundaries for longer delays.

This figure corresponds to Fig. 3.6 for d = 2 and 4. With more delay, the same γ visibly shifts the whole boundary to
the left, and δ enlarges the region by a larger share.
"""

import matplotlib.pyplot as plt
import pandas as pd

import pipeline

figure, pair = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axes, delay in zip(pair, (2, 4), strict=True):
    for (gamma, delta), dash in zip(
        ((0, 0), (0.001, 0), (0, 0.02), (0.001, 0.02)), ("-", "--", "-.", ":"), strict=True
    ):
        loop = pipeline.Loop(mass=1, damping=delta, sampling_period_s=1, delay_samples=delay, stiffness=gamma)
        border = loop.boundary()
        border = pd.concat([border, border[:1]])  # α = −γ closes it
        axes.plot(border["stiffness"], border["damping"], dash, label=f"γ = {gamma:g}, δ = {delta:g}")
    axes.set(title=f"d = {delay}", xlabel="stiffness α", ylabel="damping β")
    axes.legend()
figure.savefig("figure_3_10.svg")

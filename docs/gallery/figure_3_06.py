"""Stability boundaries at the limits of the parameter range.

Walls inside a curve are stable. With a mass of 1 kg and a sampling period of 1 s, K and B equal the normalised α and β.
With one sample of delay, the largest stiffness falls to 21 %. Damping of the device (δ) makes the region wider. The
effect of its stiffness (γ) is hardly visible here.
"""

import matplotlib.pyplot as plt
import pandas as pd

import pipeline

figure, pair = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axes, delay in zip(pair, (0, 1), strict=True):
    for (gamma, delta), dash in zip(
        ((0, 0), (0.001, 0), (0, 0.02), (0.001, 0.02)), ("-", "--", "-.", ":"), strict=True
    ):
        loop = pipeline.Loop(mass=1, damping=delta, sampling_period_s=1, delay_samples=delay, stiffness=gamma)
        border = loop.boundary()
        border = pd.concat([border, border[:1]])  # α = −γ closes it
        axes.plot(border["stiffness"], border["damping"], dash, label=f"γ = {gamma:g}, δ = {delta:g}")
    axes.set(title=f"d = {delay}", xlabel="stiffness α", ylabel="damping β")
    axes.legend()
figure.savefig("figure_3_06.svg")

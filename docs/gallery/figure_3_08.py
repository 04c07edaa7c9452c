"""Stability boundaries over delay.

The figure shows seven delay factors for γ = 0.001 and δ = 0.02. With delay, the stable region shrinks towards the
origin. The dash-dotted line connects the stiffest stable walls of all delays.
"""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import pipeline


def boundary(delay):
    return pipeline.Loop(1, 0.02, 1, delay, 0.001).boundary()


figure, axes = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
for delay in (0, 0.25, 0.5, 1, 2, 4, 8):
    border = boundary(delay)
    border = pd.concat([border, border[:1]])  # α = −γ closes it
    axes.plot(border["stiffness"], border["damping"], label=f"d = {delay:g}")
ridge = [boundary(delay).attrs for delay in 8 * np.linspace(0, 1, 41) ** 2]
stiffest = [at["stiffness_max"] for at in ridge], [at["damping_at_stiffness_max"] for at in ridge]
axes.plot(*stiffest, "k-.", lw=1, label="largest stiffness")
axes.set(xlabel="stiffness α", ylabel="damping β")
axes.legend()
figure.savefig("figure_3_08.svg")

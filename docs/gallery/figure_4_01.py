"""Passive regions over delay.

The regions are in units of the device's damping b and of the sampling period T (here 1 Ns/m and 1 s). In these units,
they do not depend on mass or stiffness. The regions of whole delays end at (0, 1) and (0, −1). Their lower parts are
straight, K < (b + B)/((1/2 + d) T). The dash-dotted line connects the stiffest passive walls of all delays. For d =
0.25 and 0.5, the figure shows the exact region. Equation (4.8) of the thesis omits frequencies above half the sampling
rate, so its region ends at B = b for these delays, too.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline


def passive(delay):
    return pipeline.Loop(mass=1, damping=1, sampling_period_s=1, delay_samples=delay).passive()


figure, axes = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
for delay in (0, 0.25, 0.5, 1, 2, 4, 8):
    border = passive(delay)
    axes.plot(border["stiffness"], border["damping"], label=f"d = {delay:g}")
ridge = [passive(delay).attrs for delay in 8 * np.linspace(0, 1, 41) ** 2]
stiffest = [at["stiffness_max"] for at in ridge], [at["damping_at_stiffness_max"] for at in ridge]
axes.plot(*stiffest, "k-.", lw=1, label="largest stiffness")
axes.set(xlabel="K T / b", ylabel="B / b")
axes.legend()
figure.savefig("figure_4_01.svg")

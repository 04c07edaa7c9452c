"""Passive inside stable regions.

The figure shows the stable regions (red) and the passive regions (green, dashed) for γ = 0.001, δ = 0.02 and d = 0,
0.25, 0.5, 1, 2, 4 and 8, from the outermost inwards. The second plot is a close-up of the origin. For each delay, the
passive region lies inside the stable region and is much smaller.
"""

import matplotlib.pyplot as plt
import pandas as pd

import pipeline

figure, (whole, close) = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
for axes in (whole, close):
    for delay in (0, 0.25, 0.5, 1, 2, 4, 8):
        loop = pipeline.Loop(mass=1, damping=0.02, sampling_period_s=1, delay_samples=delay, stiffness=0.001)
        stable, passive = loop.boundary(2000), loop.passive()
        stable = pd.concat([stable, stable[:1]])  # α = −γ closes it
        axes.plot(stable["stiffness"], stable["damping"], "C1-", label=None if delay else "stable")
        axes.plot(passive["stiffness"], passive["damping"], "C2--", label=None if delay else "passive")
    axes.set(xlabel="stiffness α", ylabel="damping β")
whole.set_title("whole")
close.set(title="around the origin", xlim=(-0.002, 0.044), ylim=(-0.024, 0.05))
whole.legend()
figure.savefig("figure_4_03.svg")

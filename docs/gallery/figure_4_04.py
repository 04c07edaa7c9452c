"""Largest passive and stable stiffness over delay.

All plots are for δ = 0.02. Left: the stiffest stable wall is 17.8 times as stiff as the stiffest passive wall for d =
0, and 9.3 times for d = 1. Middle and right: the ratio η of the passive to the stable stiffness over two ranges of
delay. The ratio grows to 1 at d = 40 (γ = 0.001) and d = 120 (γ = 0), where passivity requires no more than stability.
Beyond this delay, it falls again.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

figure, (both, near, far) = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
for axes, delays in ((near, np.arange(0, 9)), (far, np.r_[0:44:2, 44:133:8])):
    for gamma, dash in ((0, "-"), (0.001, "--")):
        shown = delays if gamma == 0 else delays[delays <= 56]
        loops = [pipeline.Loop(1, 0.02, 1, int(delay), gamma) for delay in shown]
        stable = np.array([loop.boundary(8).attrs["stiffness_max"] for loop in loops])
        passive = 2 * 0.02 * np.tan(np.pi / (4 * (shown + 1)))  # (4.11), which Loop.passive() has up to d = 96
        axes.plot(shown, passive / stable, "C0" + dash, label=f"γ = {gamma:g}")
        if axes is near:
            both.plot(shown, stable, "C1" + dash, marker=".", label=f"stable, γ = {gamma:g}")
    axes.set(xlabel="delay factor d", ylabel="η, passive by stable", xlim=(0, delays[-1]), ylim=0)
    axes.legend()
delays = np.arange(0, 9)
passive = [pipeline.Loop(1, 0.02, 1, delay).passive().attrs["stiffness_max"] for delay in delays]
both.plot(delays, passive, "C2.-", label="passive")
both.set(xlabel="delay factor d", ylabel="largest α", xlim=(0, 8), ylim=0)
both.legend()
figure.savefig("figure_4_04.svg")

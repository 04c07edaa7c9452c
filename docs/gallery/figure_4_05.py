"""Stability boundaries for springs up to the Nyquist frequency.

The figure shows boundaries for 21 values of γ, evenly spaced from 0 to 0.999 (π² + δ²/4). Each row is for one delay.
Left: the whole boundaries for δ = 0.02. Middle: their close-up around the origin, with the passive region shaded.
Right: the same close-up for δ = 0. The part around the origin that no line cuts off is stable with every spring. It
contains the whole passive region, and vanishes for δ = 0.
"""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import pipeline

delays = (0, 0.5, 1, 2, 4, 8)
figure, grid = plt.subplots(len(delays), 3, figsize=(10, 16), layout="constrained")
for (whole, close, undamped), delay in zip(grid, delays, strict=True):
    passive = pipeline.Loop(1, 0.02, 1, delay).passive()
    top = passive.attrs["stiffness_max"]
    close.fill(passive["stiffness"], passive["damping"], "C2", alpha=0.3)
    for delta, shown in ((0.02, (whole, close)), (0, (undamped,))):
        for gamma in (np.pi**2 + delta**2 / 4) * np.linspace(0, 1, 21) * 0.999:
            border = pipeline.Loop(1, delta, 1, delay, gamma).boundary(300)
            if not border["damping"].hasnans:  # of a region in one piece
                border = pd.concat([border, border[:1]])  # α = −γ closes it
            for axes in shown:
                axes.plot(border["stiffness"], border["damping"], "C1", lw=0.6)
        for axes in shown:
            axes.set(title=f"d = {delay:g}, δ = {delta:g}", xlabel="stiffness α", ylabel="damping β")
    for axes in (close, undamped):
        axes.set(xlim=(-0.6 * top, 2.2 * top), ylim=(-0.034, 0.052))
figure.savefig("figure_4_05.svg")

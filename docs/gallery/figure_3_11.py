"""Linear condition against the exact boundary.

The figure compares the exact boundaries (solid) with β + δ = α (1/2 + d) (dashed), for γ = 0.001 and δ = 0, 0.005,
0.01, 0.015 and 0.02, from top to bottom. Marks show where the stiffness of the linear condition has an error of 0, 2
and 5 % (3.28). Above the circles, the linear condition predicts that unstable walls are stable.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

gamma = 0.001
figure, pair = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axes, delay in zip(pair, (0, 1), strict=True):
    for delta in (0, 0.005, 0.01, 0.015, 0.02):
        border = pipeline.Loop(1, delta, 1, delay, gamma).boundary(2000)
        lower = border[: border["stiffness"].argmax()].query("stiffness > -0.0009")
        alpha, beta = lower["stiffness"].to_numpy(), lower["damping"].to_numpy()
        linear = (beta + delta) / (0.5 + delay)
        axes.plot(alpha, beta, "k", label=None if delta else "exact")
        axes.plot(linear, beta, "--", color="C3", lw=1, label=None if delta else "linear")
        error = (linear - alpha) / (alpha + gamma)
        for level, mark in ((0, "C0o"), (0.02, "C2^"), (0.05, "C1s")):
            beyond = np.abs(error) > level if level else error > 0
            at = np.flatnonzero(beyond[1:] != beyond[:-1])
            axes.plot(alpha[at], beta[at], mark, ms=5, label=None if delta else f"off by {100 * level:g} %")
    axes.set(title=f"d = {delay}", xlabel="stiffness α", ylabel="damping β")
    axes.set(xlim=(-0.01, 0.11) if delay else (-0.02, 0.36), ylim=(-0.025, 0.15) if delay else (-0.025, 0.2))
    axes.legend()
figure.savefig("figure_3_11.svg")

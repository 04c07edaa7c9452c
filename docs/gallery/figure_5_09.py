"""Step responses on both sides of the largest jump of the overshoot.

The responses are for d = 0 and γ = δ = 0. Both overshoot by the same share, but with different maxima. For this jump,
the thesis gives α = 0.3044 and 1.48 %. Right: close-up.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

loop = pipeline.Loop(mass=1, damping=0, sampling_period_s=1, delay_samples=0)
start, end = loop.optimum("overshoot").stiffness, loop.boundary().attrs["stiffness_max"]
low, high = start + (end - start) * np.array([0.02, 0.85])
for _ in range(6):
    curve = loop.best_damping(np.linspace(low, high, 33), "overshoot")
    jump = np.abs(np.diff(curve["damping"])).argmax()
    before, behind = curve.iloc[jump], curve.iloc[jump + 1]
    low, high = before["stiffness"], behind["stiffness"]

figure, pair = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for axes, title, ends in zip(pair, ("whole", "close-up"), ((0, 1.15), (0.96, 1.03)), strict=True):
    for side, name in ((before, "before"), (behind, "behind")):
        motion = loop.response(low, side["damping"], samples=30)
        axes.plot(motion["time_s"], motion["position"] * low, label=f"{name}: β = {side['damping']:.3f}")
    axes.axhline(1 + before["cost"], color="C2", ls="--", label=f"overshoot {100 * before['cost']:.2f} %")
    axes.set(title=f"{title}, α = {low:.5f}", xlabel="time / T", ylabel="position by the final one", ylim=ends)
pair[0].legend()
figure.savefig("figure_5_09.svg")

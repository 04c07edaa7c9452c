"""Step responses on both sides of the first jump of the settling time.

The responses are for d = 0 and γ = δ = 0. Just before the jump (blue), an extremum touches the band. For a slightly
stiffer wall, no damping keeps this extremum inside the band. The best response is then another one (red), of which a
later extremum touches the band. The jump is located by repeated refinement of the curve of best damping (Fig. 5.4).
Right: close-up.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

loop = pipeline.Loop(mass=1, damping=0, sampling_period_s=1, delay_samples=0)
start, end = loop.optimum("settle_2pct").stiffness, loop.boundary().attrs["stiffness_max"]
low, high = start + (end - start) * np.array([0.02, 0.85])
for _ in range(6):
    curve = loop.best_damping(np.linspace(low, high, 33), "settle_2pct")
    jump = np.abs(np.diff(curve["damping"])).argmax()  # the first one is the largest
    before, behind = curve.iloc[jump], curve.iloc[jump + 1]
    low, high = before["stiffness"], behind["stiffness"]

figure, pair = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for axes, title, ends in zip(pair, ("whole", "close-up"), ((0, 1.25), (0.96, 1.04)), strict=True):
    for side, name in ((before, "before"), (behind, "behind")):
        motion = loop.response(low, side["damping"], samples=30)
        axes.plot(motion["time_s"], motion["position"] * low, label=f"{name}: β = {side['damping']:.3f}")
    axes.axhspan(0.98, 1.02, color="C2", alpha=0.15, label="2 % band")
    axes.set(title=f"{title}, α = {low:.5f}", xlabel="time / T", ylabel="position by the final one", ylim=ends)
pair[0].legend()
figure.savefig("figure_5_06.svg")

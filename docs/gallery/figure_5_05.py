"""Step response of the shortest settling time.

The response is for d = 0 and γ = δ = 0. It enters the 2 % band. It then touches the upper edge of the band at its
largest maximum, and the lower edge at a minimum (circles). Right: close-up around the final position.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

loop = pipeline.Loop(mass=1, damping=0, sampling_period_s=1, delay_samples=0)
best = loop.optimum("settle_2pct")
motion = loop.response(best.stiffness, best.damping, samples=20, per_sample=64)
time, share = motion["time_s"].to_numpy(), motion["position"].to_numpy() * best.stiffness
turns = np.flatnonzero(np.diff(np.sign(np.diff(share)))) + 1
touches = turns[np.abs(np.abs(share[turns] - 1) - 0.02) < 1e-3]

figure, pair = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for axes, title, ends in zip(pair, ("whole", "close-up"), ((0, 1.15), (0.96, 1.04)), strict=True):
    axes.plot(time, share, label="continuous")
    axes.plot(time[::64], share[::64], "k.--", lw=0.8, label="samples")
    axes.plot(time[touches], share[touches], "C1o", mfc="none", label="touches the band")
    axes.axhspan(0.98, 1.02, color="C2", alpha=0.15, label="2 % band")
    axes.axvline(best.cost, color="C2", ls=":", label=f"settles at {best.cost:.3f} T")
    axes.set(title=title, xlabel="time / T", ylabel="position by the final one", ylim=ends)
pair[0].legend()
figure.suptitle(f"α = {best.stiffness:.5f}, β = {best.damping:.5f}")
figure.savefig("figure_5_05.svg")

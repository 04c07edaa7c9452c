"""Optimal costs over delay, and their polynomial approximation.

Left: costs in the optima for γ = δ = 0. The settling time of the pole radius is −4/ln r (5.4), and energies are
relative to those at d = 8. Right: relative error of the approximation by (d + 1)^(w+1), which is scaled to be exact at
d = 8 (5.19, 5.20). From d = 2 on, the error is less than 1.2 %. As in the thesis, overshoot is omitted, because its
optimal cost is 0 for each delay.
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

groups = [("settle_2pct", "pole_radius")]
groups += [[f"energy_{signal}_w{w}" for w in range(3)] for signal in ("step", "impulse")]
delays = np.arange(9)
figure, grid = plt.subplots(3, 2, figsize=(9, 9), layout="constrained")
for (left, right), criteria in zip(grid, groups, strict=True):
    for criterion, style in zip(criteria, ("o-", "s--", "^-."), strict=False):
        cost = np.array([pipeline.Loop(1, 0, 1, delay).optimum(criterion).cost for delay in delays.tolist()])
        cost = -4 / np.log(cost) if criterion == "pole_radius" else cost
        power = int(criterion[-1]) + 1 if "energy" in criterion else 1
        error = (delays + 1) ** power * cost[-1] / 9**power / cost - 1
        left.plot(delays, cost / cost[-1] if "energy" in criterion else cost, style, ms=4, label=criterion)
        right.plot(delays, 100 * error, style, ms=4, label=criterion)
    left.set(xlabel="delay factor d", ylabel="cost by that at d = 8" if "energy" in criterion else "settling time / T")
    right.set(xlabel="delay factor d", ylabel="error of (5.19) [%]")
    left.legend(fontsize=7)
figure.savefig("figure_5_16.svg")

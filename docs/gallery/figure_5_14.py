"""Optima of all criteria.

The optima are for γ = δ = 0. Number 1 is the pole radius, 2 the overshoot and 3 the settling time. Numbers 4 to 6 are
the energy of the step with w = 0, 1, 2, and numbers 7 to 9 the energy of the impulse. The Ziegler-Nichols point is near
number 5 without delay, and near number 6 with delay.
"""

import matplotlib.pyplot as plt

import pipeline

criteria = ["pole_radius", "overshoot", "settle_2pct"]
criteria += [f"energy_{signal}_w{w}" for signal in ("step", "impulse") for w in range(3)]
beside = {5: (9, -3), 6: (9, -7), 3: (8, -4), 2: (-8, 6)}
figure, row = plt.subplots(1, 3, figsize=(11, 4), layout="constrained")
for axes, delay in zip(row, (0, 1, 2), strict=True):
    loop = pipeline.Loop(1, 0, 1, delay)
    border, rule = loop.boundary(), loop.optimum("ziegler_nichols")
    axes.plot(border["stiffness"], border["damping"], "k")
    for number, criterion in enumerate(criteria, start=1):
        best = loop.optimum(criterion)
        axes.plot(best.stiffness, best.damping, "C0.")
        place = beside.get(number, (5, 4))
        axes.annotate(str(number), (best.stiffness, best.damping), place, textcoords="offset points", ha="center")
    axes.plot(rule.stiffness, rule.damping, "C1+", ms=10, mew=2, label="Ziegler-Nichols")
    axes.set(title=f"d = {delay}", xlabel="stiffness α", ylabel="damping β")
row[0].legend()
figure.savefig("figure_5_14.svg")

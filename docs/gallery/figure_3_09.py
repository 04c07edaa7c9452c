"""Largest stable stiffness and damping over delay.

The curves are for the limits of γ and δ. From d = 0 to d = 1, the largest stiffness falls to 21 %, and at d = 2 it is
below 10 %. The largest damping falls to 41 % and 27 %. The numbers are in Tables B.1 to B.4 (`pipeline theory tables`).
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

delays = np.linspace(0, 8, 49)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for (gamma, delta), dash in zip(((0, 0), (0.001, 0), (0, 0.02), (0.001, 0.02)), ("-", "--", "-.", ":"), strict=True):
    ends = [pipeline.Loop(1, delta, 1, delay, gamma).boundary(8).attrs for delay in delays]
    left.plot(delays, [end["stiffness_max"] for end in ends], dash, label=f"γ = {gamma:g}, δ = {delta:g}")
    right.plot(delays, [end["damping_max"] for end in ends], dash, label=f"γ = {gamma:g}, δ = {delta:g}")
left.set(xlabel="delay factor d", ylabel="largest stable stiffness α", ylim=0, xlim=(0, 8))
right.set(xlabel="delay factor d", ylabel="largest stable damping β", ylim=0, xlim=(0, 8))
right.legend()
figure.savefig("figure_3_09.svg")

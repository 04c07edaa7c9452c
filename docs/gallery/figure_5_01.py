"""Regions of poles.

Left: poles inside a circle correspond to a settling time of at most the number of samples written on the circle, r =
exp(−4/n) (5.4). Right: on each spiral, a pole has the damping ratio written on the spiral (5.5). The numbers are
examples.
"""

import matplotlib.pyplot as plt
import numpy as np

figure, (circles, spirals) = plt.subplots(1, 2, figsize=(8.5, 4.2), layout="constrained")
turn, half = np.linspace(-np.pi, np.pi, 181), np.linspace(0, np.pi, 121)
for samples in (2, 3, 4, 6, 10, 20, 60):
    radius = np.exp(-4 / samples)
    circles.plot(radius * np.cos(turn), radius * np.sin(turn), "C0", lw=1)
    circles.annotate(str(samples), (0, radius), ha="center", va="top")
for ratio in np.arange(1, 10) / 10:
    # ln z = w (−ζ + j √(1 − ζ²)): the angle grows with w, the logarithm of the radius in proportion
    z = np.exp(half * (1j - ratio / np.sqrt(1 - ratio**2)))
    spirals.plot(np.append(z.real, z.real[::-1]), np.append(z.imag, -z.imag[::-1]), "C1", lw=1)
    spirals.annotate(f"{ratio:g}", (z.real[60], z.imag[60]), ha="center", va="top", fontsize=7)
for axes, title in ((circles, "settling time / T"), (spirals, "damping ratio ζ")):
    axes.plot(np.cos(turn), np.sin(turn), "k")
    axes.set(title=title, xlabel="Re z", ylabel="Im z", aspect="equal", xticks=(-1, -0.5, 0, 0.5, 1))
figure.savefig("figure_5_01.svg")

"""Largest passive stiffness over delay.

The largest passive stiffness falls to 41 % of its value without delay at d = 1, and to 27 % at d = 2. For whole delays
(dots), it is 2 tan(π/(4 (d + 1))) (4.11). Between them, the exact passive walls (solid) are up to 2 % stiffer than
(4.11) (dashed).
"""

import matplotlib.pyplot as plt
import numpy as np

import pipeline

delays = np.linspace(0, 8, 65)
largest = np.array([pipeline.Loop(1, 1, 1, delay).passive().attrs["stiffness_max"] for delay in delays])

figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
axes.plot(delays, largest, color="C2", label="exact")
axes.plot(delays, 2 * np.tan(np.pi / (4 * (delays + 1))), "k--", lw=1, label="(4.11)")
axes.plot(delays[::8], largest[::8], "C2o")
axes.set(xlabel="delay factor d", ylabel="largest passive K T / b", xlim=(-0.1, 8.1), ylim=(0, 2.1))
axes.legend()
figure.savefig("figure_4_02.svg")

"""Responses in the optima of the energy criteria.

The figure shows step responses (left) and impulse responses (right) in the optima of Fig. 5.10, for d = 0 and γ = δ =
0. The upper row shows the optima for the step, and the lower row those for the impulse. With a larger weight w, the
response settles faster. The optimum for the impulse with w = 0 has no stiffness, so its step response does not come to
rest.
"""

import matplotlib.pyplot as plt

import pipeline

loop = pipeline.Loop(mass=1, damping=0, sampling_period_s=1, delay_samples=0)
figure, grid = plt.subplots(2, 2, figsize=(9, 6), layout="constrained")
for row, judged in zip(grid, ("step", "impulse"), strict=True):
    for axes, shown in zip(row, ("step", "impulse"), strict=True):
        for w, dash in enumerate(("-", "--", "-.")):
            best = loop.optimum(f"energy_{judged}_w{w}")
            motion = loop.response(best.stiffness, best.damping, samples=16, signal=shown)
            axes.plot(motion["time_s"], motion["position"], dash, label=f"w = {w}")
        axes.set(title=f"optima for the {judged}: {shown} response", xlabel="time / T", ylabel="position χ")
grid[0, 0].legend()
figure.savefig("figure_5_11.svg")

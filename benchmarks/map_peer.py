"""The map of `pipeline theory map` as one would write it in plain numpy, for comparison: a whole process.

Stable points by the eigenvalues of all loop matrices, then the recurrence of the stable ones for a fixed number of
steps with settling time, overshoot and energies of the sampled response. Double integrator, integer delay, step
response. What it leaves out: motion between samples, and whatever happens after its last step.

    OPENBLAS_NUM_THREADS=1 python benchmarks/map_peer.py --delay 4 --box 0 0.05 0 0.25 --out peer.npz
"""

from __future__ import annotations

import argparse

import numpy as np


def cost_map(delay: int, box: tuple[float, float, float, float], size: int, steps: int) -> dict[str, np.ndarray]:
    """Return alpha, beta, stable and five costs of a grid over a box (alpha low, high, beta low, high)."""
    alpha, beta = (g.ravel() for g in np.meshgrid(np.linspace(*box[:2], size), np.linspace(*box[2:], size)))
    states = delay + 3
    matrices = np.zeros((alpha.size, states, states))
    matrices[:, 0, :2] = 1.0
    matrices[:, 1, 1] = 1.0
    now, before = (0, 2) if delay == 0 else (delay + 1, delay + 2)
    for row, gain in ((0, 0.5), (1, 1.0)):
        matrices[:, row, now] += -gain * (alpha + beta)
        matrices[:, row, before] += gain * beta
    matrices[:, 2, 0] = 1.0
    for i in range(3, states):
        matrices[:, i, i - 1] = 1.0
    stable = (np.abs(np.linalg.eigvals(matrices)).max(axis=1) < 1) & (alpha > 0)

    a, b = alpha[stable], beta[stable]
    e, v = np.full(a.size, -1.0), np.zeros(a.size)
    last = e
    forces = [a] * (delay + 1)
    settle, overshoot = np.zeros(a.size), np.zeros(a.size)
    energy = np.zeros((3, a.size))
    for k in range(steps):
        density = e * e + (e - last) ** 2 / a
        energy[0] += density
        energy[1] += k * density
        energy[2] += k * k * density
        settle[np.abs(e) > 0.02] = k + 1
        np.maximum(overshoot, e, out=overshoot)
        forces = [b * last - (a + b) * e, *forces[:-1]]
        u, last = forces[delay], e
        e, v = e + v + 0.5 * u, v + u
    costs = {"settle": settle, "overshoot": overshoot, "w0": energy[0], "w1": energy[1], "w2": energy[2]}
    result = {"alpha": alpha, "beta": beta, "stable": stable}
    for name, values in costs.items():
        result[name] = np.full(alpha.size, np.nan)
        result[name][stable] = values
    return result


def main() -> None:
    """Write the map of the command line's box."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--delay", type=int, required=True)
    parser.add_argument("--box", type=float, nargs=4, required=True, help="alpha low, high, beta low, high")
    parser.add_argument("--size", type=int, default=251)
    parser.add_argument("--steps", type=int, default=512)
    parser.add_argument("--out", required=True)
    given = parser.parse_args()
    np.savez(given.out, **cost_map(given.delay, tuple(given.box), given.size, given.steps))


if __name__ == "__main__":
    main()

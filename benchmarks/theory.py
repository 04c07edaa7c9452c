"""Speed of the theory beside what a user would write instead, each pair in the same process; prints ratios.

    python benchmarks/theory.py [name ...]

A comparison is a function that returns a `Row` and stands in `COMPARISONS`. Nothing here fails on a slow machine.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from pipeline.loop import Loop
from pipeline.region import is_inside, region, stiffness_limit
from pipeline.stability import boundary, spectral_radius
from pipeline.theory_map import bounding_box

REPEATS = 5

ENDED = 64
"""Points that settle into 2 % before this sample: what the peer leaves out after 512 is then below rounding."""


@dataclass(frozen=True)
class Row:
    """One comparison: seconds of the other method and of ours, the ratio wanted, and the largest difference seen."""

    name: str
    other_s: float
    ours_s: float
    wanted: float
    difference: float

    @property
    def ratio(self) -> float:
        return self.other_s / self.ours_s


def fastest(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the smallest of several run times [s], after one run to warm up."""
    work()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def bisected_limits(loop: Loop, beta: np.ndarray, largest: float, tolerance: float) -> np.ndarray:
    """Return the stability limit of alpha at each beta: batched eigenvalues and bisection between 0 and ``largest``."""
    low, high = np.zeros(len(beta)), np.full(len(beta), largest)
    while high[0] - low[0] > tolerance:
        middle = 0.5 * (low + high)
        stable = spectral_radius(loop, middle, beta) < 1
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return 0.5 * (low + high)


def boundary_of_five_delays() -> Row:
    """251 values of beta for d = 0, 1, 2, 4, 8: bisection to 1e-8 and the closed form, nothing kept between runs."""
    cases = []
    for d in (0, 1, 2, 4, 8):
        border = boundary(Loop(0.0, 0.0, d))
        cases.append((Loop(0.0, 0.0, d), np.linspace(0.001, 0.999, 251) * border.beta_max, 1.5 * border.alpha_max))

    def other() -> list[np.ndarray]:
        return [bisected_limits(loop, beta, top, 1e-8) for loop, beta, top in cases]

    def ours() -> list[np.ndarray]:
        region.cache_clear()
        return [stiffness_limit(Loop(0.0, 0.0, loop.delay), beta) for loop, beta, _ in cases]

    difference = max(float(np.abs(a - b).max()) for a, b in zip(other(), ours(), strict=True))
    return Row("boundary, five delays", fastest(other, 2), fastest(ours), 50, difference)


def verdicts_of_a_map() -> Row:
    """251 x 251 verdicts in the bounding box of the stable region, d = 4: batched eigenvalues and the region."""
    border = boundary(Loop(0.0, 0.0, 4))
    alpha, beta = (
        grid.ravel()
        for grid in np.meshgrid(np.linspace(0, border.alpha_max, 251), np.linspace(0, border.beta_max, 251))
    )

    def other() -> np.ndarray:
        return (spectral_radius(Loop(0.0, 0.0, 4), alpha, beta) < 1) & (alpha > 0)

    def ours() -> np.ndarray:
        region.cache_clear()
        return is_inside(Loop(0.0, 0.0, 4), alpha, beta)

    difference = float(np.count_nonzero(other() != ours()))
    return Row("verdicts of a map, d = 4", fastest(other, 2), fastest(ours), 10, difference)


def map_as_a_process() -> Row:
    """251 x 251 map, d = 4, whole processes on one core: eigenvalue mask and 512 sampled steps, and `theory map`.

    Ours follows the motion between samples without a horizon; the peer samples 512 steps. The difference is that of the
    sampled energies, w = 0, over points of which the peer's sum has ended.
    """
    box = bounding_box(Loop(0.0, 0.0, 4))
    energy = "energy_step_w0_discrete"
    with tempfile.TemporaryDirectory() as folder:
        peer, table = Path(folder) / "peer.npz", Path(folder) / "map.parquet"
        peer_script = Path(__file__).with_name("map_peer.py")
        other = [sys.executable, str(peer_script), "--delay", "4", "--box", *map(repr, box), "--out", str(peer)]
        ours = [sys.executable, "-m", "pipeline", "theory", "map", "--delay", "4", "--out", str(table)]
        times = [fastest(partial(run, command), 3) for command in (other, ours)]
        run([*ours, "--criteria", energy])
        found = pq.read_table(table).column(energy).to_numpy()
        with np.load(peer) as arrays:
            theirs, ended = arrays["w0"], arrays["settle"] < ENDED
    difference = float(np.nanmax(np.abs(found[ended] / theirs[ended] - 1)))
    return Row("map 251 x 251, d = 4, process", times[0], times[1], 1 / 0.7, difference)


def run(command: list[str]) -> None:
    """Run a command on one core, its output thrown away."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


COMPARISONS: list[Callable[[], Row]] = [boundary_of_five_delays, verdicts_of_a_map, map_as_a_process]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="functions to run; all without any")
    names = parser.parse_args().names
    print(f"{'comparison':32} {'other [ms]':>11} {'ours [ms]':>11} {'ratio':>8} {'wanted':>8} {'difference':>11}")
    for comparison in COMPARISONS:
        if names and comparison.__name__ not in names:
            continue
        row = comparison()
        times = f"{1e3 * row.other_s:11.2f} {1e3 * row.ours_s:11.2f} {row.ratio:8.1f} {row.wanted:8.1f}"
        print(f"{row.name:32} {times} {row.difference:11.1e}")


if __name__ == "__main__":
    main()

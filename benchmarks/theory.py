"""Speed of the theory beside what a user would write instead, as ratios; then what it has to reach by itself.

    python benchmarks/theory.py

Times are those of the processor, of both in turn. The peer of the maps computes settling time, overshoot and energies
of the samples only, over 512 of them; ours computes them of the motion between samples, to its end. Limits of accuracy
are tests (docs/verification.md). Nothing fails on a slow machine.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from timing import fastest, run

from pipeline.loop import normalised_loop
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory import crossings
from pipeline.theory.boundary import boundary, stiffness_limit
from pipeline.theory.costs import bounding_box

ENDED = 64
"""Points that settle into 2 % before this sample: what the peer leaves out after 512 is then below rounding."""


CACHES = [
    cached
    for module in (normalised_loop, crossings)
    for cached in vars(module).values()
    if hasattr(cached, "cache_clear") and cached.__name__ not in ("binomial", "_bernstein")
]
"""What the boundary of a loop is computed from, without constants that do not depend on a loop."""


@dataclass(frozen=True)
class Row:
    """One comparison: seconds of the other method and of ours, the ratio wanted, and the largest difference seen."""

    name: str
    other_s: float
    ours_s: float
    wanted: float
    difference: float


def bisected_limits(loop: NormalisedLoop, beta: np.ndarray, largest: float, tolerance: float) -> np.ndarray:
    """Return the stability limit of alpha at each beta: batched eigenvalues and bisection between 0 and ``largest``."""
    low, high = np.zeros(len(beta)), np.full(len(beta), largest)
    while high[0] - low[0] > tolerance:
        middle = 0.5 * (low + high)
        stable = np.abs(np.linalg.eigvals(loop.matrix(middle, beta))).max(axis=1) < 1
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return 0.5 * (low + high)


def boundary_of_five_delays() -> Row:
    """251 values of beta for d = 0, 1, 2, 4, 8: bisection to 1e-8 and the closed form, nothing kept between runs."""
    cases = []
    for d in (0, 1, 2, 4, 8):
        border = boundary(NormalisedLoop.ideal(0.0, 0.0, d))
        damping = np.linspace(0.001, 0.999, 251) * border.beta_max
        cases.append((NormalisedLoop.ideal(0.0, 0.0, d), damping, 1.5 * border.alpha_max))

    def other() -> list[np.ndarray]:
        return [bisected_limits(loop, beta, top, 1e-8) for loop, beta, top in cases]

    def ours() -> list[np.ndarray]:
        for known in CACHES:
            known.cache_clear()
        return [stiffness_limit(NormalisedLoop.ideal(0.0, 0.0, loop.delay), beta) for loop, beta, _ in cases]

    difference = max(float(np.abs(a - b).max()) for a, b in zip(other(), ours(), strict=True))
    return Row("boundary, five delays", fastest(other, 2), fastest(ours), 60, difference)


def map_as_a_process(size: int, wanted: float, repeats: int) -> Row:
    """A map, d = 4, whole processes on one core in turn: eigenvalue mask and 512 sampled steps, and `theory map`.

    The difference is that of the sampled energies, w = 0, over points of which the peer's sum has ended.
    """
    box = bounding_box(NormalisedLoop.ideal(0.0, 0.0, 4))
    energy = "energy_step_w0_discrete"
    with tempfile.TemporaryDirectory() as folder:
        peer, table = Path(folder) / "peer.npz", Path(folder) / "map.parquet"
        grid = ["--delay", "4", "--size", str(size)]
        peer_script = Path(__file__).with_name("map_peer.py")
        other = [sys.executable, str(peer_script), *grid, "--box", *map(repr, box), "--out", str(peer)]
        ours = [sys.executable, "-m", "pipeline", "theory", "map", *grid, "--out", str(table)]
        run(ours)  # compiles once
        times = np.array([[run(command).processor for command in (other, ours)] for _ in range(repeats)]).min(axis=0)
        run([*ours, "--criteria", energy])
        found = pq.read_table(table).column(energy).to_numpy()
        with np.load(peer) as arrays:
            theirs, ended = arrays["w0"], arrays["settle"] < ENDED
    difference = float(np.nanmax(np.abs(found[ended] / theirs[ended] - 1)))
    return Row(f"map {size} x {size}, d = 4, process", times[0], times[1], 1 / wanted, difference)


TABLES_C = """
from pipeline.studies.thesis_tables import recomputed_tables
rows = sum(len(list(found)) for _, _, found in recomputed_tables(("C.1", "C.2", "C.3")))
assert rows == 171, rows
"""

OPTIMUM = """
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.optimum import optimal_point
optimal_point(NormalisedLoop.ideal(0.0, 0.0, {delay}), "settle_2pct")
"""

DESIGN = ["-m", "pipeline", "design", "--device", "falcon", "--stiffness", "5000", "--settling", "0.03", "--json"]

LIMITS = {
    "theory boundary --delay 8, process": (["-m", "pipeline", "theory", "boundary", "--delay", "8"], 0.6),
    "optimum of settling, d = 4, process": (["-c", OPTIMUM.format(delay=4)], 0.6),
    "optimum of settling, d = 4.5, process": (["-c", OPTIMUM.format(delay=4.5)], 0.6),
    "design falcon, 5000 N/m in 30 ms, process": (DESIGN, 2.0),
    "Tables C.1 to C.3, 171 rows, process": (["-c", TABLES_C], 15.0),
}
"""Whole processes, and the seconds that each may take."""


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(f"{'comparison':32} {'other [ms]':>11} {'ours [ms]':>11} {'ratio':>8} {'wanted':>8} {'difference':>11}")
    comparisons = (
        boundary_of_five_delays,
        partial(map_as_a_process, 251, 0.9, 3),
        partial(map_as_a_process, 1001, 0.3, 1),
    )
    for comparison in comparisons:
        row = comparison()
        times = f"{1e3 * row.other_s:11.2f} {1e3 * row.ours_s:11.2f} {row.other_s / row.ours_s:8.1f} {row.wanted:8.1f}"
        print(f"{row.name:32} {times} {row.difference:11.1e}", flush=True)
    print(f"\n{'limit':52} {'wanted':>11}  {'holds':5}  reached")
    for name, (command, wanted) in LIMITS.items():
        seconds = min(run([sys.executable, *command]).processor for _ in range(3 if wanted < 1 else 1))
        print(f"{name:52} {wanted:9.1f} s  {'yes' if seconds <= wanted else 'NO':5}  {seconds:.2f} s", flush=True)


if __name__ == "__main__":
    main()

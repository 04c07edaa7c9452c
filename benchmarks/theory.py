"""Speed of the theory beside what a user would write instead, as ratios; then what it has to reach by itself.

    python benchmarks/theory.py [--quick] [name ...]

A comparison is a function that returns a `Row` and stands in `COMPARISONS`, a wanted time one in `LIMITS`; limits of
accuracy are tests (docs/verification.md). Nothing here fails on a slow machine.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from timing import fastest, once, run

from pipeline.loop.loop import Loop
from pipeline.theory.branches import first_branch
from pipeline.theory.limits import boundary, is_inside, stiffness_limit
from pipeline.theory.map import CostMap, bounding_box
from pipeline.theory.poles import spectral_radius

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
    inside_s: float | None = None
    """Of our seconds, those that a process which is there already would take."""

    @property
    def ratio(self) -> float:
        return self.other_s / self.ours_s


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
        first_branch.cache_clear()
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
        first_branch.cache_clear()
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
    inside = fastest(lambda: list(CostMap(Loop(0.0, 0.0, 4)).blocks()), 3)
    return Row("map 251 x 251, d = 4, process", times[0], times[1], 1 / 0.8, difference, inside)


@dataclass(frozen=True)
class Limit:
    """One absolute number: what is reached and what is wanted, as printed, and whether it holds."""

    name: str
    reached: str
    wanted: str
    holds: bool


TABLES_C = """
from pipeline.studies.thesis_tables import recomputed_tables
rows = sum(len(list(found)) for _, _, found in recomputed_tables(("C.1", "C.2", "C.3")))
assert rows == 171, rows
"""


def tables_c_as_a_process() -> Limit:
    """All 171 rows of Tables C.1 to C.3 in one process."""
    seconds = once(partial(run, [sys.executable, "-c", TABLES_C]))
    return Limit("Tables C.1 to C.3, 171 rows, process", f"{seconds:.1f} s", "60 s", seconds <= 60)


def boundary_as_a_process() -> Limit:
    """The command `theory boundary` with all of its start."""
    command = [sys.executable, "-m", "pipeline", "theory", "boundary", "--delay", "8"]
    seconds = fastest(partial(run, command))
    return Limit("theory boundary --delay 8, process", f"{seconds:.2f} s", "0.6 s", seconds <= 0.6)


LIMITS: list[Callable[[], Limit]] = [tables_c_as_a_process, boundary_as_a_process]

COMPARISONS: list[Callable[[], Row]] = [
    boundary_of_five_delays,
    verdicts_of_a_map,
    map_as_a_process,
]

SLOW = (map_as_a_process, tables_c_as_a_process)
"""Left out of a quick run."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [function.__name__ for function in (*COMPARISONS, *LIMITS)]
    parser.add_argument("names", nargs="*", metavar="name", help=f"of {', '.join(known)}; all without any")
    parser.add_argument("--quick", action="store_true", help="fewer points and shorter delays; the slow rows left out")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(known):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; expected of {', '.join(known)}")
    chosen = arguments.names or [f.__name__ for f in (*COMPARISONS, *LIMITS) if not (arguments.quick and f in SLOW)]

    comparisons = [function for function in COMPARISONS if function.__name__ in chosen]
    if comparisons:
        print(f"{'comparison':32} {'other [ms]':>11} {'ours [ms]':>11} {'ratio':>8} {'wanted':>8} {'difference':>11}")
    for comparison in comparisons:
        row = comparison()
        times = f"{1e3 * row.other_s:11.2f} {1e3 * row.ours_s:11.2f} {row.ratio:8.1f} {row.wanted:8.1f}"
        inside = "" if row.inside_s is None else f"  (of ours {1e3 * row.inside_s:.0f} ms inside the process)"
        print(f"{row.name:32} {times} {row.difference:11.1e}{inside}", flush=True)

    limits = [function for function in LIMITS if function.__name__ in chosen]
    if limits:
        print(f"\n{'limit':52} {'wanted':>11}  {'holds':5}  reached")
    for function in limits:
        limit = function()
        print(f"{limit.name:52} {limit.wanted:>11}  {'yes' if limit.holds else 'NO':5}  {limit.reached}", flush=True)


if __name__ == "__main__":
    main()

"""How time and memory of the theory commands grow with grid, delay and number of points.

    python benchmarks/growth_theory.py [--quick]

Every row is a whole process on one core, start-up (some 0.3 s) included.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from growth import PIPELINE, Work, table

THEORY = [*PIPELINE, "theory"]

ENERGY_SECONDS = {64: 1.0, 256: 5.0}
"""Wanted for the energy optimum, by delay."""


def maps_over_side(folder: Path, quick: bool) -> list[Work]:
    limits = {251: (None, None), 501: (None, None), 1001: (12.0, 1126.0), 1501: (None, 300.0), 2001: (None, 300.0)}
    sides = list(limits)[: 2 if quick else None]
    command = [*THEORY, "map", "--delay", "4", "--out", str(folder / "map.parquet"), "--size"]
    return [Work(side**2, [*command, str(side)], *limits[side]) for side in sides]


def maps_over_delay(folder: Path, quick: bool) -> list[Work]:
    command = [*THEORY, "map", "--out", str(folder / "map.parquet"), "--delay"]
    delays = (4, 8) if quick else (4, 8, 16, 32, 64)
    return [Work(d, [*command, str(d)], 10.0 if d == 32 else None) for d in delays]


def optima_over_delay(criterion: str, quick: bool) -> list[Work]:
    command = [*THEORY, "optimum", "--criterion", criterion, "--delay"]
    return [Work(d, [*command, str(d)], ENERGY_SECONDS.get(d)) for d in (4, 16, 64, *(() if quick else (128, 256)))]


def boundaries_over_delay(quick: bool) -> list[Work]:
    command = [*THEORY, "boundary", "--delay"]
    return [Work(d, [*command, str(d)]) for d in (4, 16, 64, *(() if quick else (128, 256)))]


def points_over_number(folder: Path, quick: bool) -> list[Work]:
    """Random stable points of the double integrator at d = 2, without those that creep for ever."""
    rng = np.random.default_rng(13)
    works = []
    for count in (100, 1000, *(() if quick else (10_000, 100_000))):
        path = folder / f"{count}.csv"
        rows = zip(rng.uniform(0.01, 0.03, count), rng.uniform(0.2, 0.3, count), strict=True)
        path.write_text("alpha,beta,gamma,delta,delay\n" + "".join(f"{a},{b},0,0,2\n" for a, b in rows))
        works.append(Work(count, [*THEORY, "points", str(path), "--json"]))
    return works


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes only")
    quick = parser.parse_args().quick
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        table("theory map, d = 4", "points", maps_over_side(folder, quick))
        table("theory map, 251 x 251", "delay", maps_over_delay(folder, quick))
        for criterion in ("energy_step_w0", "energy_impulse_w1"):
            table(f"theory optimum {criterion}", "delay", optima_over_delay(criterion, quick))
        table("theory boundary", "delay", boundaries_over_delay(quick))
        table("theory points", "points", points_over_number(folder, quick))


if __name__ == "__main__":
    main()

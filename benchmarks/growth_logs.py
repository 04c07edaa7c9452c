"""How time and memory of an ingest grow with the number of logs, and of quarantine with that of refused ones.

    python benchmarks/growth_logs.py [--logs 2220 --logs 22200 --logs 101000 --logs 202000] [--refused 2000]

Logs are short (10 rows), so that what grows is the work for each file. Beside the table: ingest of 2,220 logs of 900
rows in 20 experiments beside a bare loop over pyarrow.csv, and what quarantine takes for each log.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from growth import PIPELINE, Work, cost, table
from ingest import BARE, write_logs

LOGS, REFUSED = (2220, 22_200, 101_000, 202_000), (200, 2000, 6000)
ROWS, LONG_ROWS, LONG_LOGS, EXPERIMENTS = 10, 900, 2220, 20

LIMIT_LOGS, AGAIN_LIMIT_S, MEMORY_LIMIT_MIB = 101_000, 1.5, 422.0
"""Number of logs that the limits of "nothing new" and "one more log" are meant for [s, MiB]."""

REFUSED_LIMIT_S, REFUSED_LIMIT_BYTES = 2e-3, 2000
"""Of quarantine for each log, beside the copy."""

REPEATS = 3


def ingests(folder: Path, sizes: Sequence[int]) -> None:
    """Print first ingest, nothing new and one more log."""
    command = [*PIPELINE, "ingest", "raw", "--json"]
    places = {logs: folder / str(logs) for logs in sizes}
    for logs, place in places.items():
        write_logs(place / "raw", logs, ROWS, EXPERIMENTS)
    table("first ingest", "logs", [Work(logs, command, folder=place) for logs, place in places.items()])

    def work(logs: int, place: Path) -> Work:
        limits = (AGAIN_LIMIT_S, MEMORY_LIMIT_MIB) if logs == LIMIT_LOGS else (None, None)
        return Work(logs, command, *limits, folder=place)

    table("nothing new", "logs", [work(logs, place) for logs, place in places.items()])
    for place in places.values():
        text = (place / "raw" / "000000.csv").read_text(encoding="utf-8")
        (place / "raw" / "more.csv").write_text(text.replace("stiffness: 100", "stiffness: 50"), encoding="utf-8")
    table("one more log", "logs", [work(logs, place) for logs, place in places.items()])


def quarantine(folder: Path, sizes: Sequence[int]) -> None:
    """Print what refused logs cost."""
    for refused in sizes:
        raw = folder / f"refused{refused}" / "raw"
        write_logs(raw, refused, LONG_ROWS)
        for file in raw.iterdir():
            file.write_text(file.read_text(encoding="utf-8").replace("stiffness: ", "stiffness: x"), encoding="utf-8")
    command = [*PIPELINE, "ingest", "raw", "--json"]
    works = [Work(n, command, folder=folder / f"refused{n}") for n in sizes]
    rows = table("refused logs", "logs", works)
    for (smaller, less), (work, spent) in pairwise(rows):
        assert work.folder is not None
        each = (spent.seconds - less.seconds) / (work.size - smaller.size)
        memory = (spent.mebibytes - less.mebibytes) * (1 << 20) / (work.size - smaller.size)
        sizes_of = [file.stat().st_size for file in (work.folder / "processed" / "quarantine").rglob("reason-*.json")]
        print(
            f"{work.size:14,.0f} {1e3 * each:.2f} ms a log (wanted {1e3 * REFUSED_LIMIT_S:g}), largest record "
            f"{max(sizes_of)} bytes (wanted {REFUSED_LIMIT_BYTES}), memory {memory:.0f} bytes a log"
        )


def beside_a_bare_loop(folder: Path) -> None:
    """Print the ingest of usual logs in many experiments beside a bare loop; the two take turns."""
    write_logs(folder / "raw", LONG_LOGS, LONG_ROWS, EXPERIMENTS)
    commands = {
        "bare loop": [sys.executable, "-c", BARE, "raw", "bare.parquet"],
        "ingest": [*PIPELINE, "ingest", "raw", "--json"],
    }
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
    for _ in range(REPEATS):
        shutil.rmtree(folder / "processed", ignore_errors=True)
        for name, command in commands.items():
            spent = cost(Work(LONG_LOGS, command, folder=folder))
            found[name].append((spent.seconds, spent.processor))
    best = {name: min(runs) for name, runs in found.items()}
    print(f"\n{LONG_LOGS} logs of {LONG_ROWS} rows in {EXPERIMENTS} experiments")
    for name, (seconds, processor) in best.items():
        print(f"  {name:<12} {seconds:.2f} s, processor {processor:.2f} s")
    print(f"  {best['ingest'][0] / best['bare loop'][0]:.2f} of the bare loop (wanted 1)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, action="append", help="number of logs; four sizes where not given")
    parser.add_argument("--refused", type=int, action="append", help="number of refused logs; three where not given")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        beside_a_bare_loop(Path(name) / "usual")
        ingests(Path(name), given.logs or LOGS)
        quarantine(Path(name), given.refused or REFUSED)


if __name__ == "__main__":
    main()

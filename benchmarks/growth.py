"""How time and memory of whole processes grow with their work: a row a size, and the exponent between two sizes.

    python benchmarks/growth.py [--part logs,theory,trials] [--quick]

``logs``: ingest of short logs, of which the work for each file is left, beside a bare loop over pyarrow.csv, and what
quarantine takes for each log. ``theory``: the commands over grid, delay and number of points. ``trials``: a comparison
over the number of logs, the length of one of them, and with one log more. Limits stand beside the sizes that they are
meant for; nothing here fails on a slow machine: what is missed is printed with NO.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from logs import BARE, write_logs
from timing import COURSE, PIPELINE, Spent, run


@dataclass(frozen=True)
class Work:
    """One size of some work, and the command that does it.

    Parameters
    ----------
    size : float
        What grows: points, trials, rows, logs.
    command : sequence of str
    seconds, mebibytes : float, optional
        Wanted wall time [s] and peak of the largest process [MiB].
    """

    size: float
    command: Sequence[str]
    seconds: float | None = None
    mebibytes: float | None = None
    folder: Path | None = None


def table(title: str, unit: str, works: Sequence[Work]) -> list[tuple[Work, Spent]]:
    """Print a table while it is measured, and return its rows: time and memory by size, with exponents and limits."""
    print(f"\n{title}")
    print(f"{unit:>14} {'time s':>9} {'cpu s':>9} {'MiB':>8} {'time ~':>7} {'memory ~':>8}  wanted", flush=True)
    rows: list[tuple[Work, Spent]] = []
    for work in works:
        spent = run(work.command, work.folder)
        exponents = ["", ""]
        if rows and rows[-1][0].size != work.size:
            smaller, less = rows[-1]
            step = math.log(work.size / smaller.size)
            pairs = ((spent.seconds, less.seconds), (spent.mebibytes, less.mebibytes))
            exponents = [f"{math.log(now / before) / step:.2f}" for now, before in pairs]
        wanted = [
            f"{limit:g} {name}: {'yes' if found <= limit else 'NO'}"
            for limit, name, found in (
                (work.seconds, "s", spent.seconds), (work.mebibytes, "MiB", spent.mebibytes)
            )
            if limit is not None
        ]  # fmt: skip
        print(
            f"{work.size:14,.0f} {spent.seconds:9.2f} {spent.processor:9.2f} {spent.mebibytes:8.0f} "
            f"{exponents[0]:>7} {exponents[1]:>8}  {', '.join(wanted)}",
            flush=True,
        )
        rows.append((work, spent))
    return rows


LOGS, REFUSED = (2220, 22_200, 101_000, 202_000), (200, 2000, 6000)
SHORT_ROWS, LONG_ROWS, LONG_LOGS, EXPERIMENTS = 10, 900, 2220, 20

LIMIT_LOGS, AGAIN_LIMIT_S, MEMORY_LIMIT_MIB = 101_000, 1.5, 422.0
"""Number of logs that the limits of "nothing new" and "one more log" are meant for [s, MiB]."""

REFUSED_LIMIT_S, REFUSED_LIMIT_BYTES = 2e-3, 2000
"""Of quarantine for each log."""

REPEATS = 3


def ingests(folder: Path, sizes: Sequence[int]) -> None:
    """Print first ingest, nothing new and one more log."""
    command = [*PIPELINE, "ingest", "raw", "--json"]
    places = {logs: folder / str(logs) for logs in sizes}
    for logs, place in places.items():
        write_logs(place / "raw", logs, SHORT_ROWS, EXPERIMENTS)
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
            spent = run(command, folder)
            found[name].append((spent.seconds, spent.processor))
    best = {name: min(runs) for name, runs in found.items()}
    print(f"\n{LONG_LOGS} logs of {LONG_ROWS} rows in {EXPERIMENTS} experiments")
    for name, (seconds, processor) in best.items():
        print(f"  {name:<12} {seconds:.2f} s, processor {processor:.2f} s")
    print(f"  {best['ingest'][0] / best['bare loop'][0]:.2f} of the bare loop (wanted 1)")


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


TRIALS = (2_200, 6_600, 20_000)
LONGER = (100_000, 1_000_000, 5_000_000)
USUAL = 2_530
PERIOD_S = 1e-3

WANTED_TRIALS = {20_000: 45.0}
WANTED_ROWS = {5_000_000: (60.0, 1536.0)}
WANTED_MORE = 5.0


def simulated(folder: Path, trials: int) -> list[Path]:
    """Return so many logs, of as many runs of the course as it takes."""
    while len(logs := sorted((folder / "all").rglob("*.csv"))) < trials:
        seed = 1 + sum(1 for _ in folder.glob("all/*"))
        run([*COURSE, "0.4", str(seed), f"all/{seed}"], folder)
    return logs[:trials]


def stored(folder: Path, logs: list[Path]) -> list[str]:
    """Ingest logs into a store of its own, beside the theory that is there already; return how to compare them."""
    raw = folder / "raw"
    raw.mkdir(parents=True)
    for number, log in enumerate(logs):
        (raw / f"{number}.csv").hardlink_to(log)
    run([*PIPELINE, "ingest", "raw"], folder)
    theory = folder.parent / "theory"
    if theory.is_dir():
        shutil.copytree(theory, folder / "processed" / "theory")
    return [*PIPELINE, "compare", "--device", "falcon", "--json"]


def lengthened(log: Path, rows: int, target: Path) -> Path:
    """Write a log that goes on resting, with the noise of its last rows, for so many rows."""
    text = log.read_text(encoding="utf-8").splitlines()
    head = next(i for i, line in enumerate(text) if line.startswith("time_s")) + 1
    values = [line.split(",", 1)[1] for line in text[head:]]
    last = values[-40:]
    with target.open("w", encoding="utf-8") as stream:
        stream.write("\n".join(text[:head]) + "\n")
        for row in range(rows):
            stream.write(f"{row * PERIOD_S:.3f},{values[row] if row < len(values) else last[row % 40]}\n")
    return target


def settled(folder: Path) -> Path:
    """Return a log of a store whose response settles early."""
    import pyarrow.parquet as pq

    outcomes = pq.read_table(folder / "processed/stages/falcon/1/outcome.parquet").to_pylist()
    sources = {row["trial_id"]: row["source_path"] for row in pq.read_table(folder / "processed/trials").to_pylist()}
    early = [row for row in outcomes if row["outcome"] == "settled" and row["outcome_row"] < 150]
    return Path(sources[early[len(early) // 2]["trial_id"]]).resolve()


def logs_part(folder: Path, quick: bool) -> None:
    beside_a_bare_loop(folder / "usual")
    ingests(folder, LOGS[:1] if quick else LOGS)
    quarantine(folder, REFUSED[:1] if quick else REFUSED)


def theory_part(folder: Path, quick: bool) -> None:
    table("theory map, d = 4", "points", maps_over_side(folder, quick))
    table("theory map, 251 x 251", "delay", maps_over_delay(folder, quick))
    for criterion in ("energy_step_w0", "energy_impulse_w1"):
        table(f"theory optimum {criterion}", "delay", optima_over_delay(criterion, quick))
    table("theory boundary", "delay", boundaries_over_delay(quick))
    table("theory points", "points", points_over_number(folder, quick))


def trials_part(folder: Path, quick: bool) -> None:
    usual = 200 if quick else USUAL
    logs = simulated(folder, usual)
    compare = stored(folder / "one", logs)
    run(compare, folder / "one")
    shutil.copytree(folder / "one" / "processed" / "theory", folder / "theory")
    lengthened(logs[usual // 3], 399, folder / "one" / "raw" / "more.csv")
    run([*PIPELINE, "ingest", "raw"], folder / "one")
    more = Work(usual + 1, compare, WANTED_MORE, folder=folder / "one")
    table("compare with one log more than before", "logs", [more])

    works = []
    for trials in (100, 300) if quick else TRIALS:
        place = folder / f"{trials}"
        command = stored(place, simulated(folder, trials))
        works.append(Work(trials, command, WANTED_TRIALS.get(trials), folder=place))
    table("compare an experiment of many logs of 400 rows", "logs", works)

    long = settled(folder / "one")
    stored(folder / "short", logs)
    works = [Work(400, compare, folder=folder / "short")]
    for rows in (10_000,) if quick else LONGER:
        place = folder / f"long-{rows}"
        command = stored(place, [*logs, lengthened(long, rows, folder / f"{rows}.csv")])
        works.append(Work(rows, command, *WANTED_ROWS.get(rows, (None, None)), folder=place))
    table(f"compare {usual} logs of 400 rows and one longer", "its rows", works)


PARTS = {"logs": logs_part, "theory": theory_part, "trials": trials_part}


def main() -> None:
    """Print the tables of the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", default=",".join(PARTS), help="separated by commas; all where not given")
    parser.add_argument("--quick", action="store_true", help="small sizes only")
    asked = parser.parse_args()
    if unknown := set(asked.part.split(",")) - set(PARTS):
        parser.error(f"no part {sorted(unknown)[0]!r}; there are {', '.join(PARTS)}")
    for name in asked.part.split(","):
        with tempfile.TemporaryDirectory() as folder:
            PARTS[name](Path(folder), asked.quick)


if __name__ == "__main__":
    main()

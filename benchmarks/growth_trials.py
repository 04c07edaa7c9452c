"""How a comparison grows: with the number of logs, with the length of one of them, and with one log more.

    python benchmarks/growth_trials.py [--trials 2200 --trials 6600 --trials 20000] [--rows 100000 ...]

Simulated logs of Falcon experiment 1, 400 rows each. Theory is computed before, so that the rows show the logs alone.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from growth import PIPELINE, Work, table

TRIALS = (2_200, 6_600, 20_000)
ROWS = (100_000, 1_000_000, 5_000_000)
LOGS = 2_530
PERIOD_S = 1e-3

WANTED_TRIALS = {20_000: 45.0}
WANTED_ROWS = {5_000_000: (60.0, 1536.0)}
WANTED_MORE = 5.0


def run(folder: Path, *words: str) -> None:
    """Run a command of the package, which must succeed."""
    subprocess.run([*PIPELINE, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def simulated(folder: Path, trials: int) -> list[Path]:
    """Return so many logs, of as many runs of the course as it takes."""
    while len(logs := sorted((folder / "all").rglob("*.csv"))) < trials:
        seed = 1 + sum(1 for _ in folder.glob("all/*"))
        words = ("--experiment", "1", "--duration", "0.4", "--seed", str(seed), "--out", f"all/{seed}")
        run(folder, "simulate", "falcon", *words)
    return logs[:trials]


def stored(folder: Path, logs: list[Path]) -> list[str]:
    """Ingest logs into a store of its own, beside the theory that is there already; return how to compare them."""
    raw = folder / "raw"
    raw.mkdir(parents=True)
    for number, log in enumerate(logs):
        (raw / f"{number}.csv").hardlink_to(log)
    run(folder, "ingest", "raw")
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, action="append")
    parser.add_argument("--rows", type=int, action="append")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs = simulated(folder, LOGS)
        compare = stored(folder / "one", logs)
        run(folder / "one", "compare", "--device", "falcon")
        shutil.copytree(folder / "one" / "processed" / "theory", folder / "theory")
        more = folder / "one" / "raw" / "more.csv"
        lengthened(logs[1000], 399, more)
        run(folder / "one", "ingest", "raw")
        work = Work(LOGS + 1, compare, WANTED_MORE, folder=folder / "one")
        table("compare with one log more than before", "logs", [work])

        works = []
        for trials in asked.trials or TRIALS:
            place = folder / f"{trials}"
            works.append(
                Work(trials, stored(place, simulated(folder, trials)), WANTED_TRIALS.get(trials), folder=place)
            )
        table("compare an experiment of many logs of 400 rows", "logs", works)

        long = settled(folder / "one")
        works = [Work(400, compare, folder=folder / "short")]
        stored(folder / "short", logs)
        for rows in asked.rows or ROWS:
            place = folder / f"long-{rows}"
            command = stored(place, [*logs, lengthened(long, rows, folder / f"{rows}.csv")])
            seconds, mebibytes = WANTED_ROWS.get(rows, (None, None))
            works.append(Work(rows, command, seconds, mebibytes, folder=place))
        table(f"compare {LOGS} logs of 400 rows and one longer", "its rows", works)


if __name__ == "__main__":
    sys.exit(main())

"""Speed and memory of the way from logs to a report: thesis-size Falcon experiment 1, each stage as a whole process.

Prints a table beside the limits. Nothing here fails on a slow machine.

    python benchmarks/spine.py [--rows 400 --rows 1000]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from timing import COURSE, PIPELINE, run

ROWS = (400, 1000)
PERIOD_S = 1e-3

SECONDS = {
    "simulate": 15.0,
    "ingest": 5.0,
    "estimates and costs": 3.0,
    "compare": 10.0,
    "compare again": 1.0,
    "ingest again": 1.0,
    "pipeline --help": 0.4,
    "import pipeline": 0.4,
}
MEMORY_MIB = 500.0
REPORT_MB = 5.0

STAGES = """
import json, sys, time
from pathlib import Path
began = time.perf_counter()
from pipeline.comparison.scene.scene import needed_stages, open_scene
data = open_scene("falcon", Path(sys.argv[1]), ["1"], None)
imported = time.perf_counter()
for of in data.experiments:
    for stage in sorted(needed_stages(data)):
        of.table(stage)
print(json.dumps({"seconds": time.perf_counter() - imported}))
"""


@dataclass(frozen=True)
class Measurement:
    """One stage: wall time [s], its limit [s], processor time [s], peak memory [MiB] of its largest process."""

    rows: int | None
    stage: str
    seconds: float
    limit_s: float
    processor_s: float
    memory_mib: float


def starts(folder: Path) -> list[Measurement]:
    """Time to the first answer: best of five, the files being in memory then."""
    commands = {
        "pipeline --help": [*PIPELINE, "--help"],
        "import pipeline": [sys.executable, "-c", "import pipeline"],
    }
    found = []
    for stage, command in commands.items():
        best = min((run(command, folder) for _ in range(5)), key=lambda spent: spent.seconds)
        found.append(Measurement(None, stage, best.seconds, SECONDS[stage], best.processor, best.mebibytes))
    return found


def spine(folder: Path, rows: int) -> tuple[list[Measurement], dict[str, float]]:
    """Measure all stages of one course; returns them with the sizes of logs and report."""
    ingest = [*PIPELINE, "ingest", "raw", "--json"]
    compare = [*PIPELINE, "compare", "--device", "falcon", "--json"]
    duration = f"{rows * PERIOD_S:g}"
    simulate = [*COURSE, duration, "0", "raw"]
    copy = folder / "copy"
    commands = {
        "simulate": simulate,
        "ingest": ingest,
        "ingest again": ingest,
        # the same logs in a second store, so that `compare` below has all of its stages still to run
        "": [*PIPELINE, "ingest", "raw", "--processed", str(copy), "--json"],
        "estimates and costs": [sys.executable, "-c", STAGES, str(copy)],
        "compare": compare,
        "compare again": compare,
    }
    found = []
    for stage, command in commands.items():
        spent = run(command, folder)
        if not stage:
            continue
        # without the start of Python
        seconds = json.loads(spent.output)["seconds"] if stage == "estimates and costs" else spent.seconds
        found.append(Measurement(rows, stage, seconds, SECONDS[stage], spent.processor, spent.mebibytes))
    logs = list((folder / "raw").rglob("*.csv"))
    sizes = {
        "logs": len(logs),
        "logs_mb": sum(log.stat().st_size for log in logs) / 1e6,
        "report_mb": (folder / "reports" / "falcon.html").stat().st_size / 1e6,
    }
    return found, sizes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, action="append", help="rows of a log; 400 and 1000 where not given")
    chosen = parser.parse_args().rows or ROWS
    measurements: list[Measurement] = []
    sizes: dict[int, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        measurements += starts(Path(name))
        for rows in chosen:
            folder = Path(name) / str(rows)
            folder.mkdir()
            found, sizes[rows] = spine(folder, rows)
            measurements += found
    head = f"{'wall [s]':>9} {'limit [s]':>9} {'processor [s]':>13} {'peak [MiB]':>10}"
    print(f"{'rows':>5}  {'stage':<20} {head} (limit {MEMORY_MIB:g})")
    for m in measurements:
        over = " over" if m.seconds > m.limit_s or m.memory_mib > MEMORY_MIB else ""
        row = "" if m.rows is None else str(m.rows)
        numbers = f"{m.seconds:9.2f} {m.limit_s:9.2f} {m.processor_s:13.2f} {m.memory_mib:10.0f}"
        print(f"{row:>5}  {m.stage:<20} {numbers}{over}")
    for rows, size in sizes.items():
        over = " over" if size["report_mb"] > REPORT_MB else ""
        print(
            f"{rows:>5}  {size['logs']:.0f} logs, {size['logs_mb']:.0f} MB; report {size['report_mb']:.2f} MB "
            f"(limit {REPORT_MB:g}){over}"
        )


if __name__ == "__main__":
    main()

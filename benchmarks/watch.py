"""What a watch costs: processor time and memory while nothing happens, and the time from a new log to its report.

    python benchmarks/watch.py [--logs 2200] [--seconds 10]

Simulated logs of Falcon experiment 1 are watched by a process of its own. Nothing here fails on a slow machine.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from timing import MIB, PIPELINE

LOGS, IDLE_S = 2200, 10.0
LIMITS = {"idle share [%]": 1.0}
"""Share of one processor that a watch may take while nothing happens."""


def usage(process: subprocess.Popen[str]) -> tuple[float, float]:
    """Return processor time [s] and resident memory [MiB] of a process (Linux)."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    ticks = int(fields[11]) + int(fields[12])
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return ticks / os.sysconf("SC_CLK_TCK"), pages * resource.getpagesize() / MIB


def wait_for(process: subprocess.Popen[str], kind: str, **values: Any) -> dict[str, Any]:
    """Return the next event of a kind."""
    assert process.stdout is not None
    for line in process.stdout:
        event: dict[str, Any] = json.loads(line)
        if event["event"] == "failed":
            sys.exit(f"{event['what']}: {event['reason']}")
        if event["event"] == kind and values.items() <= event.items():
            return event
    sys.exit(f"the watch ended with status {process.wait()}")


def measure(folder: Path, logs: int, idle_s: float) -> dict[str, float]:
    """Return the rows by name."""
    subprocess.run(
        [*PIPELINE, "simulate", "falcon", "--experiment", "1", "--out", "all", "--json"],
        cwd=folder, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    files = sorted((folder / "all").rglob("*.csv"))[: logs + 1]
    (folder / "raw").mkdir()
    for file in files[:-1]:
        file.rename(folder / "raw" / file.name)
    rows: dict[str, float] = {"logs": len(files) - 1}
    began = time.perf_counter()
    process = subprocess.Popen([*PIPELINE, "watch", "raw", "--json"], cwd=folder, stdout=subprocess.PIPE, text=True)
    try:
        rows["report made [s]"] = wait_for(process, "report")["seconds"]
        wait_for(process, "index")
        rows["start to index, settling 2 s [s]"] = time.perf_counter() - began
        time.sleep(1.0)  # the pass ends
        before, _ = usage(process)
        time.sleep(idle_s)
        after, rows["resident memory [MiB]"] = usage(process)
        rows["idle share [%]"] = 100 * (after - before) / idle_s
        began = time.perf_counter()
        shutil.copy(files[-1], folder / "raw" / files[-1].name)
        rows["report renewed [s]"] = wait_for(process, "report")["seconds"]
        rows["one more log to index, settling 2 s [s]"] = time.perf_counter() - began
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate()
    began = time.perf_counter()
    subprocess.run([*PIPELINE, "watch", "raw", "--once"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    rows["--once with nothing new [s]"] = time.perf_counter() - began
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=LOGS)
    parser.add_argument("--seconds", type=float, default=IDLE_S)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        rows = measure(Path(name), asked.logs, asked.seconds)
    for name, value in rows.items():
        limit = LIMITS.get(name)
        over = "" if limit is None else f"  (limit {limit:g}){' over' if value > limit else ''}"
        print(f"{name:<42} {value:10.4g}{over}")


if __name__ == "__main__":
    main()

"""Speed, memory and size of storing logs, beside a bare loop over pyarrow.csv into one Parquet file.

    python benchmarks/ingest.py [--logs 2200 --logs 22000] [--rows 620] [--repeats 3]

Each command is a whole process on the same cores; the repeats of all commands take turns, and the fastest counts.
Nothing here fails on a slow machine.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from timing import MIB, PIPELINE

RESULTS = Path(__file__).parent / "results"
LOGS = (2200, 22_000)
ROWS = 620
"""Makes a log of 31 KB, 2,200 of which are 68 MB; numbers have 17 digits, as simulated and recorded ones have."""

BODIES = 2200
"""Logs whose samples differ; further ones repeat them under a slightly other stiffness, which saves preparation."""

ONE_MORE = 10
"""Logs that are added one by one; the slowest counts."""


BARE = """
import sys
from pathlib import Path
import pyarrow as pa, pyarrow.csv as csv, pyarrow.parquet as pq
options = csv.ReadOptions(skip_rows=10)
files = sorted(Path(sys.argv[1]).iterdir())
pq.write_table(pa.concat_tables([csv.read_csv(file, read_options=options) for file in files]), sys.argv[2])
"""

POLARS = """
import sys
import polars
polars.scan_csv(sys.argv[1] + "/*.csv", skip_rows=10).sink_parquet(sys.argv[2])
"""

FIRST_LIMIT, AGAIN_LIMIT, SIZE_LIMIT = 1.3, 0.25, 1.15
"""Times of the bare loop; of the first ingest; of the bare file."""

MEMORY_LIMIT_MIB, ONE_MORE_LIMIT_S, ONE_MORE_LIMIT_MB = 350.0, 3.0, 50.0


@dataclass(frozen=True)
class Run:
    """One process: wall time [s], and peak memory of it and its children together [MiB]."""

    seconds: float
    memory_mib: float


class Sampler(threading.Thread):
    """Samples the memory of all processes of a session, shared pages counted once (Linux)."""

    PERIOD_S = 0.02

    def __init__(self, session: int) -> None:
        super().__init__(daemon=True)
        self.session, self.peak, self.ended = session, 0, threading.Event()

    def run(self) -> None:
        while not self.ended.wait(self.PERIOD_S):
            self.peak = max(self.peak, sum(self._pss(pid) for pid in self._members()))

    def _members(self) -> list[int]:
        members = []
        for name in os.listdir("/proc") if os.path.isdir("/proc") else ():
            try:
                if name.isdigit() and os.getsid(int(name)) == self.session:
                    members.append(int(name))
            except ProcessLookupError:
                continue
        return members

    @staticmethod
    def _pss(pid: int) -> int:
        try:
            text = Path(f"/proc/{pid}/smaps_rollup").read_text()
        except OSError:
            return 0
        return next((1024 * int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:")), 0)


def run(command: list[str], cwd: Path) -> Run:
    began = time.perf_counter()
    process = subprocess.Popen(
        command, cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    sampler = Sampler(process.pid)
    sampler.start()
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    sampler.ended.set()
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        sys.exit(f"{' '.join(command)}: exit status {process.returncode}; run it by hand in {cwd} to see why.")
    scale = 1 if sys.platform == "darwin" else 1024  # ru_maxrss: bytes on macOS, KiB elsewhere
    # between two samples the memory may peak; that of the largest process is known exactly
    return Run(seconds, max(sampler.peak, usage.ru_maxrss * scale) / MIB)


def text_of(stiffness: float, damping: float, body: str, experiment: int = 1) -> str:
    header = {
        "device": "falcon",
        "experiment": f"{experiment}",
        "stiffness": f"{stiffness:.12g} [N/m]",
        "damping": f"{damping:g} [Ns/m]",
        "step": "8 [N]",
        "sampling_period_s": "0.001",
        "added_delay_samples": "0",
        "grip": "none",
        "motion": "translation",
        "origin": "simulated",
    }
    return "".join(f"# {key}: {value}\n" for key, value in header.items()) + "time_s,command,position\n" + body


def write_logs(folder: Path, logs: int, rows: int, experiments: int = 1) -> list[str]:
    """Write logs of decaying oscillations with the quantum of a sensor; returns their samples as text.

    All differ by their stiffness, which their commands obey; their experiments take turns.
    """
    folder.mkdir(parents=True)
    random = np.random.default_rng(0)
    time_s = np.arange(rows) * 1e-3
    bodies = []
    for number in range(min(logs, BODIES)):
        decay, frequency = random.uniform(3, 30), random.uniform(20, 200)
        x = 0.12 - 1e-3 * (1 - np.exp(-decay * time_s) * np.cos(frequency * time_s)) + random.normal(size=rows) * 2e-6
        x = np.round(x / 2e-6) * 2e-6
        force = 8 + (100.0 + number) * (x[0] - x) - number % 180 * np.diff(x, prepend=x[:1]) / 1e-3
        values = zip(time_s.tolist(), force.tolist(), x.tolist(), strict=True)
        bodies.append("".join(["%.17g,%.17g,%.17g\n" % row for row in values]))  # noqa: UP031  three times faster
    for number in range(logs):
        body = number % BODIES
        stiffness = (100.0 + body) * (1 + 1e-9 * (number // BODIES))
        text = text_of(stiffness, float(body % 180), bodies[body], 1 + number % experiments)
        (folder / f"{number:06d}.csv").write_text(text, encoding="utf-8")
    return bodies


def files_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Return inode and size of each file below a folder."""
    return {
        os.path.join(here, name): (os.stat(os.path.join(here, name)).st_ino, os.stat(os.path.join(here, name)).st_size)
        for here, _, names in os.walk(folder)
        for name in names
    }


def measure(folder: Path, logs: int, rows: int, repeats: int) -> dict[str, float | None]:
    bodies = write_logs(folder / "raw", logs, rows)
    ingest = [*PIPELINE, "ingest", "raw", "--json"]
    commands = {
        "bare": [sys.executable, "-c", BARE, "raw", "bare.parquet"],
        "polars": [sys.executable, "-c", POLARS, "raw", "polars.parquet"],
        "first": ingest,
        "again": ingest,
    }
    if importlib.util.find_spec("polars") is None:
        del commands["polars"]
    # a folder that changed within the last 2 s is searched again by the next ingest
    time.sleep(2.5)
    found: dict[str, list[Run]] = {name: [] for name in commands}
    for _ in range(repeats):
        shutil.rmtree(folder / "processed", ignore_errors=True)
        for name, command in commands.items():
            found[name].append(run(command, folder))
    stored = sum(size for _, size in files_of(folder / "processed").values())
    one_more_s, one_more_bytes = 0.0, 0
    for number in range(ONE_MORE):
        body = bodies[number % len(bodies)]
        (folder / "raw" / f"more{number}.csv").write_text(
            text_of(100.0 + number + 1e-6, float(number), body), encoding="utf-8"
        )
        before = files_of(folder / "processed")
        one_more_s = max(one_more_s, run(ingest, folder).seconds)
        after = files_of(folder / "processed")
        one_more_bytes = max(one_more_bytes, sum(s for path, (i, s) in after.items() if before.get(path) != (i, s)))
    best = {name: min(r.seconds for r in runs) for name, runs in found.items()}
    return {
        "logs": logs,
        "logs_mb": sum(s for _, s in files_of(folder / "raw").values()) / 1e6,
        "bare_s": best["bare"],
        "polars_s": best.get("polars"),
        "first_s": best["first"],
        "again_s": best["again"],
        "first_mib": max(r.memory_mib for r in found["first"]),
        "again_mib": max(r.memory_mib for r in found["again"]),
        "bare_mb": (folder / "bare.parquet").stat().st_size / 1e6,
        "stored_mb": stored / 1e6,
        "one_more_s": one_more_s,
        "one_more_mb": one_more_bytes / 1e6,
    }


def lines_of(m: dict[str, float]) -> list[str]:
    first, again, size = m["first_s"] / m["bare_s"], m["again_s"] / m["first_s"], m["stored_mb"] / m["bare_mb"]

    def judged(value: float, limit: float) -> str:
        return f"limit {limit:g}{' over' if value > limit else ''}"

    polars = "not installed" if m["polars_s"] is None else f"{m['polars_s']:.2f} s"
    memory = max(m["first_mib"], m["again_mib"])
    return [
        f"{m['logs']} logs, {m['logs_mb']:.0f} MB",
        f"  bare loop over pyarrow.csv, one Parquet file  {m['bare_s']:.2f} s, {m['bare_mb']:.1f} MB",
        f"  bare scan and sink of polars                  {polars}",
        f"  first ingest                                  {m['first_s']:.2f} s, {first:.2f} of the bare loop "
        f"({judged(first, FIRST_LIMIT)})",
        f"  again, nothing new                            {m['again_s']:.2f} s, {again:.2f} of the first "
        f"({judged(again, AGAIN_LIMIT)})",
        f"  stored                                        {m['stored_mb']:.1f} MB, {size:.2f} of the bare file "
        f"({judged(size, SIZE_LIMIT)})",
        f"  peak memory                                   {memory:.0f} MiB ({judged(memory, MEMORY_LIMIT_MIB)})",
        f"  one more log, slowest of {ONE_MORE}                   {m['one_more_s']:.2f} s "
        f"({judged(m['one_more_s'], ONE_MORE_LIMIT_S)}), {m['one_more_mb']:.3g} MB written "
        f"({judged(m['one_more_mb'], ONE_MORE_LIMIT_MB)})",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, action="append", help="number of logs; 2,200 and 22,000 where not given")
    parser.add_argument("--rows", type=int, default=ROWS, help="samples of a log")
    parser.add_argument("--repeats", type=int, default=3, help="times that each command runs")
    given = parser.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    found = []
    for logs in given.logs or LOGS:
        with tempfile.TemporaryDirectory() as name:
            found.append(measure(Path(name), logs, given.rows, given.repeats))
        print("\n".join(lines_of(found[-1])), flush=True)
    from pipeline import __version__

    RESULTS.mkdir(exist_ok=True)
    document = {
        "version": __version__,
        "python": platform.python_version(),
        "processors": os.cpu_count(),
        "rows": given.rows,
        "measurements": found,
    }
    file = RESULTS / f"ingest-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}.json"
    file.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(f"{file}")


if __name__ == "__main__":
    main()

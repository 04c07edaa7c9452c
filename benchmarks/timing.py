"""Run times of functions, and time and memory of whole processes."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

REPEATS = 5
PIPELINE = [sys.executable, "-c", "from pipeline.shell.cli import run; run()"]

COURSE = [
    sys.executable,
    "-c",
    """
import sys
from pathlib import Path
from pipeline.device_data.devices import load_device
from pipeline.simulation.sweep import run_sweep, write_sweep
duration, seed, folder = sys.argv[1:]
write_sweep(run_sweep(load_device("falcon"), "1", seed=int(seed), duration_s=float(duration)), Path(folder))
""",
]
"""Writes the logs of Falcon 1: followed by their duration [s], a seed and a folder."""
MIB = 1 << 20


@dataclass(frozen=True)
class Spent:
    """What a process took: wall time [s], processor time [s], peak memory of the largest process [MiB]; its output."""

    seconds: float
    processor: float
    mebibytes: float
    output: str


def fastest(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the least processor time [s] of several runs, after one to warm up."""
    work()
    times = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times)


def run(command: Sequence[str], folder: Path | None = None) -> Spent:
    """Run a command in a process of its own, with one thread for linear algebra; stop where it fails.

    Modules are compiled once, as those of an installed package are.
    """
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as told:
        began = time.perf_counter()
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=out, stderr=told)
        # wait4 gives the usage of this child (and of its own children) alone, RUSAGE_CHILDREN that of all so far
        _, status, used = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        texts = []
        for file in (out, told):
            file.seek(0)
            texts.append(file.read().decode())
    if process.returncode not in (0, 3):
        sys.exit(f"{' '.join(command)}: exit status {process.returncode}\n{texts[1][-2000:]}")
    scale = 1 if sys.platform == "darwin" else 1024  # ru_maxrss: bytes on macOS, KiB elsewhere
    return Spent(seconds, used.ru_utime + used.ru_stime, used.ru_maxrss * scale / MIB, texts[0])

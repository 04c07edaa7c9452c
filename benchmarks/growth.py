"""How time and memory of a whole process grow with its work: a row a size, and the exponent between two sizes.

A table is printed by each of the programs `growth_*.py`; a limit stands beside the size that it is meant for. Nothing
here fails on a slow machine: what is missed is printed with NO.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PIPELINE = [sys.executable, "-c", "from pipeline.shell.cli import run; run()"]

MIB = 1 << 20


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


@dataclass(frozen=True)
class Cost:
    """Wall time [s], processor time [s] and peak memory of the largest process [MiB] of one run."""

    seconds: float
    processor: float
    mebibytes: float


def cost(work: Work) -> Cost:
    """Run a command in a process of its own, with one thread for linear algebra."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryFile() as told:
        began = time.perf_counter()
        process = subprocess.Popen(work.command, cwd=work.folder, env=environment, stdout=told, stderr=told)
        _, status, used = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in (0, 3):
            told.seek(0)
            sys.exit(f"{' '.join(work.command)}: status {process.returncode}\n{told.read().decode()[-2000:]}")
    return Cost(seconds, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / MIB)


def table(title: str, unit: str, works: Sequence[Work]) -> list[tuple[Work, Cost]]:
    """Print a table while it is measured, and return its rows: time and memory by size, with exponents and limits."""
    print(f"\n{title}")
    print(f"{unit:>14} {'time s':>9} {'cpu s':>9} {'MiB':>8} {'time ~':>7} {'memory ~':>8}  wanted", flush=True)
    rows: list[tuple[Work, Cost]] = []
    for work in works:
        spent = cost(work)
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

"""Run times of functions and of whole processes."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable

REPEATS = 5


def fastest(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the smallest of several run times [s], after one run to warm up."""
    work()
    return min(once(work) for _ in range(repeats))


def once(work: Callable[[], object]) -> float:
    """Return one run time [s]."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def run(command: list[str]) -> None:
    """Run a command with one thread for linear algebra, its output thrown away."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

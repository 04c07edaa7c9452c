"""Theory by REST: in a process of its own, which is ended where it takes too long."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.device_data.devices import find_experiment, load_device
from pipeline.loop.loop import Loop
from pipeline.records.criteria import CRITERIA, with_discrete
from pipeline.service.problems import Problem
from pipeline.theory import cases as device_cases
from pipeline.theory.cases import Cases, DeviceCase, boundary_document, optimum_document, point_costs
from pipeline.theory.optimum import POINT_CRITERIA

LONGEST_DELAY = 64.0
"""Samples; longer delays are for the command line."""

WAIT_S = 2.0
"""Time that a request waits for another one [s]: those that wait keep others from being answered."""

MOST_POINTS = 500

OPTIMA = (*POINT_CRITERIA, *with_discrete(CRITERIA))
"""Criteria that have an optimum."""


class Theory:
    """Computes one thing at a time.

    Parameters
    ----------
    most_s : float
        Longest time [s].
    """

    def __init__(self, most_s: float) -> None:
        self.most_s = most_s
        self._lock = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None

    def compute(self, function: Callable[..., Any], *values: Any) -> Any:
        """Return what a function of this module returns; an error of the values passes."""
        if not self._lock.acquire(timeout=WAIT_S):
            raise Problem(503, "Theory is computed for others; ask again.", where="theory")
        try:
            if self._pool is None:
                self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
            return self._pool.submit(function, *values).result(self.most_s)
        except (TimeoutError, BrokenProcessPool) as error:
            self._end()
            more = "Use the command line, or a shorter delay or fewer points."
            raise Problem(504, f"This was not computed in {self.most_s:g} s. {more}", where="theory") from error
        finally:
            self._lock.release()

    def stop(self) -> None:
        """End the process."""
        with self._lock:
            self._end()

    def _end(self) -> None:
        if self._pool is not None:
            for process in list((self._pool._processes or {}).values()):
                process.kill()
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None


def boundary(gamma: float, delta: float, delay: float) -> dict[str, Any]:
    """Return the document of `theory boundary`."""
    return boundary_document(Loop(gamma, delta, delay))


def optimum(gamma: float, delta: float, delay: float, criterion: str, signal: str | None) -> dict[str, Any]:
    """Return the document of `theory optimum`."""
    return optimum_document(Loop(gamma, delta, delay), criterion, signal)


def points(rows: list[tuple[float, ...]]) -> list[dict[str, Any]]:
    """Return the document of `theory points` for rows of alpha, beta, gamma, delta, delay."""
    values = np.array(rows, dtype=np.float64)
    return point_costs(Cases(Path("points"), values, tuple(range(1, len(rows) + 1))))


def of_device(what: str, device: str, experiment: str | None, *values: Any) -> Any:
    """Return the document of a theory command with ``--device``: in SI."""
    known = load_device(device)
    case = DeviceCase(known, find_experiment(known, experiment) if experiment else known.experiments[0])
    if what == "boundary":
        return device_cases.device_boundary(case)
    if what == "optimum":
        criterion, signal = values
        return optimum_document(case.loop, criterion, signal, case.units, **case.names)
    walls = np.array(values[0], dtype=np.float64)
    return device_cases.wall_documents(case, Cases(Path("points"), walls, tuple(range(1, len(walls) + 1))))

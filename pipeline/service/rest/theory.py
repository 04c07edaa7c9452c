"""REST of theory: ``/api/v1/theory/...``; with a device in SI, else normalised.

It is computed in a process of its own, which is ended where it takes too long.
"""

import multiprocessing
import threading
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Depends, Query

from pipeline.base.errors import ParameterError
from pipeline.device_data.devices import find_experiment, load_device
from pipeline.loop.loop import Loop
from pipeline.records.criteria import CRITERIA, with_discrete
from pipeline.service.problems import Problem
from pipeline.service.rest import answers
from pipeline.service.rest.api import FiniteNumber, Name
from pipeline.service.shared import Shared
from pipeline.theory.cases import LARGEST, Case, boundary_document, case_of, optimum_document, point_documents
from pipeline.theory.optimum import POINT_CRITERIA

theories = APIRouter(prefix="/api/v1/theory", responses={**answers.EVERYWHERE, **answers.problems(404, 504)})

LONGEST_DELAY, MOST_POINTS = 64.0, 500
"""Samples, and walls; more is for the command line."""

OPTIMA = (*POINT_CRITERIA, *with_discrete(CRITERIA))
"""Criteria that have an optimum."""

Coefficient = Annotated[float, Query(allow_inf_nan=False)]
Coordinates = Annotated[list[FiniteNumber], Query(max_length=MOST_POINTS)]
Delay = Annotated[float | None, Query(ge=0, le=LONGEST_DELAY, description="Delay in samples, without a device.")]
Device = Annotated[Name | None, Query(description="Name of a device; all is then in SI, for its experiment.")]

WAIT_S = 2.0
"""Time that a request waits for another one [s]: those that wait keep others from being answered."""


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

    def compute(self, *asked: Any) -> Any:
        """Return a document of theory (see `document`); an error of the values passes."""
        if not self._lock.acquire(timeout=WAIT_S):
            raise Problem(503, "Theory is computed for others; ask again.", where="theory")
        try:
            if self._pool is None:
                self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
            return self._pool.submit(document, *asked).result(self.most_s)
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


def document(what: str, of: tuple[str, str | None] | tuple[float, float, float], *values: Any) -> Any:
    """Return the document of ``theory boundary``, ``optimum`` or ``points``.

    Parameters
    ----------
    what : str
    of : tuple
        Device and experiment (None: its first), or gamma, delta and delay of a normalised loop.
    values
        Criterion and signal of an optimum; walls as pairs, in SI or normalised.
    """
    if len(of) == 3:
        case = Case(Loop(*of))
    else:
        device = load_device(of[0])
        case = case_of(device, find_experiment(device, of[1]) if of[1] else device.experiments[0])
    if what != "points":
        return boundary_document(case) if what == "boundary" else optimum_document(case, *values)
    walls = np.array(values[0], dtype=np.float64)
    if np.abs(walls).max() > LARGEST:
        raise ParameterError(f"{' or '.join(case.axes)}: expected at most {LARGEST:g}.")
    return point_documents(case, walls)


def loop_of(
    delay: Delay = None,
    gamma: Coefficient = 0.0,
    delta: Coefficient = 0.0,
    device: Device = None,
    experiment: Name | None = None,
) -> tuple[Any, ...]:
    """Return which loop is asked for, as `theory.document` takes it."""
    if device is None:
        if delay is None:
            raise Problem(422, "Give the delay in samples, or a device.", where="delay")
        return gamma, delta, delay
    if delay is not None or gamma or delta:
        raise Problem(422, "A device has a delay, gamma and delta of its own. Leave these out.", where="device")
    return device, experiment


Of = Annotated[tuple[Any, ...], Depends(loop_of)]


@theories.get("/boundary", response_model=dict[str, Any])
def boundary(service: Shared, of: Of) -> Any:
    """Return the stability boundary, as `pipeline theory boundary --json`."""
    return service.theory.compute("boundary", of)


@theories.get("/optimum", response_model=dict[str, Any])
def optimum(
    service: Shared,
    of: Of,
    criterion: Literal[OPTIMA],  # type: ignore[valid-type]
    signal: Literal["continuous", "discrete"] | None = None,
) -> Any:
    """Return the point of least cost by a criterion, as `pipeline theory optimum --json`."""
    return service.theory.compute("optimum", of, criterion, signal)


@theories.get("/points", response_model=list[dict[str, Any]])
def points(
    service: Shared,
    of: Of,
    alpha: Coordinates = [],  # noqa: B006
    beta: Coordinates = [],  # noqa: B006
    stiffness: Coordinates = [],  # noqa: B006
    damping: Coordinates = [],  # noqa: B006
) -> Any:
    """Return stability and costs of points: alpha and beta, or with a device stiffness and damping."""
    names = "stiffness, damping" if len(of) == 2 else "alpha, beta"
    first, second = (stiffness, damping) if len(of) == 2 else (alpha, beta)
    if len(first) != len(second) or not first:
        raise Problem(422, f"Each point needs {names.replace(',', ' and')}.", where=names)
    return service.theory.compute("points", of, list(zip(first, second, strict=True)))

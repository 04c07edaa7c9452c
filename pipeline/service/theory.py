"""Compute theory in a separate process, which is terminated if it takes too long."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.isolated import IsolationError, run_isolated
from pipeline.device_data.devices import find_experiment, load_device
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.service.problems import Problem
from pipeline.theory.cases import LARGEST, Case, best_wall, case_of, costs_of_walls, limits_of_walls

WAIT_S = 2.0
"""Longest time for which a request waits while another request is computed [s]. Waiting requests block threads."""


class Theory:
    """Process that computes one request at a time.

    Parameters
    ----------
    most_s : float
        Longest time [s].
    """

    def __init__(self, most_s: float) -> None:
        self.most_s = most_s
        self._lock = threading.Lock()

    def compute(self, *asked: Any) -> Any:
        """Return a document of theory (see `document`). Errors due to the given values are raised again."""
        if not self._lock.acquire(timeout=WAIT_S):
            raise Problem(503, "The server is computing theory for other users. Try again later.", where="theory")
        try:
            return run_isolated(f"{__name__}:{document.__name__}", *asked, wait_s=self.most_s)
        except IsolationError as error:
            more = "Use the command line, or a shorter delay or fewer points."
            raise Problem(504, f"The computation took longer than {self.most_s:g} s. {more}", where="theory") from error
        finally:
            self._lock.release()


def case_of_loop(of: Sequence[Any]) -> Case:
    """Return the loop of a device and an experiment, or of gamma, delta and delay.

    If the experiment is None, the first experiment of the device is used.
    """
    if len(of) == 3:
        return Case(NormalisedLoop.ideal(*of))
    device = load_device(of[0])
    return case_of(device, find_experiment(device, of[1]))


def document(what: str, of: Sequence[Any], *values: Any) -> Any:
    """Return the document of ``theory boundary``, ``optimum`` or ``points``.

    Parameters
    ----------
    what : str
    of : sequence
        Argument of `case_of_loop`.
    values
        Criterion and signal for an optimum, or walls as pairs for points, in SI units or normalised.
    """
    case = case_of_loop(of)
    if what != "points":
        return (limits_of_walls(case) if what == "boundary" else best_wall(case, *values)).to_json()
    walls = np.array(values[0], dtype=np.float64)
    if np.abs(walls).max() > LARGEST:
        raise ParameterError(f"{' or '.join(case.axes)}: expected at most {LARGEST:g}.")
    return costs_of_walls(case, walls).to_json()

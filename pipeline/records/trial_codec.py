"""Responses as few bytes: rows that can be seen, whole numbers of a small step, predicted from their past, packed.

A response of 400 samples takes 200 bytes so, a JSON list of its positions 4,000. What is lost cannot be seen: rounding
moves a line by a quarter of a pixel, and rows are left out only where several fall into one column of pixels.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers

LEVELS = 500
"""Steps into which the range of a response is divided: a plot is 250 pixels high, half a step is a quarter of one."""

COLUMNS = 700
"""Columns of pixels of the plot: what a wide screen leaves for it."""

WHOLE = 30
"""Samples from the command edge on that are all kept: delay and onset are read from them."""


LAGS = (1, 2, 3, 4)
"""Samples before that predict one: two oscillations, or one with drift and offset; more save nothing."""

UNWRITTEN = 1000
"""Bytes that zlib may hold back, or add to what it cannot make shorter, with a margin."""

EFFORT = 7
"""Level of the compression: 9 takes eight times as long for 6 % fewer bytes."""

PARTS = 4096
"""Parts of one in which coefficients are written: a power of two, by which a browser divides exactly."""


def visible_rows(signals: tuple[Floats, ...], edge: int, rows: int) -> Integers | None:
    """Return the rows that a plot of some signals needs, or None where it needs all of them.

    Parameters
    ----------
    signals : tuple of float64, shape (N,) each
        Drawn over the same rows; NaN where there is nothing.
    edge, rows : int
        Row of the command edge, and number of rows.

    Notes
    -----
    Of the rows in one column of pixels the lowest and highest value of each signal remain, and the first and last row
    of all: what is drawn covers the same pixels. Rejected: every n-th row (loses peaks), largest triangles (Steinarsson
    2013; a smoother line from fewer points, but of an oscillation faster than the pixels it keeps no envelope).
    """
    if rows <= COLUMNS + WHOLE:
        return None
    inside = np.arange(rows)
    column = inside * COLUMNS // rows
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    kept = [np.array([0, rows - 1]), inside[edge : edge + WHOLE]]
    width = int(np.diff(starts, append=rows).max())
    place = np.minimum(starts[:, None] + np.arange(width), np.append(starts[1:], rows)[:, None] - 1)
    for signal in signals:
        values = signal[:rows][place]
        known = np.isfinite(values)
        for extreme, filled in (
            (np.argmin, np.where(known, values, np.inf)),
            (np.argmax, np.where(known, values, -np.inf)),
        ):
            best = extreme(filled, axis=1)
            kept.append(place[np.arange(len(place)), best][known.any(axis=1)])
    return np.unique(np.concatenate(kept))


def step_size(values: Floats, quantum: float) -> float:
    """Return the step in whose multiples values are written: a sensor's quantum, or a part of the range if larger."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 1.0
    return max(float(np.ptp(known)) / LEVELS, quantum) or 1.0


def code(values: Floats, step: float) -> dict[str, list[int]] | None:
    """Return a signal in steps as what a prediction from its past misses; None for a signal without any value.

    Parameters
    ----------
    values : float64, shape (N,)
        A value that is not finite repeats the one before.
    step : float

    Returns
    -------
    dict
        ``c``: coefficients of the four samples before, the latest first, in parts of `PARTS`; ``r``: value minus
        prediction [steps]. All are integers, so that a browser finds the same ones.

    Notes
    -----
    A response of the loop is a sum of few decaying oscillations, each of which two samples predict. Rejected: second
    differences (twice the bytes for an oscillation); the model simulated in the page (a second definition of the loop).
    """
    known: Booleans = np.isfinite(values)
    if not known.any():
        return None
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), 0))
    counted = np.rint(np.nan_to_num(values[last]) / step).astype(np.int64)
    past = np.stack([np.concatenate([np.zeros(lag, np.int64), counted])[: len(counted)] for lag in LAGS], axis=1)
    # the first samples have no past: they would bend the coefficients
    fitted = np.linalg.lstsq(past[len(LAGS) :].astype(float), counted[len(LAGS) :].astype(float), rcond=None)[0]
    coefficients = np.rint(fitted * PARTS).astype(np.int64)
    missed = counted - (past @ coefficients + PARTS // 2) // PARTS
    return {"c": coefficients.tolist(), "r": missed.tolist()}


def pack(content: Any) -> str:
    """Return a JSON value as deflated text in base64, which a browser unpacks by itself (``DecompressionStream``)."""
    return base64.b64encode(zlib.compress(_json(content), EFFORT)).decode()


def unpack(packed: str) -> Any:
    """Return what `pack` packed."""
    return json.loads(zlib.decompress(base64.b64decode(packed)))


def pack_within(entries: Iterable[Any], budget: int | None, most: int | None = None) -> tuple[str, int]:
    """Pack a list as `pack` does, as many of its first entries as a budget allows; return it and their number.

    Parameters
    ----------
    entries : iterable
        JSON values; those beyond the budget are not asked for, but for one.
    budget : int or None
        Largest number of characters; None takes all. An empty list is packed whatever the budget.
    most : int, optional
        Largest number of entries; by default the budget alone says how many.
    """
    most_characters = math.inf if budget is None else budget
    deflate, count = zlib.compressobj(EFFORT), 0
    done, waiting = bytearray(deflate.compress(b"[")), 1
    for entry in islice(entries, most):
        content = (b"," if count else b"") + _json(entry)
        waiting += len(content)
        before, size = None, len(done) + waiting + waiting // 100 + UNWRITTEN
        if _characters(size) > most_characters:  # it may not fit: only the closed stream tells
            before = deflate.copy()
        more = deflate.compress(content)
        if before is not None:
            closed = deflate.copy()
            if _characters(len(done) + len(more) + len(closed.compress(b"]") + closed.flush())) > most_characters:
                deflate = before
                break
        done += more
        waiting = len(content) if more else waiting
        count += 1
    if not count:
        return pack([]), 0
    return base64.b64encode(done + deflate.compress(b"]") + deflate.flush()).decode(), count


def _characters(size: int) -> int:
    """Length of so many bytes in base64."""
    return 4 * -(-size // 3)


def _json(content: Any) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False, ensure_ascii=True).encode()


@dataclass(frozen=True)
class TrialPage:
    """Trials of all experiments of a report.

    Parameters
    ----------
    content : dict
        What the page's script reads: plain JSON values, with the trials of each experiment packed (see `trial_codec`).
    trials, responses : int
        Number of trials, and of those whose response is in the page.
    places : dict
        ``(experiment, trial id)`` to the trial's reference in the page.
    limits : dict
        ``(experiment, damping, stiffness)`` to the reference of the trial that stands in the boundary there; the
        stiffness is that of the table of limits.
    """

    content: dict[str, Any]
    trials: int
    responses: int
    places: dict[tuple[str, str], str] = field(default_factory=dict)
    limits: dict[tuple[str, float, float], str] = field(default_factory=dict)

    def place(self, experiment: str | None, trial_id: str | None) -> str:
        """Return how tables refer to a trial; empty where the page does not show it."""
        return self.places.get((experiment or "", trial_id or ""), "")


NO_TRIALS = TrialPage({}, 0, 0)
"""Of a report without trials."""


def reference(experiment: int, trial: int) -> str:
    """Return how cells and addresses refer to a trial: numbers of experiment and trial in the page, from 0."""
    return f"{experiment}-{trial}"

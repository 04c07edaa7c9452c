"""By which factors step and wall in a logged command are other than its header says: a wrong unit, or a wrong sign."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.law.log_rows import LogRows
from pipeline.records.batch import Floats

SCALE_TOLERANCE = 0.2
"""Part by which the factor between two units may be off in a log whose velocity is filtered or clipped."""

TOLD = 0.05
"""Part of the largest command that the wall makes, from which on its factor is told."""

UNTOLD = 0.1
"""Part of the squared command that step and wall may leave unexplained."""


def fit(terms: Floats, command: Floats) -> Floats:
    """Return the factors of terms, shape (N, terms), whose sum is nearest to the command; 0 for a term of zeros."""
    size = np.abs(terms).max(axis=0)
    used = size > 0
    solution, *_ = np.linalg.lstsq(terms[:, used] / size[used], command, rcond=None)
    values = np.zeros(len(size))
    values[used] = solution / size[used]
    return values


@dataclass(frozen=True)
class Scale:
    """By which factors the step and the force of the wall in a logged command are other than those of its header."""

    step: float
    wall: float


def power_of_ten(factor: float) -> bool:
    """Return whether a factor is 10, 100, 0.1 and the like, up to `SCALE_TOLERANCE` and the sign."""
    power = 10.0 ** np.rint(np.log10(abs(factor))) if factor else 1.0
    return bool(power != 1.0 and abs(abs(factor) / power - 1) <= SCALE_TOLERANCE)


def scale_in(log: LogRows) -> Scale | None:
    """Return the factors of a log, None where they do not explain its command, or too little of it is of the wall."""
    terms = np.stack([log.step * log.after, -log.wall], axis=1)
    values = fit(terms, log.command)
    left = log.command - np.matmul(terms, values)
    share = np.abs(values[1] * terms[:, 1]).max() / np.abs(log.command).max(initial=np.finfo(np.float64).tiny)
    told = share > TOLD and float(left @ left) <= UNTOLD * float(log.command @ log.command)
    return Scale(*map(float, values)) if told else None

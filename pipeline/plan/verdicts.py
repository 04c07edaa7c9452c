"""What the verdicts of trials alone say of the limit at one damping."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.records.batch import Booleans, Floats

VOTES = 3
"""Trials of one wall after which a contradiction is no chance: most of them decide; as many undecided ones, requests
that a rig answers by other walls, or costs of one wall are enough."""


@dataclass(frozen=True, eq=False)
class Tried:
    """Trials so far, a row each.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
        K > 0 [N/m, Nm/rad] and B [Ns/m, Nms/rad].
    verdict : array of str, shape (n,)
        ``stable``, ``unstable`` or ``undecided``, as `measured.signal.verdict.judge` says.
    growth : float64, shape (n,)
        Growth rate of the slowest visible mode [1/s], NaN where it is not told.
    force : float64, shape (n,)
        Largest absolute command [N, Nm], NaN where it does not matter.
    cost : float64, shape (n,)
        Cost by the criterion of the goal, NaN where there is none.
    """

    stiffness: Floats
    damping: Floats
    verdict: np.ndarray
    growth: Floats
    force: Floats = field(default_factory=lambda: np.empty(0))
    cost: Floats = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        for name in ("force", "cost"):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.full(len(self.stiffness), np.nan))
        lengths = {len(column) for column in vars(self).values()}
        if len(lengths) > 1:
            raise ParameterError(f"trials with columns of {sorted(lengths)} rows: expected one value each per trial.")

    def __len__(self) -> int:
        return len(self.stiffness)

    def select(self, rows: Booleans) -> Tried:
        """Return some of the trials."""
        return Tried(**{name: column[rows] for name, column in vars(self).items()})


@dataclass(frozen=True)
class Bracket:
    """Where the limit of one damping lies by verdicts.

    Parameters
    ----------
    low, high : float or None
        Stiffest stable and softest unstable wall that enclose it [N/m, Nm/rad]; None where none was tried.
    again : tuple of float
        Stiffness of walls whose verdicts contradict others and that must be tried again, those of fewest trials first.
    lasting : bool
        Whether stable walls lie above unstable ones although each was tried `VOTES` times.
    trials : int
    """

    low: float | None = None
    high: float | None = None
    again: tuple[float, ...] = ()
    lasting: bool = False
    trials: int = 0

    @property
    def bottom(self) -> float:
        """Lower end, 0 where no wall was stable: without stiffness there is no wall."""
        return 0.0 if self.low is None else self.low

    @property
    def top(self) -> float:
        """Upper end, infinite where no wall was unstable."""
        return inf if self.high is None else self.high


def bracket(stiffness: Floats, verdict: np.ndarray, width: float = 0.0) -> Bracket:
    """Return where the limit of one damping lies.

    Parameters
    ----------
    stiffness : float64, shape (n,)
    verdict : array of str, shape (n,)
    width : float
        Contradictions within this range of K [N/m, Nm/rad] are the chance of the limit itself, and no reason to repeat.

    Notes
    -----
    A wall counts as what most of its trials say, and not at all where they are even or undecided. Where a stable wall
    lies above an unstable one, low and high enclose both, until each of them was tried `VOTES` times. What contradicts
    itself then has several limits (a mode, friction), of which the lowest counts.

    Examples
    --------
    >>> bracket(np.array([1000.0, 2000.0, 3000.0]), np.array(["stable", "undecided", "unstable"]))
    Bracket(low=1000.0, high=3000.0, again=(), lasting=False, trials=3)
    >>> bracket(np.array([1000.0, 2000.0, 3000.0]), np.array(["stable", "unstable", "stable"])).again
    (2000.0, 3000.0)
    """
    walls, column = np.unique(stiffness, return_inverse=True)
    votes = np.zeros(len(walls))
    tried = np.zeros(len(walls), dtype=np.int64)
    np.add.at(votes, column, np.where(verdict == "unstable", 1.0, np.where(verdict == "stable", -1.0, 0.0)))
    np.add.at(tried, column, 1)
    stable, unstable = walls[votes < 0], walls[votes > 0]
    low, high = stable.max(initial=-inf), unstable.min(initial=inf)
    again: tuple[float, ...] = ()
    lasting = False
    if low > high:
        doubtful = (walls >= high) & (walls <= low) & (tried < VOTES)
        if low - high > width and doubtful.any():
            order = np.flatnonzero(doubtful)[np.argsort(tried[doubtful], kind="stable")]
            again = tuple(walls[order].tolist())
        lasting = low - high > width and not again
        if lasting:
            low = stable[stable < high].max(initial=-inf)
        else:
            low, high = stable[stable < high].max(initial=-inf), unstable[unstable > low].min(initial=inf)
    return Bracket(
        low=float(low) if np.isfinite(low) else None,
        high=float(high) if np.isfinite(high) else None,
        again=again,
        lasting=lasting,
        trials=len(stiffness),
    )

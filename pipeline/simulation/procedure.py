"""Order in which a lab tests pairs (K, B). Coarse steps lead up to the first unstable trial, and fine steps follow.

The ladders of several dampings are climbed in parallel. Trials are simulated in waves. Trials after the first unstable
trial are discarded, so that the result equals the result of sequential testing.

Source: Hulin 2017, sec. 6.1.1, and sec. 6.1.2 for the trials without stiffness.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import ParameterError
from pipeline.records.trials import Floats, Integers, Trial, Trials

Strings = NDArray[np.str_]

FINE_STEPS = 5
"""Number of fine steps per coarse step. A fine step is 20 % of a coarse step (6.1.1)."""

WAVE = 12
"""Number of trials that are simulated in advance for each damping. A smaller number requires more runs of the
simulator, and a larger number discards more trials."""

LONGEST_CLIMB = 2000
"""Largest number of stiffness steps at one damping. The stiffest column of the thesis needs 65."""

AT_ZERO_STIFFNESS = 1 << 30
"""Column index of the trials with K = 0, which follow the trials of all dampings."""


@dataclass(frozen=True)
class _Ladder:
    """Pairs (K, B) in the order of testing. Rung i is at ``origin + i * stride`` fine steps of K or of -B."""

    column: int
    damping: float | None
    origin: int
    stride: int
    last: int | None

    @property
    def number(self) -> int:
        """Number of the pass over the column. It is 1 for coarse steps and 2 for fine steps."""
        return 1 if self.stride == FINE_STEPS else 2


@dataclass
class Climb:
    """Parallel test of several ladders. The trials of a ladder are kept up to and including the first unstable trial.

    Parameters
    ----------
    run : callable
        Function of stiffness [N/m, Nm/rad] and damping [Ns/m, Nms/rad], both of shape (n,), that returns the trials
        and their verdicts.
    stiffness_step, damping_step : float
        Coarse step of K at a fixed damping, and coarse step of -B at K = 0.
    lowest_damping : float
        Largest value of -B that is tested at K = 0. Without this bound, tests might not end, because friction or a
        force limit may keep a device at rest for any B.
    progress : callable or None
        Function that is called with the number of trials kept so far.
    kept, verdicts, order : list
        The kept trials, their verdicts and their places (column, pass, rung).
    """

    run: Callable[[Floats, Floats], tuple[Trials, Strings]]
    stiffness_step: float
    damping_step: float
    lowest_damping: float
    progress: Callable[[int], None] | None
    kept: list[Trial] = field(default_factory=list)
    verdicts: list[str] = field(default_factory=list)
    order: list[tuple[int, int, int]] = field(default_factory=list)

    def columns(self, dampings: Sequence[float | None]) -> None:
        """Run the coarse and the fine pass of columns. A column is given by its damping B, or by None for K = 0.

        Raises
        ------
        ParameterError
            If no unstable trial is found within `LONGEST_CLIMB` steps.
        """
        last = ceil(self.lowest_damping / self.damping_step) + 1
        coarse = [
            # The first rung at K = 0 is B = 0. At a fixed damping, it is the first step of K.
            _Ladder(AT_ZERO_STIFFNESS, None, -FINE_STEPS, FINE_STEPS, last)
            if damping is None
            else _Ladder(column, damping, 0, FINE_STEPS, None)
            for column, damping in enumerate(dampings)
        ]
        reached = self._climb(coarse)
        fine = [
            replace(ladder, origin=ladder.origin + FINE_STEPS * int(rung), stride=1, last=FINE_STEPS - 1)
            for ladder, rung in zip(coarse, reached, strict=True)
        ]
        self._climb(fine)

    def _climb(self, ladders: Sequence[_Ladder]) -> Integers:
        """Test ladders in waves, and return the number of trials before the first unstable trial of each ladder."""
        reached = np.zeros(len(ladders), dtype=np.int64)
        ahead = list(range(len(ladders)))
        below = 0
        while ahead:
            last = ladders[ahead[0]].last
            rungs = np.arange(below, min(below + WAVE, last or below + WAVE)) + 1
            pairs = np.concatenate([self._pairs(ladders[i], rungs) for i in ahead])
            trials, verdict = self.run(pairs[:, 0], pairs[:, 1])
            unstable = (verdict == "unstable").reshape(len(ahead), len(rungs))
            first = np.where(unstable.any(axis=1), unstable.argmax(axis=1), len(rungs))
            keep = (np.arange(len(rungs)) <= first[:, None]).ravel()
            place = [(ladders[i].column, ladders[i].number, rung) for i in ahead for rung in rungs.tolist()]
            for number in np.flatnonzero(keep).tolist():
                self.kept.append(trials[number])
                self.verdicts.append(str(verdict[number]))
                self.order.append(place[number])
            reached[ahead] += first
            below = int(rungs[-1])
            if self.progress is not None:
                self.progress(len(self.kept))
            ahead = [i for i, n in zip(ahead, first, strict=True) if n == len(rungs) and below != last]
            if ahead and below >= LONGEST_CLIMB:
                K, B = self._pairs(ladders[ahead[0]], rungs[-1:])[0]
                raise ParameterError(
                    f"no unstable trial after {below} steps (K = {K:g}, B = {B:g}); expected an unstable trial "
                    "much earlier. Choose larger steps in the device file."
                )
        return reached

    def _pairs(self, ladder: _Ladder, rungs: Integers) -> Floats:
        steps = ladder.origin + ladder.stride * rungs
        if ladder.damping is None:
            return np.stack((np.zeros(len(rungs)), 0.0 - steps * self.damping_step / FINE_STEPS), axis=1)
        return np.stack((steps * self.stiffness_step / FINE_STEPS, np.full(len(rungs), ladder.damping)), axis=1)

    def result(self) -> tuple[list[Trial], Integers, Strings]:
        """Return the trials, their passes and their verdicts in the order of testing."""
        order = sorted(range(len(self.order)), key=self.order.__getitem__)
        passes = np.array([self.order[i][1] for i in order], dtype=np.int64)
        return [self.kept[i] for i in order], passes, np.array([self.verdicts[i] for i in order], dtype=np.str_)

"""What a rig was asked for and what it set: its steps, range or scale of K, and its dampings."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, floor, inf
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from pipeline.base.disk import if_writable, read_result, write_result
from pipeline.records.findings import Record
from pipeline.records.trials import Floats
from pipeline.store.storage import stage_folder

ASKED = "asked"
"""Stem of the file, next to the results of an experiment, with what was asked for."""

Wall = tuple[float, float]
"""K [N/m, Nm/rad] and B [Ns/m, Nms/rad]."""

OFF = 1e-4
"""Difference of a wall from the one that was asked for, relative to it, up to which it is the same."""

FARTHEST = 3.0
"""Largest ratio of a stiffness and the one that answers to it, where there are more trials than were asked for."""

EXACT = 1e-6
"""Difference of stiffnesses, relative to the largest, up to which one is a multiple of another."""

MOST_PARTS = 40
"""Parts of the common divisor of all stiffnesses that may be the step of a rig."""

SCALE = 0.005
"""Difference of ratios up to which a rig scales by one factor."""

MIN_ANSWERS = 2
"""Answered walls that show how a rig sets its gains; also, how often an end of a bracket may be answered instead of a
wall inside, without a step that explains it, before no wall counts as left."""

STIFFER = 1.3
"""How much more is asked for where the stiffest wall answered for stiffer ones, relative to these."""

COARSE = 1 / 3
"""Step, relative to the stiffest wall that was set, above which that wall is the end of the rig's range instead."""

ROUNDINGS = ("nearest", "down", "up")


class AnsweredWall(Record):
    """A wall that was asked for, and the one that the rig set."""

    asked: Wall
    got: Wall

    @property
    def stiffness_off(self) -> bool:
        """Whether the rig set another stiffness."""
        return abs(self.got[0] - self.asked[0]) > OFF * self.asked[0]

    @property
    def damping_off(self) -> bool:
        """Whether the rig set another damping."""
        return abs(self.got[1] - self.asked[1]) > OFF * max(self.asked[1], self.got[1])


class Requests(Record):
    """Walls of the last plan, the walls of the trials that it knew with their numbers, and all answers before."""

    walls: tuple[Wall, ...] = ()
    trials: tuple[tuple[float, float, int], ...] = ()
    answers: tuple[AnsweredWall, ...] = ()

    def answered(self, tried: Iterable[Wall]) -> tuple[AnsweredWall, ...]:
        """Return all answers, with those of trials that came since: each to the nearest wall that was asked for."""
        new = Counter(tried)
        new.subtract({(K, B): count for K, B, count in self.trials})
        came, left = sorted((+new).elements()), list(self.walls)
        found = [*self.answers]
        far = FARTHEST if len(came) > len(left) else inf
        apart = sorted((_apart(asked, got, far), i, j) for i, asked in enumerate(left) for j, got in enumerate(came))
        used: tuple[set[int], set[int]] = (set(), set())
        for distance, i, j in apart:
            if np.isfinite(distance) and i not in used[0] and j not in used[1]:
                used[0].add(i)
                used[1].add(j)
                found.append(AnsweredWall(asked=left[i], got=came[j]))
        return tuple(found)


def _apart(asked: Wall, got: Wall, far: float) -> float:
    """Return how far a wall is from one that was asked for; infinite where it is no answer to it."""
    low, high = sorted((asked[0], got[0]))
    if not high <= far * low and far < inf:
        return inf
    return (high - low) / max(high, 1e-300) + abs(got[1] - asked[1]) / max(asked[1], got[1], 1e-300)


def stored_requests(processed: Path, device: str, experiment: str) -> Requests:
    """Return what was asked for in an experiment; nothing where nothing is stored, or it is damaged."""
    data = read_result(stage_folder(processed, device, experiment), ASKED, ".json")
    try:
        return Requests.model_validate_json(data or b"{}")
    except ValidationError:
        return Requests()


def store_requests(
    processed: Path,
    device: str,
    experiment: str,
    walls: Iterable[Wall],
    tried: Iterable[Wall],
    answers: Sequence[AnsweredWall],
) -> None:
    """Store what is asked for now; nothing where the store may only be read."""
    counted = tuple((K, B, count) for (K, B), count in sorted(Counter(tried).items()))
    requests = Requests(walls=tuple(walls), trials=counted, answers=tuple(answers))
    if requests == stored_requests(processed, device, experiment):
        return
    data = json.dumps(requests.model_dump(mode="json"), allow_nan=False).encode()
    with if_writable():
        write_result(stage_folder(processed, device, experiment), ASKED, ".json", data)


@dataclass(frozen=True)
class GainGrid:
    """Stiffnesses that a rig sets: multiples of a step [N/m, Nm/rad], and how it rounds to them."""

    step: float
    rounding: Literal["nearest", "down", "up"]

    def explains(self, asked: Floats, got: Floats) -> bool:
        """Return whether it answers by the walls that were set."""
        off, rest = got - asked, EXACT * float(got.max())
        if self.rounding == "nearest":
            return bool((np.abs(off) <= 0.5 * self.step + rest).all())
        away = off if self.rounding == "up" else -off
        return bool(((away >= -rest) & (away < self.step - rest)).all())

    def holds(self, wall: float) -> bool:
        """Return whether a stiffness is one of its multiples."""
        return abs(wall - round(wall / self.step) * self.step) <= EXACT * wall

    def nearest(self, wall: float, low: float, high: float) -> float | None:
        """Return the multiple nearest to a wall between two others, without these; None where there is none."""
        slack = EXACT * max(abs(low), self.step)
        first = floor((low + slack) / self.step) + 1
        last = ceil((high - slack) / self.step) - 1 if high < inf else max(first, round(wall / self.step))
        if first > last:
            return None
        return float(min(max(round(wall / self.step), first), last) * self.step)


@dataclass(frozen=True, eq=False)
class RigRange:
    """What a rig sets instead of the stiffness that it is asked for, by its answers.

    Parameters
    ----------
    asked, got : float64, shape (n,)
        Stiffness of all answers [N/m, Nm/rad].
    grids : tuple of GainGrid
        Those that explain them, the finest first; none where it does not round, or in another way.
    factor : float
        What it scales by.
    lowest, highest : float
        Stiffness that it does not go below or above [N/m, Nm/rad].
    exact : bool
        Whether it sets within ``lowest`` and ``highest`` what it is asked for.
    """

    asked: Floats
    got: Floats
    grids: tuple[GainGrid, ...] = ()
    factor: float = 1.0
    lowest: float = 0.0
    highest: float = inf
    exact: bool = False

    @property
    def several(self) -> bool:
        """Whether walls of several stiffnesses were answered, so that the rig's step can be estimated."""
        return len(np.unique(self.asked)) >= MIN_ANSWERS

    def wall(self, wanted: float, low: float, high: float, most: float) -> float | None:
        """Return the stiffness to ask for so that a wall between two others is set; None where the rig sets none.

        Parameters
        ----------
        wanted : float
            Most informative stiffness.
        low, high : float
            Ends of the bracket; 0 and infinite where no wall is one.
        most : float
            Stiffest wall that may be tried. Where the rig sets no softer one inside, a stable one is repeated once.
        """
        if self.exact:
            return wanted
        if self.factor != 1:
            return wanted / self.factor
        if not self.grids or not self.several:
            return self._between(wanted, low, high)
        top, most = min(high, self.highest * (1 + 2 * EXACT)), most * (1 + 2 * EXACT)
        # what was answered by the end of the range is so again
        ends = [float(self.asked[self.got == self.highest].min())] if low * (1 + EXACT) < self.highest < high else []
        if not ends and all(grid.nearest(wanted, low, top) is None for grid in self.grids):
            return None
        if self._repeats(low, top) and top < inf:
            wanted = 0.5 * (low + min(top, most))
        allowed = [grid.nearest(wanted, low, min(top, most)) for grid in self.grids]
        once = low if low > 0 and np.count_nonzero(self.got == low) < MIN_ANSWERS else None
        return next((wall for wall in allowed if wall is not None), ends[0] if ends and self.highest <= most else once)

    def repeated(self, wall: float) -> float:
        """Return the stiffness to ask for so that a wall is set once more."""
        asked = self.asked[np.abs(self.got - wall) <= EXACT * wall]
        return float(asked[-1]) if len(asked) and not self.grids else wall / self.factor

    def _between(self, wanted: float, low: float, high: float) -> float | None:
        """Return a stiffness between those that were answered by the ends of a bracket or beyond."""
        repeats = self._repeats(low, high)
        below = float(self.asked[self.got <= low * (1 + EXACT)].max(initial=0.0))
        above = float(self.asked[self.got >= high * (1 - EXACT)].min(initial=inf))
        if repeats >= MIN_ANSWERS or below >= above:
            return None
        if repeats and above < inf:
            return 0.5 * (max(below, low) + min(above, high))
        if below < wanted < above:
            return wanted
        if above < inf:
            return 0.5 * (below + above)
        return below * min(max(wanted / low, 1.0), STIFFER) if low > 0 else wanted

    def _repeats(self, low: float, high: float) -> int:
        """Return how often the same end answered for a wall inside a bracket."""
        inside = (self.asked > low * (1 + OFF)) & (self.asked < high * (1 - OFF))
        ends = [np.abs(self.got - end) <= EXACT * end for end in (low, high) if end < inf]
        return max((int((inside & at).sum()) for at in ends), default=0)


def range_of(answers: Sequence[AnsweredWall]) -> RigRange | None:
    """Return what a rig sets instead of the stiffness that it is asked for; None where it sets that.

    Examples
    --------
    >>> def rig(*pairs):
    ...     return range_of([AnsweredWall(asked=(asked, 10.0), got=(got, 10.0)) for asked, got in pairs])
    >>> rig((2930.0, 3000.0), (4110.0, 4000.0)).grids[-1]
    GainGrid(step=1000.0, rounding='nearest')
    >>> rig((2930.0, 2930.0), (6200.0, 5000.0), (7000.0, 5000.0)).highest
    5000.0
    >>> rig((2000.0, 2200.0), (3000.0, 3300.0), (4100.0, 4510.0)).factor
    1.1
    """
    if not any(answer.stiffness_off for answer in answers):
        return None
    asked, got = (np.array([getattr(answer, name)[0] for answer in answers]) for name in ("asked", "got"))
    limited = _limited(asked, got)
    grids = grids_of(asked, got)
    repeated = limited is not None and len(np.unique(asked[got == limited.highest])) >= MIN_ANSWERS
    if repeated and not (grids and grids[0].step <= COARSE * float(got.max())):
        return limited
    if grids:
        return RigRange(asked, got, grids)
    ratio = got / asked
    if len(np.unique(asked)) >= MIN_ANSWERS and ratio.min() > 0 and np.ptp(ratio) <= SCALE * ratio.min():
        return RigRange(asked, got, factor=float(f"{np.median(ratio):.4g}"))
    return limited or RigRange(asked, got)


def _limited(asked: Floats, got: Floats) -> RigRange | None:
    """Return the range of a rig that sets its end for what is beyond; None where that does not explain the answers."""
    top, bottom = float(got.max()), float(got.min())
    above, below = (got == top) & (asked > top * (1 + OFF)), (got == bottom) & (asked < bottom * (1 - OFF))
    for out in (above, below, above | below):
        inside = ~out
        if not out.any() or not (inside.any() or len(np.unique(asked[above])) >= MIN_ANSWERS):
            continue
        highest, lowest = top if out[above].any() else inf, bottom if out[below].any() else 0.0
        if (np.abs(got - asked)[inside] <= OFF * asked[inside]).all():
            return RigRange(asked, got, lowest=lowest, highest=highest, exact=True)
        if grids := grids_of(asked[inside], got[inside]):
            return RigRange(asked, got, grids, lowest=lowest, highest=highest)
    return None


def grids_of(asked: Floats, got: Floats) -> tuple[GainGrid, ...]:
    """Return the grids that explain answers, the finest first.

    Their steps are the largest common divisor of all stiffnesses that were set, or a part of it.
    """
    step, rest = 0.0, EXACT * float(got.max(initial=0.0))
    for value in got.tolist():
        while value > rest:
            step, value = value, abs(step - round(step / value) * value)
    if step <= 1e3 * rest:
        return ()
    parts = [GainGrid(step / part, rounding) for part in range(MOST_PARTS, 0, -1) for rounding in ROUNDINGS]  # type: ignore[arg-type]
    return tuple(grid for grid in parts if grid.explains(asked, got))

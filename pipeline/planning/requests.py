"""Relate requested walls to the walls that a rig sets, by its steps, its range or scale of K, and its dampings."""

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
"""Stem of the file of requested walls, which is stored with the results of an experiment."""

Wall = tuple[float, float]
"""K [N/m, Nm/rad] and B [Ns/m, Nms/rad]."""

OFF = 1e-4
"""Relative tolerance within which a set wall equals the requested wall."""

FARTHEST = 3.0
"""Largest ratio between the stiffnesses of a request and its answer, if there are more trials than requests."""

EXACT = 1e-6
"""Tolerance, relative to the largest stiffness, within which a stiffness is a multiple of another stiffness."""

MOST_PARTS = 40
"""Largest integer by which the common divisor of all stiffnesses is divided to obtain a possible step of a rig."""

SCALE = 0.005
"""Relative range of the ratios of set to requested stiffness within which the rig counts as scaling by a constant
factor."""

MIN_ANSWERS = 2
"""Smallest number of answered walls that show how a rig sets its gains.

The search ends if a rig sets an end of a bracket this often in place of a wall inside, and no step explains this.
"""

STIFFER = 1.3
"""Largest factor between the next request and earlier requests that the rig answered by its stiffest wall."""

COARSE = 1 / 3
"""Threshold for the step, relative to the stiffest set wall. Above it, this wall counts as the end of the rig's
range."""

ROUNDINGS = ("nearest", "down", "up")


class AnsweredWall(Record):
    """A requested wall, and the wall that the rig set."""

    asked: Wall
    got: Wall

    @property
    def stiffness_off(self) -> bool:
        """Whether the rig set a stiffness other than the requested stiffness."""
        return abs(self.got[0] - self.asked[0]) > OFF * self.asked[0]

    @property
    def damping_off(self) -> bool:
        """Whether the rig set a damping other than the requested damping."""
        return abs(self.got[1] - self.asked[1]) > OFF * max(self.asked[1], self.got[1])


class Requests(Record):
    """Walls of the last plan, the walls of its trials with their counts, and all earlier answers."""

    walls: tuple[Wall, ...] = ()
    trials: tuple[tuple[float, float, int], ...] = ()
    answers: tuple[AnsweredWall, ...] = ()

    def answered(self, tried: Iterable[Wall]) -> tuple[AnsweredWall, ...]:
        """Return all answers, including those by trials after the last plan. Each trial answers the nearest requested
        wall."""
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
    """Return the distance between a tried and a requested wall, or infinity if the trial does not answer the
    request."""
    low, high = sorted((asked[0], got[0]))
    if not high <= far * low and far < inf:
        return inf
    return (high - low) / max(high, 1e-300) + abs(got[1] - asked[1]) / max(asked[1], got[1], 1e-300)


def stored_requests(processed: Path, device: str, experiment: str) -> Requests:
    """Return the requests of an experiment. They are empty if none are stored or the file is damaged."""
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
    """Store the current requests, unless the store is read-only."""
    counted = tuple((K, B, count) for (K, B), count in sorted(Counter(tried).items()))
    requests = Requests(walls=tuple(walls), trials=counted, answers=tuple(answers))
    if requests == stored_requests(processed, device, experiment):
        return
    data = json.dumps(requests.model_dump(mode="json"), allow_nan=False).encode()
    with if_writable():
        write_result(stage_folder(processed, device, experiment), ASKED, ".json", data)


@dataclass(frozen=True)
class GainGrid:
    """Grid of the stiffnesses that a rig sets: multiples of a step [N/m, Nm/rad], with the rounding of requests."""

    step: float
    rounding: Literal["nearest", "down", "up"]

    def explains(self, asked: Floats, got: Floats) -> bool:
        """Return whether the grid explains the walls that were set."""
        off, rest = got - asked, EXACT * float(got.max())
        if self.rounding == "nearest":
            return bool((np.abs(off) <= 0.5 * self.step + rest).all())
        away = off if self.rounding == "up" else -off
        return bool(((away >= -rest) & (away < self.step - rest)).all())

    def holds(self, wall: float) -> bool:
        """Return whether a stiffness is a multiple of the step."""
        return abs(wall - round(wall / self.step) * self.step) <= EXACT * wall

    def nearest(self, wall: float, low: float, high: float) -> float | None:
        """Return the multiple nearest to a wall and strictly between two other walls, or None if there is none."""
        slack = EXACT * max(abs(low), self.step)
        first = floor((low + slack) / self.step) + 1
        last = ceil((high - slack) / self.step) - 1 if high < inf else max(first, round(wall / self.step))
        if first > last:
            return None
        return float(min(max(round(wall / self.step), first), last) * self.step)


@dataclass(frozen=True, eq=False)
class RigRange:
    """Response of a rig to a requested stiffness, estimated from its answers.

    Parameters
    ----------
    asked, got : float64, shape (n,)
        Requested and set stiffness of all answers [N/m, Nm/rad].
    grids : tuple of GainGrid
        Grids that explain the answers, the finest first. Empty if the rig does not round to a grid.
    factor : float
        Scale factor of the rig.
    lowest, highest : float
        Smallest and largest stiffness that the rig sets [N/m, Nm/rad].
    exact : bool
        Whether the rig sets requested walls exactly between ``lowest`` and ``highest``.
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
        """Whether the rig answered requests of several stiffnesses, from which its step can be estimated."""
        return len(np.unique(self.asked)) >= MIN_ANSWERS

    def wall(self, wanted: float, low: float, high: float, most: float) -> float | None:
        """Return the stiffness to request so that a wall between two others is set, or None if the rig sets no wall
        there.

        Parameters
        ----------
        wanted : float
            Most informative stiffness.
        low, high : float
            Ends of the bracket. They are 0 and infinity where no wall bounds the bracket.
        most : float
            Stiffest permitted wall. If the rig sets no softer wall inside, a stable wall is repeated once.
        """
        if self.exact:
            return wanted
        if self.factor != 1:
            return wanted / self.factor
        if not self.grids or not self.several:
            return self._between(wanted, low, high)
        top, most = min(high, self.highest * (1 + 2 * EXACT)), most * (1 + 2 * EXACT)
        # The rig would answer again by the end of its range any request that it answered in this way before.
        ends = [float(self.asked[self.got == self.highest].min())] if low * (1 + EXACT) < self.highest < high else []
        if not ends and all(grid.nearest(wanted, low, top) is None for grid in self.grids):
            return None
        if self._repeats(low, top) and top < inf:
            wanted = 0.5 * (low + min(top, most))
        allowed = [grid.nearest(wanted, low, min(top, most)) for grid in self.grids]
        once = low if low > 0 and np.count_nonzero(self.got == low) < MIN_ANSWERS else None
        return next((wall for wall in allowed if wall is not None), ends[0] if ends and self.highest <= most else once)

    def repeated(self, wall: float) -> float:
        """Return the stiffness to request so that the rig sets the same wall again."""
        asked = self.asked[np.abs(self.got - wall) <= EXACT * wall]
        return float(asked[-1]) if len(asked) and not self.grids else wall / self.factor

    def _between(self, wanted: float, low: float, high: float) -> float | None:
        """Return a stiffness between the requests that the rig answered by the ends of a bracket or by walls beyond
        them."""
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
        """Return how often the same end was set in place of a wall inside a bracket."""
        inside = (self.asked > low * (1 + OFF)) & (self.asked < high * (1 - OFF))
        ends = [np.abs(self.got - end) <= EXACT * end for end in (low, high) if end < inf]
        return max((int((inside & at).sum()) for at in ends), default=0)


def range_of(answers: Sequence[AnsweredWall]) -> RigRange | None:
    """Return the response of a rig to requested stiffnesses, or None if it sets them exactly.

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
    """Return the range of a rig that clips requests to its ends, or None if clipping does not explain the answers."""
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

    Their steps are the largest common divisor of all set stiffnesses, divided by an integer.
    """
    step, rest = 0.0, EXACT * float(got.max(initial=0.0))
    for value in got.tolist():
        while value > rest:
            step, value = value, abs(step - round(step / value) * value)
    if step <= 1e3 * rest:
        return ()
    parts = [GainGrid(step / part, rounding) for part in range(MOST_PARTS, 0, -1) for rounding in ROUNDINGS]  # type: ignore[arg-type]
    return tuple(grid for grid in parts if grid.explains(asked, got))

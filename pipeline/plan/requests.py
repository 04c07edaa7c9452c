"""What was asked of a rig beside what it logged: a rig that rounds K or B answers with other walls.

Kept in a file of the store, so that every call of the planner knows what the earlier ones asked for.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.base.disk import write_text
from pipeline.plan.verdicts import VOTES, Tried
from pipeline.records.batch import Booleans, Floats
from pipeline.store.names import folder_name

Wall = tuple[float, float]
"""K [N/m, Nm/rad] and B [Ns/m, Nms/rad]."""

SAME = 0.002
"""Difference relative to the largest at which two walls are one: a tenth of the usual accuracy of a limit."""

BEYOND = 0.25
"""How far beyond a wall that was rounded its neighbours are thought to be, relative to what was rounded off."""


@dataclass(frozen=True)
class Requests:
    """What was asked for so far.

    Parameters
    ----------
    open : tuple of Wall
        Asked for last.
    logged : tuple of Wall
        Walls of all logs at that time.
    kept : int
        Requests that the rig logged as asked.
    others : tuple of (Wall, Wall)
        The other ones, and what was logged in their place.
    """

    open: tuple[Wall, ...] = ()
    logged: tuple[Wall, ...] = ()
    kept: int = 0
    others: tuple[tuple[Wall, Wall], ...] = ()

    def answered(self, now: Sequence[Wall]) -> Requests:
        """Return the requests with what the walls of all logs say of those that are open.

        Logs that are more or fewer than what was asked for were made for another reason, and answer none.
        """
        new = list((Counter[Wall](now) - Counter[Wall](self.logged)).elements())
        if not new or len(new) != len(self.open):
            return self
        size = np.max(np.abs([*now, *self.open]), axis=0) + 1e-300
        kept, others = self.kept, list(self.others)
        for asked in self.open:
            off = [np.abs(np.subtract(wall, asked)) / size for wall in new]
            wall = new.pop(int(np.argmin([each.max() for each in off])))
            if (np.abs(np.subtract(wall, asked)) <= SAME * size).all():
                kept += 1
            else:
                others.append((asked, wall))
        return Requests((), tuple(now), kept, tuple(others))

    def asking(self, walls: Sequence[Wall], logged: Sequence[Wall]) -> Requests:
        """Return the requests with those of now in place of open ones."""
        return replace(self, open=tuple(walls), logged=tuple(logged))

    def sets(self, stiffness: float, damping: float) -> bool:
        """Whether a wall may be asked for again."""
        return [asked for asked, _ in self.others].count((stiffness, damping)) < VOTES

    def reachable(self, dampings: Sequence[float], tried: Floats) -> tuple[float, ...]:
        """Return the dampings that the rig sets where others are wanted; none where it sets others each time."""
        size = SAME * max(*dampings, *tried, 1e-300)
        missed: dict[float, list[float]] = {}
        for (_, asked), (_, logged) in self.others:
            if abs(asked - logged) > size:
                missed.setdefault(asked, []).append(logged)
        if sum(map(len, missed.values())) > max(self.kept, VOTES * len(dampings)):
            return ()
        # one may be a slip; where one was none, others are none either
        needed = 1 if any(len(each) > 1 for each in missed.values()) else 2
        found = set()
        for damping in dampings:
            others = missed.get(damping, [])
            hit = (np.abs(tried - damping) <= size).any()
            found.add(others[-1] if len(others) >= needed and not hit else damping)
        return tuple(sorted(found))

    @property
    def step(self) -> float:
        """Distance of the stiffnesses that the rig sets: twice what it rounded off, unless it has set closer ones."""
        off = max((abs(asked[0] - logged[0]) for asked, logged in self.others), default=0.0)
        finest = np.diff(np.unique([K for K, _ in self.logged])).min(initial=np.inf)
        return min(2 * off, float(finest))

    def as_set(self, stiffness: Floats, damping: Floats) -> tuple[Floats, Floats]:
        """Return walls as the rig sets them: all from what was asked for, and a little beyond, to what it logged."""
        found = [stiffness, damping]
        # who does something else once in a while rounds nothing
        for asked, logged in self.others if len(self.others) > self.kept else ():
            for i, (ask, log) in enumerate(zip(asked, logged, strict=True)):
                low, high = sorted((ask + BEYOND * (ask - log), log))
                found[i] = np.where((found[i] >= low) & (found[i] <= high), log, found[i])
        return found[0], found[1]

    def new(self, stiffness: Floats, damping: float, tried: Floats) -> Booleans:
        """Return which walls the rig would set as others than those that were tried at a damping."""
        walls, _ = self.as_set(stiffness, np.full(len(stiffness), damping))
        return ~np.isin(walls, tried)

    def remark(self, rotation: bool) -> str | None:
        """Return what is to be said of a rig that logs other walls than were asked for."""
        if not self.others:
            return None
        (asked, logged), count = self.others[-1], len(self.others)
        K, B = ("Nm/rad", "Nms/rad") if rotation else ("N/m", "Ns/m")
        return (
            f"asked and logged differ in {count} of {count + self.kept} trials: K = {asked[0]:g} {K}, B = {asked[1]:g} "
            f"{B} was logged as K = {logged[0]:g}, B = {logged[1]:g}; what was logged counts, and no limit is told "
            "closer than the rig sets its walls"
        )


NOTHING_ASKED = Requests()


def snapped(tried: Tried, dampings: Sequence[float]) -> Tried:
    """Return the trials with a damping that is next to a wanted one counted as that."""
    wanted = np.array(dampings)
    nearest = wanted[np.argmin(np.abs(tried.damping[:, None] - wanted), axis=1)] if len(tried) else tried.damping
    near = np.abs(nearest - tried.damping) <= SAME * float(wanted.max(initial=0.0))
    return replace(tried, damping=np.where(near, nearest, tried.damping))


def requests_folder(processed: Path, device: str, experiment: str) -> Path:
    """Return where what was asked of an experiment is kept, and who plans it."""
    return processed / ".plan" / folder_name(device) / folder_name(experiment)


def read_requests(folder: Path) -> Requests:
    """Return what was asked for so far; nothing where that is not known."""
    with suppress(OSError, ValueError, TypeError, KeyError):
        stored = json.loads((folder / "asked.json").read_bytes())
        walls = {name: tuple((float(K), float(B)) for K, B in stored[name]) for name in ("open", "logged")}
        others = tuple(((float(a), float(b)), (float(c), float(d))) for (a, b), (c, d) in stored["others"])
        return Requests(**walls, kept=int(stored["kept"]), others=others)
    return Requests()


def write_requests(folder: Path, requests: Requests) -> None:
    """Keep what was asked for."""
    write_text(folder / "asked.json", json.dumps(asdict(requests)))


def walls_of(stiffness: Floats, damping: Floats) -> tuple[Wall, ...]:
    """Return the walls of trials."""
    return tuple(zip(stiffness.tolist(), damping.tolist(), strict=True))

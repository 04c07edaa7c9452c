"""Which files came, changed and came to rest: looks at sizes and times of files, and opens none.

Looking is done over and over by a process that must cost next to nothing: only the standard library is used.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

FileState = tuple[int, int, int]
"""Size [byte], and times of the last change of the content and of anything else, as permissions [ns since 1970]."""

LOOK_SHARE = 200
"""A wait lasts at least this many times as long as the look before it: looking takes 0.5 % of a processor at most,
however many files there are and however slow the disk is."""

PATIENCE_S = 60.0
"""Time without news [s] after which the wait between two looks has doubled: logs of a course come seconds apart."""

LONGEST_WAIT = 5.0
"""Longest wait in intervals: with the default of 2 s the first log after a pause is seen within 10 s."""

SHORTEST_WAIT_S = 0.05
"""Shortest wait [s], where a file is about to settle."""


@dataclass(frozen=True)
class Look:
    """State of each file by its absolute path, and what could not be looked at, with the reason."""

    states: Mapping[str, FileState]
    troubles: Mapping[str, str]


def look_at(folders: Sequence[Path], files: Sequence[Path] = (), exclude: Sequence[Path] = ()) -> Look:
    """Return the state of all files below some folders, hidden ones left out, and of some single files.

    Parameters
    ----------
    folders : sequence of Path
        Searched with all folders below. Links to files are followed, links to folders are not, as by `ingest`.
    files : sequence of Path
        Single files that matter, too.
    exclude : sequence of Path
        Folders that are left out.
    """
    states: dict[str, FileState] = {}
    troubles: dict[str, str] = {}
    left_out = {os.path.abspath(path) for path in exclude}
    waiting = [os.path.abspath(path) for path in folders]
    while waiting:
        here = waiting.pop()
        try:
            with os.scandir(here) as entries:
                for entry in entries:
                    if entry.name.startswith("."):
                        continue
                    if entry.is_dir(follow_symlinks=False):
                        if entry.path not in left_out:
                            waiting.append(entry.path)
                        continue
                    # gone again, or a link that leads nowhere (yet)
                    with suppress(OSError):
                        states[entry.path] = _state(entry.stat())
        except OSError as error:
            troubles[here] = error.strerror or str(error)
    for file in files:
        with suppress(OSError):
            states[os.path.abspath(file)] = _state(os.stat(file))
    return Look(states, troubles)


def _state(status: os.stat_result) -> FileState:
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


class Arrivals:
    """Which files are new or changed since they were last taken, and which of them are at rest.

    A file is at rest when its state was the same for a time that this process has seen itself: clocks of file servers,
    and times that a copy brought along, do not matter.

    Parameters
    ----------
    settle_s : float
        How long a state must last [s].
    """

    def __init__(self, settle_s: float) -> None:
        self.settle_s = settle_s
        self._seen: dict[str, tuple[FileState, float]] = {}
        self._taken: dict[str, FileState] = {}

    def update(self, states: Mapping[str, FileState], now: float) -> bool:
        """Take in a look at a moment [s] of a clock that never goes back; return whether a file came or changed."""
        before = self._seen
        self._seen = {}
        news = False
        for path, state in states.items():
            known = before.get(path)
            if known is not None and known[0] == state:
                self._seen[path] = known
            else:
                self._seen[path] = state, now
                news = True
        # a file that is gone and comes back as it was is known; memory stays bounded by what is there
        self._taken = {path: state for path, state in self._taken.items() if path in self._seen}
        return news

    def restless(self, now: float) -> dict[str, float]:
        """Return the files that are not at rest, and the moment [s] at which each will be."""
        times = ((path, since + self.settle_s) for path, (_, since) in self._seen.items())
        return {path: rests for path, rests in times if rests > now}

    def ready(self, now: float) -> bool:
        """Return whether a file is at rest and new or changed since it was taken."""
        return any(
            self._taken.get(path) != state and since + self.settle_s <= now
            for path, (state, since) in self._seen.items()
        )

    def take(self, now: float) -> None:
        """Note that all files at rest are seen to."""
        self._taken |= {path: state for path, (state, since) in self._seen.items() if since + self.settle_s <= now}


def wait_after(look_s: float, interval_s: float, quiet_s: float, until_s: float | None) -> float:
    """Return how long to wait for the next look [s].

    Parameters
    ----------
    look_s : float
        How long the last look took [s].
    interval_s : float
        Wait that is asked for [s].
    quiet_s : float
        Time since the last news [s]; the wait grows with it.
    until_s : float or None
        Time until a file is at rest or something is to be tried again [s]; None where nothing is due.

    Examples
    --------
    >>> wait_after(0.005, 2, 0, None), wait_after(0.005, 2, 120, None), wait_after(0.005, 2, 9999, None)
    (2.0, 6.0, 10.0)
    >>> wait_after(0.005, 2, 0, 1.5), wait_after(0.5, 2, 0, None)
    (1.5, 100.0)
    """
    wait = interval_s * min(1 + quiet_s / PATIENCE_S, LONGEST_WAIT)
    if until_s is not None:
        wait = max(min(wait, until_s), SHORTEST_WAIT_S)
    return float(max(wait, LOOK_SHARE * look_s))

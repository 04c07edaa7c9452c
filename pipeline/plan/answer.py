"""The planner's answer, as people and programs read it."""

from __future__ import annotations

from typing import Literal

from pipeline.records.findings import Record


class Next(Record):
    """A wall to try: K [N/m, Nm/rad], B [Ns/m, Nms/rad], what it is expected to show, and why it is asked for."""

    stiffness: float
    damping: float
    expected: Literal["stable", "unstable", "undecided"]
    why: str


class Limit(Record):
    """Limit of stability at a damping [N/m, Nm/rad].

    ``low`` and ``high`` are the stiffest stable and the softest unstable wall by verdicts, None where there is none;
    ``estimate`` lies between them.
    """

    damping: float
    estimate: float | None
    low: float | None
    high: float | None


class Plan(Record):
    """What to try next, whether that is all, what is known, and how many trials it took and will take."""

    next: tuple[Next, ...]
    done: bool
    boundary: tuple[Limit, ...]
    trials_used: int
    trials_expected: int

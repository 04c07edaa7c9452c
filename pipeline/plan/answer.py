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
    ``estimate`` lies between them; None where verdicts do not tell it. ``note`` says what is special of it.
    """

    damping: float
    estimate: float | None
    low: float | None
    high: float | None
    note: str = ""


class Area(Record):
    """Area under the limits from the first to the last damping by straight lines between them, with its ends."""

    estimate: float
    low: float
    high: float


class Best(Record):
    """Best trial so far by a criterion, the least cost that the loop of all logs foretells, and the region around it.

    ``region`` holds the smallest and largest stiffness, and the smallest and largest damping, of walls whose cost is
    foretold to be within the wanted accuracy of the least; None where no loop foretells it.
    """

    criterion: str
    stiffness: float
    damping: float
    cost: float
    expected_cost: float | None
    region: tuple[float, float, float, float] | None


class Plan(Record):
    """What to try next, whether that is all, what is known, and how many trials it took and will take.

    ``remarks`` are sentences on what the plan rests on.
    """

    next: tuple[Next, ...]
    done: bool
    boundary: tuple[Limit, ...]
    trials_used: int
    trials_expected: int
    remarks: tuple[str, ...] = ()
    area: Area | None = None
    optimum: Best | None = None

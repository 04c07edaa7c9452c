"""What two experiments, devices or code versions differ in: finished numbers, second minus first."""

from __future__ import annotations

from typing import Literal

from pipeline.records.findings import ExcludedTrial, Note, Record

Plane = Literal["physical", "normalised"]


class Side(Record):
    """One of the two: device, experiment, version and hash of the code of its numbers, trials left out, notes."""

    device: str
    experiment: str
    version: str
    code: str
    excluded: tuple[ExcludedTrial, ...] = ()
    notes: tuple[Note, ...] = ()
    simulated: bool = False

    @property
    def label(self) -> str:
        """Name in figures and sentences."""
        return f"{self.device} {self.experiment}"


class ValueDifference(Record):
    """A quantity with its 95 % intervals on both sides.

    ``difference`` is second minus first with its interval. ``significant`` tells whether that interval leaves out zero;
    None with a ``reason`` where it cannot be told.
    """

    part: Literal["estimates", "optima", "scores"]
    name: str
    unit: str
    first: float | None
    second: float | None
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    significant: bool | None = None
    reason: str | None = None


class LimitDifference(Record):
    """Stability limit at one damping: stiffness of both sides (of the plane that the pair is compared in)."""

    damping: float
    first: float
    second: float
    percent: float
    significant: bool | None


class BoundaryDifference(Record):
    """Boundaries over the dampings that both cover; ``interpolated`` where the second was tested at others.

    ``median_percent`` and ``largest_percent`` are (second - first)/first. ``significant`` of the ``judged`` dampings,
    those with intervals on both sides, differ.
    """

    median_percent: float
    largest_percent: float
    largest_damping: float
    judged: int
    significant: int
    interpolated: bool
    points: tuple[LimitDifference, ...]


class CostDifference(Record):
    """Costs of the trials at the same (K, B): median of second over first, with its 95 % interval, and how many points.

    For the overshoot, which may be zero, ``median`` is the difference in place of the ratio (``kind``).
    """

    criterion: str
    kind: Literal["ratio", "difference"]
    points: int
    median: float | None = None
    low: float | None = None
    high: float | None = None
    significant: bool | None = None
    reason: str | None = None


class PairDifference(Record):
    """All that two experiments differ in."""

    first: Side
    second: Side
    plane: Plane
    estimates: tuple[ValueDifference, ...]
    boundary: BoundaryDifference | None
    boundary_reason: str | None = None
    optima: tuple[ValueDifference, ...]
    scores: tuple[ValueDifference, ...] = ()
    costs: tuple[CostDifference, ...]
    sentences: tuple[str, ...]

    @property
    def labels(self) -> tuple[str, str]:
        """Names of both sides, also where they are one experiment before and now."""
        a, b = self.first.label, self.second.label
        return (a, b) if a != b else (f"{a} before", f"{a} now")

    @property
    def simulated(self) -> bool:
        """Whether the logs of a side are simulated."""
        return self.first.simulated or self.second.simulated


class AgainstResult(Record):
    """The document that `pipeline compare --against ... --json` prints: one entry a pair of experiments."""

    title: str
    pairs: tuple[PairDifference, ...]
    only_first: tuple[str, ...] = ()
    only_second: tuple[str, ...] = ()
    report: str | None = None

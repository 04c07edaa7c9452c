"""Records of findings in logs, of limits and of estimates. They are frozen and validated, in SI.

The stages for logs need no other records. Therefore, a change of any other record does not make stored results
outdated. Units depend on the motion of the device, as in `models`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pipeline.base.json_object import JsonObject
from pipeline.base.wording import counted
from pipeline.device.parameters import Motion as Motion

Grip = Literal["none", "comfortable", "firm"]
Name = Annotated[str, Field(min_length=1, max_length=200)]
NonNegative = Annotated[float, Field(ge=0)]


class Record(BaseModel):
    """Base of all records. It is immutable, and allows no unknown fields, NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)


ROUNDING = 1e-9
"""Relative error attributed to rounding. Intervals from logs without noise may be as narrow as this."""


def holds(low: float, value: float, high: float) -> bool:
    """Return True if an interval contains a value, within `ROUNDING`."""
    return low - ROUNDING * abs(low) <= value <= high + ROUNDING * abs(high)


NARROW = 1.25
"""Smallest gain margin (stability limit divided by stiffness) of a wall that can be recommended.

An error of 25 % in mass or delay changes the limit by this factor.
"""

MATTERS = 0.02
"""Smallest relative change in a result that is reported.

Campaigns do not bracket limits more closely than this, and rounded K and B in headers deviate less. This is also the
share of logs above which a finding is not attributed to single trials.
"""

DRIFTS = "drifts by"
"""Beginning of a warning about a `Trend`."""

NOT_ADEQUATE = "its loop is not adequate"
"""Beginning of a warning about an estimate from a loop that is not adequate."""

DoubtCode = Literal["drift", "not_adequate", "other"]
"""Kind of doubt about the value of an estimate."""

_DOUBTS: dict[str, DoubtCode] = {DRIFTS: "drift", NOT_ADEQUATE: "not_adequate"}

MissingCode = Literal["left_out", "not_identifiable", "other"]
"""Kind of reason for a missing value: not requested, not identifiable from these logs, or a different reason."""

_MISSING: dict[str, MissingCode] = {"left out": "left_out", "not identifiable": "not_identifiable"}

UndecidedCode = Literal["no_motion", "log_ends", "mode_grows", "at_limit", "other"]
"""Kind of reason for an undecided verdict."""

_UNDECIDED: dict[str, UndecidedCode] = {
    "no visible motion": "no_motion",
    "the log ends before": "log_ends",
    "a mode grows": "mode_grows",
    "at the limit": "at_limit",
}


def undecided_code(reason: str) -> UndecidedCode:
    """Return the code of the stored reason of an undecided verdict.

    >>> undecided_code("at the limit: the remaining amplitude of 0.01 neither grows nor decays significantly")
    'at_limit'
    """
    return next((code for begins, code in _UNDECIDED.items() if reason.startswith(begins)), "other")


class Doubt(NamedTuple):
    """Doubt about the value of an estimate, as a code and a clause."""

    code: DoubtCode
    text: str


def _doubt(text: str) -> Doubt:
    return Doubt(next((code for begins, code in _DOUBTS.items() if text.startswith(begins)), "other"), text)


class Trend(Record):
    """Slope of an estimate over stiffness or damping of the trials, with its 95 % interval.

    ``span`` is the range of stiffness [N/m, Nm/rad] or damping [Ns/m, Nms/rad] of these trials.
    """

    over: Literal["stiffness", "damping"]
    slope: float
    low: float
    high: float
    unit: str
    significant: bool
    span: float | None = None


class Quantity(Record):
    """Number with its 95 % interval, unit and method. Without a value, it has the reason.

    An end is None if it is unbounded. ``unit`` is empty for a dimensionless number. ``method`` is empty if it is the
    method of the enclosing record.
    """

    value: float | None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    method: str = ""
    reason: str | None = None


class Estimate(Quantity):
    """Quantity estimated from the trials of an experiment.

    ``spread`` is the standard deviation between trials in addition to their own errors, ``within`` the median standard
    error of a trial. ``trials`` is the number of used trials. ``outliers`` are the ids of trials excluded as outliers.
    ``refused`` is the number of trials without a confidence interval. ``warning`` describes doubts about the value.
    ``truth`` is the true value in a simulation, which estimators do not set.
    """

    unit: str
    method: str
    trials: int = 0
    by_method: dict[str, Estimate] = Field(default_factory=dict)
    spread: NonNegative | None = None
    within: NonNegative | None = None
    outliers: tuple[str, ...] = ()
    refused: Annotated[int, Field(ge=0)] = 0
    trend: tuple[Trend, ...] = ()
    warning: str | None = None
    truth: float | None = None

    @model_validator(mode="after")
    def _a_missing_value_has_a_reason(self) -> Self:
        if self.value is None and not self.reason:
            raise ValueError("an estimate without a value needs a reason")
        return self

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Doubts about the value, from the clauses of the warning.

        >>> estimate = Estimate(value=1.0, unit="kg", method="m", warning="drifts by 2 kg; few logs")
        >>> [doubt.code for doubt in estimate.doubts]
        ['drift', 'other']
        """
        return tuple(_doubt(clause) for clause in (self.warning or "").split("; ") if clause)

    @property
    def missing_code(self) -> MissingCode:
        """Kind of the reason for a missing value."""
        reason = self.reason or ""
        return next((code for begins, code in _MISSING.items() if reason.startswith(begins)), "other")

    def recommended_of(self, by_method: dict[str, Estimate]) -> Estimate:
        """Return this estimate as the recommended one of several methods."""
        return self.model_copy(update={"by_method": by_method})


class ModelCheck(Record):
    """Fit of the maximum-likelihood device to the logs of an experiment. The device explains ``explained`` of
    ``trials``.

    ``fit_percent`` is the median fit of its free runs to logs that were not used for the fit.
    """

    trials: int
    explained: int
    fit_percent: float | None


class Limit(Record):
    """Largest stiffness [N/m, Nm/rad] at which a loop is stable for a damping, with its 95 % interval.

    If the tested range ended below the limit, the limit is ``censored``, and all three values are lower bounds. With
    friction, the limit is valid for the step that was used. ``stiffness_large_motion`` is the linear limit. Above it, a
    larger step is unstable.
    """

    damping: float
    stiffness: float
    low: float
    high: float
    censored: bool = False
    stiffness_large_motion: float | None = None


class BoundaryPoint(Record):
    """Stability limit at a damping: largest stable stiffness below the smallest unstable stiffness.

    ``trials`` is the number of trials with K > 0 at this damping. ``undecided`` is the number of these trials that are
    undecided and below the largest stable stiffness. They should be inspected, but are not evidence against this
    stiffness. Other undecided trials are not counted, and none are counted if ``stable`` is null. If friction was
    found, all values are valid for the step that was used. ``stiffness_large_motion`` is the linear limit of the
    identified device. Above it, a larger step is unstable.

    ``estimate`` is the limit from the growth rates with its 95 % interval. A censored point has only ``low``. A point
    without a stable trial has an upper end ``high``, a ``low`` of 0, and no estimate. ``truth`` is the limit of a
    simulated loop.
    """

    damping: float
    stable: float | None
    unstable: float | None
    censored: bool
    estimate: float | None = None
    low: float | None = None
    high: float | None = None
    trials: int = 0
    undecided: int = 0
    stiffness_large_motion: float | None = None
    truth: float | None = None

    @property
    def limit(self) -> Limit | None:
        """Limit from the growth rates, otherwise the middle between stable and unstable trials. None if neither is
        available."""
        stable, unstable, ends = self.stable, self.unstable, (self.estimate, self.low, self.high)
        if self.censored:
            ends = (stable, stable, stable)
        elif None in ends and stable is not None and unstable is not None:
            ends = (0.5 * (stable + unstable), stable, unstable)
        value, low, high = ends
        if value is None or low is None or high is None:
            return None
        return Limit(damping=self.damping, stiffness=value, low=low, high=high, censored=self.censored)


class DampingRange(Record):
    """Dampings around the damping of a wall at which its stiffness is stable, according to the lower ends of the
    measured limits.

    ``low`` and ``high`` are the ends of the range [Ns/m, Nms/rad]. An end is the limit if ``low_is_limit`` or
    ``high_is_limit`` is true. Otherwise the tested range ends there, or the next limit is unknown. ``margin`` is the
    smaller of high/B and B/low, a lower bound of the factor by which the damping can change. It is null for a wall
    without damping.
    """

    low: float
    high: float
    low_is_limit: bool
    high_is_limit: bool
    margin: float | None


class NearOptimum(Record):
    """Box around the ``trials`` that are nearly as good as the best: their cost is at most 5 % larger, or their
    stiffness at most 5 % smaller."""

    stiffness_low: float
    stiffness_high: float
    damping_low: float
    damping_high: float
    trials: int


class Optimum(Record):
    """Trial (or theoretical point) with the smallest cost. It is censored if it lies at the edge of the tested range.

    ``trials`` is the number of trials whose cost is known. ``passive`` is true if the wall is passive over the whole
    range of an adequate loop, and None if this is unknown. ``near`` is the box of walls that are nearly as good. It
    contains few trials if the optimum is sharp. ``margin`` is the lower end of the measured limit at this damping
    divided by the stiffness, or None without a limit. ``damping_range`` contains the dampings at which this stiffness
    is stable.
    ``scatter_percent`` is the scatter of single trials in the map of this cost. For the overshoot, ``resolution`` is
    the apparent overshoot due to sensor and noise in this log, as a fraction. ``free_of_overshoot`` states whether some
    stable trial overshoots by no more than its resolution, and ``is_alone`` whether the stiffest such trial has none of
    them next to it. It is then not part of a region without overshoot, but a lucky trial.
    """

    stiffness: float
    damping: float
    cost: float
    cost_low: float | None = None
    cost_high: float | None = None
    trial_id: str | None = None
    ties: int = 1
    censored: bool = False
    trials: int | None = None
    passive: bool | None = None
    near: NearOptimum | None = None
    margin: float | None = None
    damping_range: DampingRange | None = None
    scatter_percent: float | None = None
    resolution: float | None = None
    free_of_overshoot: bool | None = None
    is_alone: bool | None = None

    @property
    def at_border(self) -> bool | None:
        """True if the wall is close to the stability limit (6.2.4), or None if this is unknown. A wall is close if the
        limit may be less than a factor of `NARROW` away, in stiffness or in damping. This is unknown if no limit is
        known, or if the tested dampings end less than a factor of `NARROW` away.
        """
        around = self.damping_range
        if self.margin is None or self.margin < NARROW:
            return None if self.margin is None else True
        if around is None:
            return None
        close = [around.low * NARROW > self.damping, around.high < NARROW * self.damping]
        is_limit = [around.low_is_limit, around.high_is_limit]
        if any(map(all, zip(close, is_limit, strict=True))):
            return True
        return None if any(close) else False


FindingCode = Literal[
    "sampling_period",
    "missing_rows",
    "repeated_rows",
    "frozen_position",
    "interpolated_rows",
    "noncausal",
    "command_shifted",
    "wrapped_angle",
    "travel_stop",
    "wrong_sign",
    "constant_position",
    "constant_command",
    "too_few_rows",
    "coarse_sensor",
    "same_samples",
]

Severity = Literal["note", "repaired", "cut", "unsafe", "unusable"]
"""Effect of a finding on the results.

``note``: results are valid, but intervals may be wider. ``repaired``: results are computed from the repaired log.
``cut``: the first affected row and all later rows are not used. ``unsafe``: the log cannot be used for a delay or for
the limit of a wall.
``unusable``: the log cannot be used for any result.
"""


MOST_UNSAFE = 0.2
"""Largest share of logs with an unsafe finding for which the other logs from the same rig are still trusted."""

OF_ONE_LOG = frozenset({"frozen_position", "wrapped_angle"})
"""Unsafe findings that concern only their own log, not other logs from the rig."""

FINDINGS = "findings"
"""Key of the findings of a trial in its stored `time_quality`."""

NO_FINDINGS = f'"{FINDINGS}": []'
"""Entry in the time quality of a trial without recording faults."""

BY_READING = frozenset({"same_samples"})
"""Findings that are visible only when a log is read, like all repairs. The stored samples do not show these
findings."""


class Finding(Record):
    """Fault of a recording: kind, location, evidence and remedy.

    Parameters
    ----------
    code : str
    first_row : int or None
        First affected row, counted from 0, or None if all rows are affected.
    rows : int
        Number of affected rows.
    evidence, remedy : str
        Sentences with a full stop. The evidence contains numbers in SI.
    severity : str
    """

    code: FindingCode
    first_row: int | None
    rows: int
    evidence: str
    remedy: str
    severity: Severity

    @property
    def sentence(self) -> str:
        """Text that every output shows."""
        return f"{self.evidence} {self.remedy}"

    @property
    def document(self) -> JsonObject:
        """Finding as JSON values, with its sentence."""
        return {**self.model_dump(), "sentence": self.sentence}

    @property
    def is_unsafe(self) -> bool:
        """True if the log cannot be used for a delay or a limit, although it seems to be usable."""
        return self.severity == "unsafe"

    @property
    def is_by_reading(self) -> bool:
        """True if the stored samples do not show the finding."""
        return self.severity == "repaired" or self.code in BY_READING

    @property
    def leaves_out(self) -> bool:
        """True if the log is excluded from fits."""
        return self.severity in {"unsafe", "unusable"}


def stored_findings(time_quality: str) -> list[Finding]:
    """Return the findings of a recording that are stored with its trial.

    Parameters
    ----------
    time_quality : str
        Stored column of the trial, as JSON.
    """
    if NO_FINDINGS in time_quality or FINDINGS not in time_quality:  # fast path for nearly all trials
        return []
    return [Finding.model_validate(each) for each in json.loads(time_quality).get(FINDINGS, ())]


def are_unsafe(findings: Sequence[Sequence[Finding]]) -> bool:
    """Return True if these logs cannot be used for a delay or a limit, given the findings of each log.

    This is the case if all logs are unsafe, or if more than `MOST_UNSAFE` of them have an unsafe fault of the rig.
    """
    unsafe = [any(each.is_unsafe for each in found) for found in findings]
    of_rig = [any(each.is_unsafe and each.code not in OF_ONE_LOG for each in found) for found in findings]
    return bool(unsafe) and (all(unsafe) or sum(of_rig) > MOST_UNSAFE * len(of_rig))


def unsafe_reason(findings: Sequence[Sequence[Finding]]) -> str:
    """Return the reason why these logs cannot be used for a delay or a limit, quoting the first unsafe finding, or ""
    if they can be used."""
    if not are_unsafe(findings):
        return ""
    unsafe = [each for found in findings if (each := next((one for one in found if one.is_unsafe), None))]
    return f"{len(unsafe)} of {counted(len(findings), 'log')}: {unsafe[0].sentence}"


class Note(Record):
    """Comment of users on an experiment or a trial: a text and tags."""

    experiment: str
    trial_id: str | None = None
    tags: tuple[str, ...] = ()
    text: str = ""


class ExcludedTrial(Record):
    """Manually excluded trial, which does not affect any result: id, log, reason and date (UTC)."""

    experiment: str
    trial_id: str
    log: str
    reason: str
    since: str

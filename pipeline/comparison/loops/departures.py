"""Departures of logs from the wall law that their headers state, and the velocity filter that the logs show."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from pipeline.base.wording import commonest, counted, listed
from pipeline.device.parts import VelocityFilter
from pipeline.measured.experiment.identified_loop import FEWEST_LOGS, MOST
from pipeline.measured.signal.verdict import judge
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.measured.wall_command.velocity_filter import VelocityFilterFound
from pipeline.records.findings import MATTERS
from pipeline.records.results import Cause
from pipeline.records.trials import Floats
from pipeline.rendering.labels import range_text, significant

SAME_FILTER = 0.05
"""Largest difference of gain at any frequency for which two filters count as equal.

Rounding of the commands limits the accuracy of the estimates.
"""

ANGLES = 512
"""Frequencies between zero and half the sampling frequency at which gains are compared."""

NAMED = 10
"""Largest number of logs listed by name. The list of trials shows all other logs as undecided, with the reasons."""

SHORT = "the command follows another wall than the headers state"

SENTENCES = {
    "saturation": "The command is clipped.",
    "unilateral_wall": "The wall acts on one side only.",
    "constant_force": "The command includes a constant force in addition to the wall law.",
    "missing_rows": "Rows are missing from the logs.",
    "repeated_rows": "Rows or readings of the position are repeated.",
    "velocity_filter": "The velocity of the wall law is filtered.",
    "position_filter": "The position in the wall law is filtered.",
    "adaptive_velocity": "The velocity of the wall law is estimated over a window that adapts to the motion.",
    "decimated_rows": "The logs contain only one of several samples of the control loop.",
    "command_shifted": "The logged command and position belong to different rows.",
    "rate_limit": "The rate of the command is limited.",
    "sampling_period": "The sampling period of the time stamps differs from that in the header.",
    "scattered_stamps": "The time stamps scatter, but no row is missing.",
    "step_not_a_step": "The external force differs from the step in the header.",
    "several_steps": "The external force has several steps.",
    "other_wall": "The command follows another wall than the header states.",
    "other_unit": "The command follows another wall than the header states, by a power of ten.",
    "unknown": "The logged command deviates from the wall law.",
}
"""Possible departures of a log from the wall law.

With ``other_wall``, K, B or a sign differs from the header. With ``other_unit``, K and B are wrong by a power of ten.
"""

UNTIMED = {
    "decimated_rows": (
        "the controller runs faster than rows are logged, and mass, damping and delay depend on the commands between "
        "the rows, which are unknown; to resolve this, log each sample of the control loop"
    ),
    "command_shifted": (
        "the command is logged in a row other than that of its position, so the delay is wrong by as many samples; to "
        "resolve this, log command and position of the same sample in one row"
    ),
    "sampling_period": (
        "the time stamps and the header state different sampling periods, and the logs do not show which is right: "
        "mass, damping and delay depend on it; to resolve this, correct sampling_period_s in the header, or the unit "
        "of the time stamps in the profile"
    ),
}
"""Departures that leave the time from command to motion unknown if most logs show them, with the consequences."""

IMITATED = {
    "several_steps": {"missing_rows": 1.0, "repeated_rows": 1.0, "velocity_filter": 1.0, "saturation": 1.0},
    "step_not_a_step": {"rate_limit": 1.0},
    "missing_rows": {"saturation": 1.0, "repeated_rows": 0.25},
    "repeated_rows": {"missing_rows": 0.25},
    "velocity_filter": {"position_filter": 1.0},
    "position_filter": {"velocity_filter": 1.0},
}
"""Departures, with other departures that imitate them in single logs.

A departure must have more logs than those that imitate it.
"""


@dataclass(frozen=True)
class LawDeparture:
    """Departure from the wall law, with its code, the number of logs that show it, the number of all logs, and the
    evidence of the first log."""

    code: str
    logs: int
    of: int
    evidence: str

    @property
    def most(self) -> bool:
        """Whether most logs show the departure."""
        return self.logs > MOST * self.of

    @property
    def shown(self) -> str:
        """The evidence with the number of logs."""
        return f"{self.logs} of {counted(self.of, 'log')}; {self.evidence}"


@dataclass(frozen=True, eq=False)
class LawRows:
    """Results of the wall-law test, with one entry for each log.

    Parameters
    ----------
    codes : list of list of str
        Departures of each log from the law of the stated wall.
    evidence : list of str
    filters : list of VelocityFilterFound or None
    residual : float64, shape (n,)
        Residual of the law, or NaN if the log has no step.
    followed : float64, shape (n,)
        Stiffness that the command follows if the wall differs from the stated one [N/m, Nm/rad], otherwise NaN.
    verdict : array of str, shape (n,)
    """

    codes: list[list[str]]
    evidence: list[str]
    filters: list[VelocityFilterFound | None]
    residual: Floats
    followed: Floats
    verdict: NDArray[np.str_]

    @classmethod
    def of(cls, stages: ExperimentStages) -> LawRows:
        """Return the rows of the logs of an experiment."""
        return cls(
            [list(filter(None, text.split(","))) for text in stages.texts("wall_law", "law_codes")],
            stages.texts("wall_law", "law_evidence"),
            [_filter(text) if text else None for text in stages.texts("wall_law", "velocity_filter")],
            stages.column("wall_law", "law_residual"),
            stages.column("wall_law", "obeyed_stiffness"),
            stages.verdicts.verdict,
        )

    @classmethod
    def of_logs(cls, logs: Sequence[MeasuredTrial]) -> LawRows:
        """Return the rows of logs outside the store."""
        return cls(
            [[departure.code for departure in log.law.departures] for log in logs],
            [log.law.evidence for log in logs],
            [log.law.filter for log in logs],
            np.array([log.law.residual for log in logs]),
            np.array([log.law.obeyed[0] for log in logs]),
            np.array([judge(log.trial, log.response).verdict for log in logs]),
        )

    @property
    def of_stated_wall(self) -> list[list[str]]:
        """Return the departures of each log from its stated wall. The list is empty if it follows another wall."""
        return [[] if off else codes for codes, off in zip(self.codes, np.isfinite(self.followed), strict=True)]

    @property
    def compared(self) -> int:
        """Return the number of logs whose command could be compared with the law of the stated wall."""
        seen = np.isfinite(self.residual) & ~np.isfinite(self.followed)
        return sum(bool(law or codes) for law, codes in zip(seen, self.of_stated_wall, strict=True))

    @property
    def misled(self) -> bool:
        """Whether most logs follow a wall other than the stated one. No result in units of K and B is then possible."""
        return int(np.isfinite(self.followed).sum()) > MOST * len(self.codes)


def law_departures(rows: LawRows) -> list[LawDeparture]:
    """Return the departures of logs from the wall law, sorted by decreasing frequency.

    A clipped log that diverges does not count, because the clipping results from the divergence. Logs that follow
    another wall than stated are also left out; see `other_gains`.
    """
    compared, of_stated_wall, found = rows.compared, rows.of_stated_wall, []
    for code in SENTENCES:
        logs = [i for i, codes in enumerate(of_stated_wall) if code in codes]
        logs = [i for i in logs if not (code == "saturation" and rows.verdict[i] == "unstable")]
        if len(logs) > MATTERS * compared and len(logs) >= min(FEWEST_LOGS, compared):
            found.append(LawDeparture(code, len(logs), compared, commonest(rows.evidence[i] for i in logs)))
    logs_of = {each.code: each.logs for each in found}
    found = [e for e in found if all(e.logs > n * logs_of.get(o, 0) for o, n in IMITATED.get(e.code, {}).items())]
    return sorted(found, key=lambda each: -each.logs)


def untimed(departures: Sequence[LawDeparture]) -> str:
    """Return why the device cannot be identified because most logs leave the time from command to motion unknown."""
    return next((UNTIMED[each.code] for each in departures if each.most and each.code in UNTIMED), "")


@dataclass(frozen=True)
class CourseFilter:
    """The velocity filter of an experiment, the filters of its single logs, and a description."""

    velocity: VelocityFilter
    of_logs: Sequence[VelocityFilter]
    words: str


def course_filter(rows: LawRows) -> CourseFilter | None:
    """Return the velocity filter on which most logs agree, or None if they do not agree.

    A controller has the same filter in all trials or in none. Single logs can imitate a filter. An effect that differs
    between logs is not a filter.
    """
    if not any(each.code == "velocity_filter" and each.most for each in law_departures(rows)):
        return None
    filters = [shown for shown in rows.filters if shown is not None]
    if not filters:
        return None
    usual = Counter(filters).most_common(1)[0][0]
    angles = np.linspace(0.0, np.pi, ANGLES, endpoint=False)
    difference = np.abs(np.array([shown.gain(angles) for shown in filters]) - usual.gain(angles)).max(axis=1)
    if (difference <= SAME_FILTER).mean() <= MOST:
        return None
    return CourseFilter(usual.declared, [shown.declared for shown in filters], usual.words())


def experiment_departures(stages: ExperimentStages) -> list[LawDeparture]:
    """Return the departures of the logs of an experiment from the wall law, sorted by decreasing frequency."""
    return law_departures(stages.once(LawRows.of))


def experiment_filter(stages: ExperimentStages) -> CourseFilter | None:
    """Return the velocity filter on which most logs of an experiment agree, or None if they do not agree."""
    return course_filter(stages.once(LawRows.of))


def _filter(text: str) -> VelocityFilterFound:
    stored = json.loads(text)
    return VelocityFilterFound(tuple(stored["b"]), tuple(stored["a"]), stored["difference"], stored["cutoff_hz"])


@dataclass(frozen=True, eq=False)
class OtherGains:
    """Logs that follow another wall, with their names, the number of all logs, the evidence of the first, and the gain
    difference."""

    logs: tuple[str, ...]
    of: int
    evidence: str
    words: str

    @property
    def most(self) -> bool:
        """Whether too many logs follow another wall for any result in units of K and B."""
        return len(self.logs) > MOST * self.of

    @property
    def few(self) -> bool:
        """Whether so few logs follow another wall that the other logs remain valid. These logs are listed and left
        out."""
        return len(self.logs) < min(FEWEST_LOGS, self.of)

    @property
    def cause(self) -> Cause:
        """Return these logs as a cause."""
        many = f"{len(self.logs)} of {counted(self.of, 'log')}"
        names = ", ".join(self.logs[:NAMED]) + (f" and {len(self.logs) - NAMED} more" if self.logs[NAMED:] else "")
        used = "no wall, limit or cost is given in these units" if self.most else "they are left out"
        return Cause(
            code="other_gains",
            sentence=f"The command of {many} follows another wall than the headers state: {self.words}; {used}.",
            evidence=f"{names}; in the first of them {self.evidence}",
        )


def other_gains(stages: ExperimentStages) -> OtherGains | None:
    """Return the logs of an experiment that follow another wall than stated, or None if all follow their headers."""
    followed = np.stack(
        [stages.column("wall_law", f"obeyed_{name}") for name in ("stiffness", "damping", "step")], axis=1
    )
    off = np.flatnonzero(np.isfinite(followed).all(axis=1))
    if not len(off):
        return None
    rows = {row["trial_id"]: row for row in stages.trials.select(["trial_id", "step", "source_path"]).to_pylist()}
    trials = [rows[trial] for trial in stages.texts("wall_law", "trial_id")]
    step = np.array([row["step"] for row in trials])
    stated = np.stack([stages.column("wall_law", "stiffness"), stages.column("wall_law", "damping"), step], axis=1)
    names = tuple(PurePath(trials[i]["source_path"]).name for i in off)
    evidence = stages.texts("wall_law", "law_evidence")[off[0]]
    return OtherGains(names, len(followed), evidence, _words(followed[off], stated[off]))


def _words(followed: Floats, stated: Floats) -> str:
    pairs = (stated[:, 1::-1], stated[:, :2])
    swapped, same = (np.isclose(followed[:, :2], each, rtol=MATTERS).all() for each in pairs)
    if swapped and not same:
        return "K and B are swapped"
    found: dict[str, list[str]] = {}
    for symbol, one, other in zip(("K", "B", "the step"), followed.T, stated.T, strict=True):
        known = (other != 0) & (one != 0)
        factor = one[known] / other[known]
        if len(factor) and (np.abs(factor - 1) > MATTERS).any():
            low, high = np.quantile(factor, (0.05, 0.95))
            found.setdefault(range_text(lambda value: significant(value, 3), low, high), []).append(symbol)
    differences = [f"{listed(symbols)} {factor} times as large" for factor, symbols in found.items()]
    return "; ".join(differences) or "the headers state neither stiffness nor damping"

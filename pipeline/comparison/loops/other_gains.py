"""Logs whose command obeys another K, B or step than their headers state: named, left out, and a cause of their own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePath

import numpy as np

from pipeline.base.wording import counted, listed
from pipeline.comparison.loops.log_evidence import FEWEST_LOGS
from pipeline.measured.law.wall_law import OTHER_WALL
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.loop_records import Cause
from pipeline.rendering.labels import range_text, significant

MOST = 0.5
"""Share of logs with other gains from which on what is stated is wrong, and not a log: nothing is told in its units."""

SHORT = "the command obeys another wall than the headers state"

NAMED = 10
"""Logs that are named; the others are undecided in the list of trials, each with its reason."""

_SYMBOLS = ("K", "B", "the step")


@dataclass(frozen=True, eq=False)
class OtherGains:
    """Logs that obey another wall: their names, of how many, evidence of the first, and by what their gains differ."""

    logs: tuple[str, ...]
    of: int
    evidence: str
    words: str

    @property
    def most(self) -> bool:
        """Whether so many logs obey another wall that nothing is told in units of K and B."""
        return len(self.logs) > MOST * self.of

    @property
    def few(self) -> bool:
        """Whether so few logs obey another wall that they say nothing of the course: they are left out by name."""
        return len(self.logs) < min(FEWEST_LOGS, self.of)

    @property
    def cause(self) -> Cause:
        """What they are as a cause."""
        many = f"{len(self.logs)} of {counted(self.of, 'log')}"
        names = ", ".join(self.logs[:NAMED]) + (f" and {len(self.logs) - NAMED} more" if self.logs[NAMED:] else "")
        used = "no wall, limit or cost is told in these units" if self.most else "they are left out"
        return Cause(
            code="other_gains",
            sentence=f"The command of {many} obeys another wall than the headers state: {self.words}; {used}.",
            evidence=f"{names}; in the first of them {self.evidence}",
        )


def other_gains(stages: ExperimentStages) -> OtherGains | None:
    """Return the logs of an experiment that obey another wall than stated, None where all obey their headers."""
    obeyed = np.stack(
        [stages.column("wall_law", f"obeyed_{name}") for name in ("stiffness", "damping", "step")], axis=1
    )
    off = np.flatnonzero(np.isfinite(obeyed).all(axis=1))
    if not len(off):
        return None
    rows = {row["trial_id"]: row for row in stages.trials.select(["trial_id", "step", "source_path"]).to_pylist()}
    trials = [rows[trial] for trial in stages.texts("wall_law", "trial_id")]
    step = np.array([row["step"] for row in trials])
    stated = np.stack([stages.column("wall_law", "stiffness"), stages.column("wall_law", "damping"), step], axis=1)
    names = tuple(PurePath(trials[i]["source_path"]).name for i in off)
    evidence = stages.texts("wall_law", "law_evidence")[off[0]]
    return OtherGains(names, len(obeyed), evidence, _words(obeyed[off], stated[off]))


def _words(obeyed: Floats, stated: Floats) -> str:
    swapped = (
        np.isclose(obeyed[:, :2], stated[:, 1::-1], rtol=OTHER_WALL).all()
        and not np.isclose(obeyed[:, :2], stated[:, :2], rtol=OTHER_WALL).all()
    )
    if swapped:
        return "K and B are swapped"
    found: dict[str, list[str]] = {}
    for symbol, one, other in zip(_SYMBOLS, obeyed.T, stated.T, strict=True):
        known = (other != 0) & (one != 0)
        factor = one[known] / other[known]
        if len(factor) and (np.abs(factor - 1) > OTHER_WALL).any():
            low, high = np.quantile(factor, (0.05, 0.95))
            found.setdefault(range_text(lambda value: significant(value, 3), low, high), []).append(symbol)
    told = [f"{listed(symbols)} {factor} times as large" for factor, symbols in found.items()]
    return "; ".join(told) or "one that the headers have without stiffness or damping"

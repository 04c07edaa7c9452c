"""What single logs show of a loop that is not ideal: departures from the wall law, and where the device rests."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import get_args

import numpy as np

from pipeline.base.wording import commonest, counted
from pipeline.measured.experiment.rest_forces import RestForces
from pipeline.measured.signal.velocity_filter import VelocityFilterFound
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import VelocityFilter
from pipeline.records.loop_records import Cause, CauseCode
from pipeline.rendering.labels import share_text, significant

SOME_LOGS = 0.03
"""Share of logs up to which a departure is an accident of single trials."""

CODES = frozenset(get_args(CauseCode))

_SENTENCES = {
    "saturation": "The command is clipped.",
    "unilateral_wall": "The wall acts on one side only.",
    "constant_force": "The command holds a constant force beside the wall law.",
    "missing_rows": "Rows are missing in the logs.",
    "repeated_rows": "Rows or readings of the position are repeated.",
    "velocity_filter": "The velocity of the wall law is filtered.",
    "step_not_a_step": "The external force is not the step that the header states.",
    "several_steps": "The external force has several steps.",
    "other_wall": "The command obeys another wall than the header states.",
    "other_unit": "The command obeys another wall than the header states, by a power of ten.",
    "unknown": "The logged command is not that of the wall law.",
}


SETTLING = 0.02
"""Friction relative to the step from which on settling times depend on it: half width of the usual band."""

IMITATED = {
    "several_steps": ("missing_rows", "repeated_rows", "velocity_filter", "saturation"),
    "missing_rows": ("saturation",),
}
"""Departures, and others by which single logs look like them."""

OF_THE_FORCE = ("step_not_a_step", "several_steps")
"""Departures of the external force: the wall is as it should be, and the model knows the command."""


@dataclass(frozen=True)
class LawDeparture:
    """A way in which logs depart from the wall law: its code, how many of how many logs, and the first evidence."""

    code: str
    logs: int
    of: int
    evidence: str

    @property
    def sentence(self) -> str:
        """What it is, in a sentence."""
        return _SENTENCES[self.code]

    @property
    def shown(self) -> str:
        """The evidence with the number of logs."""
        return f"{self.logs} of {counted(self.of, 'log')}; {self.evidence}"


def law_departures(stages: ExperimentStages) -> list[LawDeparture]:
    """Return how the logs of an experiment depart from the wall law, in the order of how many do.

    A log that is clipped where it diverges shows how it ended, not another loop; it does not count. Nor do those that
    obey another wall than stated: they are left out, see `other_gains`.
    """
    unstable = stages.verdicts.verdict == "unstable"
    codes = [set(filter(None, text.split(","))) for text in stages.texts("wall_law", "law_codes")]
    evidence, residual = stages.texts("wall_law", "law_evidence"), stages.column("wall_law", "law_residual")
    other = np.isfinite(stages.column("wall_law", "obeyed_stiffness"))
    codes = [set() if off else each for each, off in zip(codes, other, strict=True)]
    held = sum(seen or bool(of) for seen, of in zip(np.isfinite(residual) & ~other, codes, strict=True))
    found = []
    for code in _SENTENCES:
        logs = [i for i, each in enumerate(codes) if code in each and not (code == "saturation" and unstable[i])]
        if len(logs) > SOME_LOGS * held:
            found.append(LawDeparture(code, len(logs), held, commonest(evidence[i] for i in logs)))
    logs_of = {each.code: each.logs for each in found}
    found = [e for e in found if all(e.logs > logs_of.get(other, 0) for other in IMITATED.get(e.code, ()))]
    return sorted(found, key=lambda each: -each.logs)


def found_filter(stages: ExperimentStages) -> VelocityFilterFound | None:
    """Return the velocity filter that most logs show, or None where they show none."""
    text = commonest(stages.texts("wall_law", "velocity_filter"))
    return _found(text) if text else None


def filters_of_logs(stages: ExperimentStages) -> list[VelocityFilter]:
    """Return the velocity filter of each log that shows one."""
    return [_found(text).declared for text in stages.texts("wall_law", "velocity_filter") if text]


def _found(text: str) -> VelocityFilterFound:
    found = json.loads(text)
    return VelocityFilterFound(tuple(found["b"]), tuple(found["a"]), found["difference"], found["cutoff_hz"])


def coarse(stages: ExperimentStages) -> Floats:
    """Return the quantum of the sensor relative to the final displacement of each stable trial, shape (n,)."""
    moved = stages.column("response", "position_final_expected") - stages.column("response", "position_start")
    stable = (stages.verdicts.verdict == "stable") & np.isfinite(moved) & (moved != 0)
    share: Floats = (stages.column("response", "sensor_quantum")[stable] / np.abs(moved[stable])).astype(np.float64)
    return share


def law_causes(departures: list[LawDeparture], stages: ExperimentStages) -> list[Cause]:
    """Return the causes that departures from the wall law are, without those that have no name."""
    found = []
    for each in departures:
        # a controller filters the velocity in all trials or in none; single logs can imitate it
        if each.code not in CODES or (each.code == "velocity_filter" and each.logs <= 0.5 * each.of):
            continue
        sentence = each.sentence
        velocity = found_filter(stages) if each.code == "velocity_filter" else None
        if velocity is not None:
            sentence = f"The velocity of the wall law {velocity.words()}."
        found.append(Cause.model_validate({"code": each.code, "sentence": sentence, "evidence": each.shown}))
    return found


def friction_words(coulomb: float, unit: str, stages: ExperimentStages) -> str:
    """Return what friction [N, Nm] is in a device, and what it does where it is more than a settling band."""
    step = float(np.median(np.abs(stages.trials.column("step").to_numpy())))
    text = f"The device has Coulomb friction of {significant(coulomb, 2)} {unit}"
    if not step or coulomb <= SETTLING * step:
        return f"{text}."
    return (
        f"{text}, {share_text(coulomb / step, 0)} % of the step: settling times depend on how far off F_0/K it lets "
        "the device rest."
    )


def rest_words(rest: RestForces, unit: str) -> str:
    """Return where logs come to rest, in words."""
    return (
        f"{rest.off} of {counted(rest.of, 'log')} that came to rest ({share_text(rest.off / max(rest.of, 1), 0)} %) "
        f"do so elsewhere than at x_0 + F_0/K, where {significant(abs(rest.typical), 3)} {unit} hold them in the median"
    )

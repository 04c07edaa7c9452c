"""What single logs show of a loop that is not ideal: departures from the wall law, and where the device rests."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from pipeline.base.wording import commonest, counted
from pipeline.measured.experiment.rest_forces import RestForces
from pipeline.measured.law.velocity_filter import VelocityFilterFound
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.batch import Floats
from pipeline.records.loop_parts import VelocityFilter
from pipeline.records.loop_records import Cause, CauseCode
from pipeline.rendering.labels import share_text, significant

SOME_LOGS, FEWEST_LOGS = 0.03, 3
"""Share and number of logs up to, and below, which a departure is an accident of single trials; all of fewer logs."""

GAINS = 33
"""Frequencies at which filters are compared."""

SAME_FILTER = 0.05
"""Difference of the gains of two filters, at any frequency, up to which they are one: logs show theirs by rounding."""

Complexes = NDArray[np.complex128]

CODES = frozenset(get_args(CauseCode))

_SENTENCES = {
    "saturation": "The command is clipped.",
    "unilateral_wall": "The wall acts on one side only.",
    "constant_force": "The command holds a constant force beside the wall law.",
    "missing_rows": "Rows are missing in the logs.",
    "repeated_rows": "Rows or readings of the position are repeated.",
    "velocity_filter": "The velocity of the wall law is filtered.",
    "adaptive_velocity": "The velocity of the wall law is taken over a window that adapts to the motion.",
    "command_shifted": "The logged command is that of another row than its position.",
    "rate_limit": "The rate of the command is limited.",
    "sampling_period": "The sampling period is another one than the header states.",
    "scattered_stamps": "The time stamps scatter, but no row is missing.",
    "step_not_a_step": "The external force is not the step that the header states.",
    "several_steps": "The external force has several steps.",
    "other_wall": "The command obeys another wall than the header states.",
    "other_unit": "The command obeys another wall than the header states, by a power of ten.",
    "unknown": "The logged command is not that of the wall law.",
}


SETTLING = 0.02
"""Friction relative to the step from which on settling times depend on it: half width of the usual band."""

IMITATED = {
    "several_steps": {"missing_rows": 1.0, "repeated_rows": 1.0, "velocity_filter": 1.0, "saturation": 1.0},
    "step_not_a_step": {"rate_limit": 1.0},
    "missing_rows": {"saturation": 1.0, "repeated_rows": 0.25},
    "repeated_rows": {"missing_rows": 0.25},
}
"""Departures, and others by which single logs look like them: of how many logs of another one more must show it."""

OF_NO_LOOP = ("step_not_a_step", "several_steps", "scattered_stamps")
"""Departures of the external force and of the stamps: the wall is as it should be, and the model knows the command."""


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
        if len(logs) > SOME_LOGS * held and len(logs) >= min(FEWEST_LOGS, held):
            found.append(LawDeparture(code, len(logs), held, commonest(evidence[i] for i in logs)))
    logs_of = {each.code: each.logs for each in found}
    found = [e for e in found if all(e.logs > n * logs_of.get(o, 0) for o, n in IMITATED.get(e.code, {}).items())]
    return sorted(found, key=lambda each: -each.logs)


def found_filter(stages: ExperimentStages) -> VelocityFilterFound | None:
    """Return the velocity filter that most logs which show one agree on, None where they do not.

    A controller has the same filter in all trials. What differs from log to log is another thing than a filter.
    """
    texts = [text for text in stages.texts("wall_law", "velocity_filter") if text]
    gains = np.array([_gain(_found(text)) for text in texts])
    told = commonest(texts)
    if not told:
        return None
    apart = np.abs(gains - _gain(_found(told))).max(axis=1)
    return _found(told) if (apart <= SAME_FILTER).mean() > 0.5 else None


def _gain(found: VelocityFilterFound) -> Complexes:
    """Return the gain of a filter between rest and half the sampling frequency."""
    z = np.exp(-1j * np.linspace(0, np.pi, GAINS))
    gain = np.polyval(np.array(found.b[::-1], dtype=complex), z) / np.polyval(np.array(found.a[::-1], dtype=complex), z)
    return np.asarray(gain, dtype=np.complex128)


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
        if each.code == "velocity_filter":
            velocity = found_filter(stages)
            if velocity is None:
                continue
            sentence = f"The velocity of the wall law {velocity.words()}."
        found.append(Cause.model_validate({"code": each.code, "sentence": sentence, "evidence": each.shown}))
    return found


def friction_words(coulomb: float, unit: str, stages: ExperimentStages) -> str:
    """Return what friction [N, Nm] is in a device, and what it does where it is more than a settling band."""
    step = float(np.median(np.abs(stages.trials.column("step").to_numpy())))
    text = f"The device has Coulomb friction of {significant(coulomb, 2)} {unit}"
    if not step or coulomb <= SETTLING * step:
        return f"{text}."
    return f"{text}, {share_text(coulomb / step, 0)} % of the step: it rests off target, and settling times show that."


def rest_words(rest: RestForces, unit: str) -> str:
    """Return where logs come to rest, in words."""
    return (
        f"{rest.off} of {counted(rest.of, 'log')} that came to rest ({share_text(rest.off / max(rest.of, 1), 0)} %) "
        f"do so elsewhere than at x_0 + F_0/K, where {significant(abs(rest.typical), 3)} {unit} hold them in the median"
    )

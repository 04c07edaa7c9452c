"""Stages of the measured branch: each takes the samples of one experiment and writes one table.

A stage is reused while its key is the same: a hash of the trials (source and profile hashes), of the code that
computes it, and of the values it takes from stages before it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline import aggregate, boundary, costs, damping, delay, mass, response, verdict
from pipeline.batch import Floats, TrialBatch
from pipeline.errors import StoreError
from pipeline.models import ENERGY_CRITERIA, SETTLING_BANDS, BoundaryPoint, Estimate, Optimum
from pipeline.provenance import code_digest, digest, stamp
from pipeline.storage import load_batch, stage_file
from pipeline.tables import read_metadata, read_table, to_arrow, write_table

STAGES = ("response", "boundary", "delay", "damping", "mass", "overshoot", "settling", "energy")
"""Stages in the order in which they can be computed."""

NEEDS: dict[str, tuple[str, ...]] = {
    "response": (),
    "boundary": ("response",),
    "delay": ("response",),
    "damping": ("response", "delay"),
    "mass": ("response", "delay", "damping"),
    "overshoot": ("response",),
    "settling": ("response", "delay"),
    "energy": ("response", "delay"),
}
"""Stages whose results a stage takes; the plan is made backwards along these."""

_SHARED_CODE = ("batch", "stages", "aggregate")
_CODE: dict[str, tuple[str, ...]] = {
    "response": ("response", "verdict", "modes"),
    "boundary": ("boundary",),
    "delay": ("response", "delay"),
    "damping": ("response", "momentum", "damping"),
    "mass": ("response", "momentum", "mass"),
    "overshoot": ("response", "costs"),
    "settling": ("response", "costs"),
    "energy": ("response", "costs"),
}


@dataclass
class ExperimentStages:
    """The stages of one experiment: what is stored, what is stale, and how to compute it.

    Parameters
    ----------
    processed : Path
    device, experiment : str
    trials : pyarrow.Table
        Rows of the trials table that belong to the experiment.
    """

    processed: Path
    device: str
    experiment: str
    trials: pa.Table
    _tables: dict[str, pa.Table] = field(default_factory=dict)

    @cached_property
    def rotation(self) -> bool:
        """Whether units are rotational.

        Raises
        ------
        StoreError
            If the experiment mixes translation and rotation.
        """
        motions = set(self.trials.column("motion").to_pylist())
        if len(motions) != 1:
            raise StoreError(
                f"device {self.device!r}, experiment {self.experiment!r}: its logs mix {sorted(motions)}. "
                "Name the experiments apart in the logs' headers and ingest them into a new folder."
            )
        return motions == {"rotation"}

    @cached_property
    def inputs_digest(self) -> str:
        """Hash of the logs and profiles that the samples came from."""
        columns = ("trial_id", "source_sha256", "profile_sha256", "sample_file", "first_row")
        rows = zip(*(self.trials.column(c).to_pylist() for c in columns), strict=True)
        return digest(sorted("|".join(map(str, row)) for row in rows))

    @cached_property
    def batch(self) -> TrialBatch:
        """All samples of the experiment, read when a stage has to be computed."""
        return load_batch(self.processed, self.trials)

    @cached_property
    def _found(self) -> response.Response:
        return response.find_response(self.batch)

    def key(self, stage: str) -> str:
        """Return the key under which the result of a stage is valid."""
        code = code_digest(*_SHARED_CODE, *_CODE[stage])
        return digest([stage, self.inputs_digest, code, *(self.key(need) for need in NEEDS[stage])])

    def is_stored(self, stage: str) -> bool:
        """Return whether a result with the present key is stored."""
        return self._stored_key(stage) == self.key(stage)

    def why_run(self, stage: str) -> str:
        """Return in words why a stage that is not reused has to run."""
        stored = self._stored_key(stage)
        return "no result is stored" if stored is None else "logs, code or an earlier stage changed since it was stored"

    def _stored_key(self, stage: str) -> str | None:
        return read_metadata(self._file(stage)).get("pipeline.key")

    def _file(self, stage: str) -> Path:
        return stage_file(self.processed, self.device, self.experiment, stage)

    def table(self, stage: str) -> pa.Table:
        """Return the result of a stage: from memory, from its file, or by computing and storing it."""
        if stage not in self._tables:
            if self.is_stored(stage):
                self._tables[stage] = read_table(self._file(stage))
            else:
                columns = _COMPUTE[stage](self)
                metadata = stamp(
                    stage=stage,
                    key=self.key(stage),
                    inputs=self.inputs_digest,
                    code=code_digest(*_SHARED_CODE, *_CODE[stage]),
                    parameters=json.dumps(self._parameters(stage)),
                )
                result = to_arrow(stage, columns, rotation=self.rotation, metadata=metadata)
                write_table(self._file(stage), result)
                self._tables[stage] = result
        return self._tables[stage]

    def _parameters(self, stage: str) -> dict[str, float | None]:
        """Values from earlier stages that a stage was computed with."""
        parameters: dict[str, float | None] = {}
        if "delay" in NEEDS[stage]:
            parameters["delay_samples"] = self.delay_estimate.value
        if "damping" in NEEDS[stage]:
            parameters["viscous_damping"] = self.damping_estimate.value
        return parameters

    def column(self, stage: str, name: str) -> Floats:
        """Return a numeric column of a stage as float64, null as NaN."""
        values = self.table(stage).column(name).to_numpy(zero_copy_only=False)
        return np.asarray(values, dtype=np.float64)

    def texts(self, stage: str, name: str) -> list[str]:
        """Return a text column of a stage, null as an empty string."""
        return [text or "" for text in self.table(stage).column(name).to_pylist()]

    @cached_property
    def verdicts(self) -> verdict.Verdicts:
        """Verdict of each trial, as stored."""
        return verdict.Verdicts(
            np.array(self.texts("response", "verdict"), dtype="<U9"),
            self.column("response", "growth_per_s"),
            tuple(self.texts("response", "reason")),
        )

    @cached_property
    def delay_estimate(self) -> Estimate:
        """Integer delay factor of the experiment."""
        found = np.nan_to_num(self.column("delay", "delay_samples"), nan=response.NO_ROW).astype(np.int64)
        return self._explained(aggregate.estimate_delay(found, sampling_period_s=self.sampling_period_s), "delay")

    @cached_property
    def damping_estimate(self) -> Estimate:
        """Viscous damping of the experiment."""
        limit = damping.by_limit(
            self.column("response", "damping"), self.column("response", "stiffness"), self.verdicts.growth_per_s
        )
        from_trials = self.column("damping", "viscous_damping")
        return aggregate.estimate_damping(limit, from_trials, self._unit("viscous_damping"))

    @cached_property
    def mass_estimate(self) -> Estimate:
        """Mass of the experiment."""
        corrected, plain = self.column("mass", "mass"), self.column("mass", "mass_momentum")
        return self._explained(aggregate.estimate_mass(corrected, plain, self._unit("mass")), "mass")

    def _explained(self, estimate: Estimate, stage: str) -> Estimate:
        """Return the estimate with the commonest reason of the trials, where it has no value."""
        if estimate.value is not None:
            return estimate
        return estimate.model_copy(update={"reason": f"{estimate.reason}; most trials: {self._why(stage)}"})

    def _unit(self, column: str) -> str:
        field_of_column = self.table("mass" if column == "mass" else "damping").schema.field(column)
        return str(field_of_column.metadata[b"unit"].decode())

    @cached_property
    def sampling_period_s(self) -> float:
        """Sampling period T [s], the same for all trials.

        Raises
        ------
        StoreError
            If trials differ.
        """
        periods = sorted(set(self.trials.column("sampling_period_s").to_pylist()))
        if len(periods) != 1:
            raise StoreError(
                f"device {self.device!r}, experiment {self.experiment!r}: sampling periods differ ({periods[:5]} s); "
                "expected one. Name the experiments apart in the logs' headers and ingest them into a new folder."
            )
        return float(periods[0])

    @cached_property
    def boundary_points(self) -> tuple[BoundaryPoint, ...]:
        """Measured stability boundary, as stored."""
        rows = self.table("boundary").to_pylist()
        return tuple(BoundaryPoint(**row) for row in rows)

    def cost(self, criterion: str) -> tuple[Floats, str]:
        """Return the cost of each trial by a criterion (NaN where there is none) and, if none has one, why.

        Energy costs take the mass of the experiment: cost = potential part + m times kinetic part.
        """
        if criterion == "overshoot":
            return self.column("overshoot", "overshoot"), self._why("overshoot")
        if criterion in SETTLING_BANDS:
            return self.column("settling", criterion), self._why("settling")
        w = ENERGY_CRITERIA.index(criterion)
        potential = self.column("energy", f"energy_potential_w{w}")
        estimate = self.mass_estimate
        if estimate.value is None:
            return np.full(len(potential), np.nan), f"energy needs the mass: {estimate.reason}"
        return potential + estimate.value * self.column("energy", f"energy_kinetic_w{w}"), self._why("energy")

    def _why(self, stage: str) -> str:
        reasons = [r for r in self.texts(stage, "reason") if r]
        return max(set(reasons), key=reasons.count) if reasons else ""

    def optimum(self, criterion: str) -> Optimum | None:
        """Return the best trial by a criterion, or None where no trial has that cost."""
        cost, _ = self.cost(criterion)
        table = self.table("response")
        return aggregate.choose_optimum(
            cost,
            self.column("response", "stiffness"),
            self.column("response", "damping"),
            tuple(table.column("trial_id").to_pylist()),
            unstable=self.verdicts.verdict == "unstable",
            floor=self.column("overshoot", "overshoot_floor") if criterion == "overshoot" else None,
        )


def required(stages: Iterable[str]) -> set[str]:
    """Return the stages and all that they need."""
    result: set[str] = set()
    for stage in stages:
        result |= {stage} | required(NEEDS[stage])
    return result


def _conditions(of: ExperimentStages) -> dict[str, Any]:
    return {"trial_id": list(of.batch.trial_id), "stiffness": of.batch.stiffness, "damping": of.batch.damping}


def _texts(reasons: Iterable[str]) -> list[str | None]:
    return [text or None for text in reasons]


def _integer(values: Floats) -> pa.Array:
    missing = ~np.isfinite(values)
    return pa.array(np.where(missing, 0, values).astype(np.int64), mask=missing)


def _response(of: ExperimentStages) -> dict[str, Any]:
    found = of._found
    judged = verdict.judge(of.batch, found)
    reasons = ("; ".join(part for part in pair if part) for pair in zip(judged.reason, found.reason, strict=True))
    edge = found.edge_row.astype(np.float64)
    return _conditions(of) | {
        "verdict": list(judged.verdict),
        "reason": _texts(reasons),
        "growth_per_s": judged.growth_per_s,
        "edge_row": _integer(np.where(found.has_edge, edge, np.nan)),
        **{name: getattr(found, name) for name in ("position_start", "position_final_expected")},
        **{name: getattr(found, name) for name in ("position_final_measured", "sensor_quantum", "sensor_noise")},
    }


def _boundary(of: ExperimentStages) -> dict[str, Any]:
    points = boundary.measured_boundary(
        of.column("response", "stiffness"), of.column("response", "damping"), of.verdicts.verdict
    )
    return {name: [getattr(p, name) for p in points] for name in ("damping", "stable", "unstable", "censored")}


def _delay(of: ExperimentStages) -> dict[str, Any]:
    found = delay.first_change(of.batch, of._found)
    samples = found.delay_samples.astype(np.float64)
    return _conditions(of) | {
        "delay_samples": _integer(np.where(samples >= 0, samples, np.nan)),
        "reason": _texts(found.reason),
    }


def _with_delay(
    of: ExperimentStages, compute: Callable[[int], dict[str, Any]], missing: tuple[str, ...]
) -> dict[str, Any]:
    """Columns of a stage that takes the delay of the experiment; nulls and the reason where there is none."""
    estimate = of.delay_estimate
    if estimate.value is None:
        nothing = dict.fromkeys(missing, [None] * len(of.batch))
        reason = {"reason": ["needs the delay, which is not known"] * len(of.batch)}
        return _conditions(of) | nothing | reason
    return _conditions(of) | compute(int(estimate.value))


def _damping(of: ExperimentStages) -> dict[str, Any]:
    def compute(samples: int) -> dict[str, Any]:
        found = damping.from_trials(of.batch, of._found, samples)
        return {"viscous_damping": found.viscous_damping, "reason": _texts(found.reason)}

    return _with_delay(of, compute, ("viscous_damping",))


def _mass(of: ExperimentStages) -> dict[str, Any]:
    def compute(samples: int) -> dict[str, Any]:
        found = mass.by_momentum(of.batch, of._found, samples)
        b = of.damping_estimate.value
        nothing = np.full(len(of.batch), np.nan)
        return {
            "mass_momentum": found.mass_momentum,
            "mass": nothing if b is None else mass.correct(found, b),
            "reason": _texts(found.reason),
        }

    return _with_delay(of, compute, ("mass_momentum", "mass"))


def _overshoot(of: ExperimentStages) -> dict[str, Any]:
    found = costs.overshoot(of.batch, of._found, of.verdicts)
    return _conditions(of) | {
        "overshoot": found.overshoot,
        "overshoot_floor": found.floor,
        "reason": _texts(found.reason),
    }


def _settling(of: ExperimentStages) -> dict[str, Any]:
    def compute(samples: int) -> dict[str, Any]:
        found = costs.settling(of.batch, of._found, of.verdicts, samples)
        return {name: _integer(values) for name, values in found.samples.items()} | {"reason": _texts(found.reason)}

    return _with_delay(of, compute, tuple(SETTLING_BANDS))


def _energy(of: ExperimentStages) -> dict[str, Any]:
    names = [(f"energy_potential_w{w}", f"energy_kinetic_w{w}") for w in range(3)]

    def compute(samples: int) -> dict[str, Any]:
        found = costs.energy(of.batch, of._found, of.verdicts, samples)
        columns: dict[str, Any] = {"horizon_samples": found.horizon_samples, "reason": _texts(found.reason)}
        for w, (potential, kinetic) in enumerate(names):
            columns |= {potential: found.potential[:, w], kinetic: found.kinetic[:, w]}
        return columns

    return _with_delay(of, compute, (*(n for pair in names for n in pair), "horizon_samples"))


_COMPUTE: dict[str, Callable[[ExperimentStages], dict[str, Any]]] = {
    "response": _response,
    "boundary": _boundary,
    "delay": _delay,
    "damping": _damping,
    "mass": _mass,
    "overshoot": _overshoot,
    "settling": _settling,
    "energy": _energy,
}

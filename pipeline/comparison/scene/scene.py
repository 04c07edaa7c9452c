"""Inputs of a comparison, and the stages that the requested results need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from pipeline.base.errors import DeviceError, StoreError, UsageError
from pipeline.device_data.devices import declared_spring, known_devices
from pipeline.measured.stages.stage_needs import NEEDS, required
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.criteria import (
    CRITERIA,
    FAMILIES,
    MEASURED,
    REPORTED,
    criterion_of,
    is_measured,
    members,
)
from pipeline.records.models import Device, Motion, Scene, Shown, TableLayout
from pipeline.records.results import Truth
from pipeline.rendering.labels import UNITS, Units
from pipeline.store.storage import Exclusion, list_devices, list_experiments

RUN, REUSE, LEAVE_OUT = "run", "reuse", "leave out"

TABLED = tuple(c.name for c in CRITERIA.values() if c.tabled)
"""Criteria in the tables of an experiment without published values."""


class PlannedStage(NamedTuple):
    """A line of the plan with stage, action (run, reuse, leave out), and reason."""

    stage: str
    action: str
    reason: str


@dataclass(frozen=True)
class StoredData:
    """Stored data of a comparison, which are its scene, the device if it is known, and the stages of its
    experiments."""

    scene: Scene
    device: Device | None
    experiments: tuple[ExperimentStages, ...]
    simulated: bool
    overlay: bool
    """Whether theory based on the estimates is also drawn. It needs delay, mass and damping."""
    truth: Mapping[str, Truth] = field(default_factory=dict)
    """Ground truth of simulated experiments, if known."""
    excluded: tuple[Exclusion, ...] = ()
    """Manually excluded trials of these experiments, including experiments in which all trials are excluded."""

    @property
    def motion(self) -> Motion:
        """Kind of motion, which is the same for all experiments of a scene."""
        return self.experiments[0].motion

    @property
    def units(self) -> Units:
        """Units for this motion."""
        return UNITS[self.motion]


def open_scene(
    device: str | Device,
    processed: Path,
    experiments: Sequence[str] | None,
    criteria: Sequence[str] | None,
    shown: Shown | None = None,
) -> StoredData:
    """Collect the stored data for a comparison of a device, which is given by its name or its device file.

    Raises
    ------
    DeviceError
        If no log of the device is stored, an experiment has no logs (the message lists the stored experiments), or all
        trials are excluded.
    UsageError
        If a criterion is unknown.
    StoreError
        If translation and rotation are mixed, because a report has one set of units.
    """
    known = device if isinstance(device, Device) else known_devices().get(device)
    device = device.name if isinstance(device, Device) else device
    chosen = tuple(dict.fromkeys(criteria or REPORTED))
    unknown = [c for c in chosen if not is_measured(c)]
    if unknown:
        others = "and any band or exponent, such as settle_3pct or energy_step_w0.5"
        raise UsageError(f"unknown criterion {unknown[0]!r}; expected criteria from {', '.join(MEASURED)}, {others}.")
    stored = list_experiments(processed, device)
    if not stored:
        devices = list_devices(processed)
        near = get_close_matches(device, devices, 1)
        first = "Name one of them, or ingest its logs" if devices else "Ingest logs first"
        advice = f"Did you mean {near[0]}?" if near else f"{first}: pipeline ingest LOGS --processed {processed}"
        raise DeviceError(
            f"{processed}: contains no logs of device {device!r}; found {', '.join(devices) or 'none at all'}. {advice}"
        )
    missing = [e for e in experiments or () if e not in stored]
    if missing:
        raise DeviceError(f"device {device!r} has no logs of experiment {missing[0]!r}; found {', '.join(stored)}.")
    chosen_names = tuple(e for e in stored if not experiments or e in experiments)
    requested = shown or Shown()
    every = [
        ExperimentStages.stored(processed, device, e, declared_spring(known, e), requested.measuring)
        for e in chosen_names
    ]
    data = tuple(d for d in every if d.trials.num_rows)
    left_out = [d.experiment for d in every if not d.trials.num_rows and (experiments or not data)]
    if left_out:
        raise DeviceError(
            f"device {device!r}, experiment {left_out[0]!r}: all of its trials are excluded manually; expected at "
            "least one used trial. `pipeline status` lists them, `pipeline exclude TRIAL --undo` restores one."
        )
    names = tuple(d.experiment for d in data)
    grips = {grip for d in data for grip in d.trials.column("grip").unique().to_pylist()}
    added = {n for d in data for n in d.trials.column("added_delay_samples").unique().to_pylist()}
    motions = sorted({motion for d in data for motion in d.trials.column("motion").unique().to_pylist()})
    if len(motions) > 1:
        raise StoreError(
            f"device {device!r}: its logs mix {' and '.join(motions)}; expected one kind of motion for one device. "
            "Compare the experiments separately (--experiment), or use different device names in the logs' headers."
        )
    scene = Scene(
        device=device,
        experiments=names,
        criteria=chosen,
        delay_sweep=len(added) > 1,
        operator=bool(grips - {"none"}),
        shown=requested,
    )
    needed = required(_wanted(chosen))
    # For an unknown device, theory can only be based on the estimates.
    estimates = requested.has_overlay("estimates") or (known is None and requested.has_overlay("theory"))
    return StoredData(
        scene=scene,
        device=known,
        experiments=data,
        simulated=any(any(d.trials.column("simulated").to_pylist()) for d in data),
        overlay=estimates and (known is None or {"device", "mass"} <= needed),
        excluded=tuple(one for d in every for one in d.excluded),
    )


def _wanted(criteria: Sequence[str]) -> set[str]:
    """Return the stages that produce the requested results."""
    families = [criterion_of(c).family for c in criteria]
    return {"boundary", *(family.name for family in families)}


def needed_stages(data: StoredData) -> set[str]:
    """Return the stages with measured results that the scene needs."""
    needed = required(_wanted(data.scene.criteria))
    if data.scene.shown.has_table("outcomes") or data.scene.shown.has_figure("trials"):
        needed |= {"outcome"}
    if data.overlay:
        needed |= required(("model", "delay", "mass"))
    return needed


_LEFT_OUT = {  # stages that are missing here compute results that a report shows only on request
    "outcome": "neither the table of outcomes nor the trials are shown",
    "parts": "neither the measured boundary nor a requested cost needs a device",
    "device": "neither the measured boundary nor a requested cost needs delay or mass",
    "model": "neither delay nor mass is requested",
    "delay": "neither the measured boundary nor a requested cost needs the delay",
    "mass": "only energy costs need the mass",
    **{name: f"no {family.title} is requested" for name, family in FAMILIES.items() if members(family, REPORTED)},
}


def plan_measured(data: StoredData) -> list[PlannedStage]:
    """Return the action for each experiment and stage, with its reason."""
    needed = needed_stages(data)
    plan = []
    for experiment in data.experiments:
        for stage in NEEDS:
            name = f"{experiment.experiment}: {stage}"
            if stage not in needed:
                plan += [PlannedStage(name, LEAVE_OUT, _LEFT_OUT[stage])] if stage in _LEFT_OUT else []
            elif experiment.is_stored(stage):
                plan.append(PlannedStage(name, REUSE, "logs, exclusions, code and earlier stages are unchanged"))
            else:
                plan.append(PlannedStage(name, RUN, experiment.why_run(stage)))
    return plan


def layouts(data: StoredData) -> tuple[TableLayout, ...]:
    """Return the tables that the stored experiments can fill.

    Published layouts come first, then one for each other experiment.
    """
    requested = data.scene.criteria
    stored = data.scene.experiments
    known = data.device.tables if data.device else ()
    result = []
    for table in known:
        experiments = tuple(e for e in table.experiments if e in stored)
        criteria = tuple(c for c in table.criteria if c in requested)
        if experiments and criteria and (table.kind == "optima" or len(experiments) > 1):
            name, source, kind = table.name, table.theory_from, table.kind
            own = TableLayout(name=name, criteria=criteria, experiments=experiments, theory_from=source, kind=kind)
            result.append(own)
    covered = {e for table in result for e in table.experiments}
    usual = tuple(c for c in TABLED if c in requested) or tuple(c for c in REPORTED if c in requested)
    extra = tuple(c for c in requested if c not in REPORTED)  # these criteria are in no published table
    least = min((added_delay(e) for e in data.experiments), default=0)
    for stages in data.experiments:
        experiment = stages.experiment
        # For a delay sweep of a device without layouts, a single table over delay is clearer than a table for each
        # delay.
        swept = data.device is None and data.scene.delay_sweep and added_delay(stages) > least
        criteria = (() if experiment in covered else usual) + extra
        if criteria and not swept:
            name = f"experiment {experiment}"
            result.append(TableLayout(name=name, criteria=criteria, experiments=(experiment,), theory_from=experiment))
    # An overshoot of zero at every delay gives no information (Table D.6).
    sweep = tuple(c for c in (*TABLED, *extra) if c in requested and not criterion_of(c).family.levels)
    if data.device is None and data.scene.delay_sweep and sweep:
        own = TableLayout(name="delay", criteria=sweep, experiments=stored, theory_from=stored[0], kind="delay")
        result.append(own)
    return tuple(table for table in result if _in_use(table, data.scene.shown))


def _in_use(table: TableLayout, shown: Shown) -> bool:
    """Return whether a layout is shown as a table or determines figures."""
    return shown.has_table(table.name) or shown.has_figure("delay" if table.kind == "delay" else "maps")


def added_delay(stages: ExperimentStages) -> int:
    """Return the smallest delay that was added on purpose in the trials of an experiment [samples]."""
    return int(min(stages.trials.column("added_delay_samples").to_pylist()))

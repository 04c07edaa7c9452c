"""What a comparison needs, planned backwards from what is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import DeviceError, StoreError, UsageError
from pipeline.device_data.devices import known_devices
from pipeline.measured.stages.stages import STAGES, ExperimentStages, required
from pipeline.records.models import CRITERIA, ENERGY_CRITERIA, SETTLING_BANDS, Device, Scene, Shown
from pipeline.store.storage import list_devices, list_experiments, read_trials

RUN, REUSE, LEAVE_OUT = "run", "reuse", "leave out"


@dataclass(frozen=True)
class PlannedStage:
    """One line of the plan: stage, what is done with it (run, reuse, leave out), and why."""

    stage: str
    action: str
    reason: str

    def as_row(self) -> tuple[str, str, str]:
        """Return the line as (stage, action, reason)."""
        return self.stage, self.action, self.reason


@dataclass(frozen=True)
class SceneData:
    """A scene with the device, if it is known, and the stages of its experiments."""

    scene: Scene
    device: Device | None
    experiments: tuple[ExperimentStages, ...]
    simulated: bool
    overlay: bool
    """Whether theory is also drawn from the estimates, which needs delay, mass and damping."""


def open_scene(
    device: str,
    processed: Path,
    experiments: Sequence[str] | None,
    criteria: Sequence[str] | None,
    shown: Shown | None = None,
) -> SceneData:
    """Collect what is stored for a comparison.

    Raises
    ------
    DeviceError
        If no log of the device is stored, or an experiment has none; the message lists what there is.
    UsageError
        For an unknown criterion.
    StoreError
        If translation and rotation are mixed: one report has one set of units.
    """
    chosen = tuple(dict.fromkeys(criteria or CRITERIA))
    unknown = [c for c in chosen if c not in CRITERIA]
    if unknown:
        raise UsageError(f"unknown criterion {unknown[0]!r}; expected some of {', '.join(CRITERIA)}.")
    stored = list_experiments(processed, device)
    if not stored:
        devices = list_devices(processed)
        raise DeviceError(
            f"{processed}: holds no logs of device {device!r}; found {', '.join(devices) or 'none at all'}. "
            "Ingest logs first: pipeline ingest LOGS --processed " + str(processed)
        )
    missing = [e for e in experiments or () if e not in stored]
    if missing:
        raise DeviceError(f"device {device!r} has no logs of experiment {missing[0]!r}; found {', '.join(stored)}.")
    names = tuple(e for e in stored if not experiments or e in experiments)
    known = known_devices().get(device)
    data = tuple(ExperimentStages(processed, device, e, read_trials(processed, device, e)) for e in names)
    grips = {grip for d in data for grip in d.trials.column("grip").unique().to_pylist()}
    added = {n for d in data for n in d.trials.column("added_delay_samples").unique().to_pylist()}
    motions = sorted({motion for d in data for motion in d.trials.column("motion").unique().to_pylist()})
    if len(motions) > 1:
        raise StoreError(
            f"device {device!r}: its logs mix {' and '.join(motions)}; expected one kind of motion for one device. "
            "Compare the experiments apart (--experiment), or name the devices apart in the logs' headers."
        )
    asked = shown or Shown()
    scene = Scene(
        device=device,
        experiments=names,
        criteria=chosen,
        delay_sweep=len(added) > 1,
        operator=bool(grips - {"none"}),
        shown=asked,
    )
    needed = required(_wanted(chosen))
    # for a device that is not known, theory by the estimates is the only one
    estimates = asked.has_overlay("estimates") or (known is None and asked.has_overlay("theory"))
    return SceneData(
        scene=scene,
        device=known,
        experiments=data,
        simulated=any(any(d.trials.column("simulated").to_pylist()) for d in data),
        overlay=estimates and (known is None or {"delay", "mass", "damping"} <= needed),
    )


def _wanted(criteria: Sequence[str]) -> set[str]:
    """Stages that produce what is asked for."""
    wanted = {"boundary"}
    if "overshoot" in criteria:
        wanted.add("overshoot")
    if any(c in SETTLING_BANDS for c in criteria):
        wanted.add("settling")
    if any(c in ENERGY_CRITERIA for c in criteria):
        wanted |= {"energy", "mass", "windows"}
    return wanted


def needed_stages(data: SceneData) -> set[str]:
    """Return the stages of the measured branch that the scene needs."""
    needed = required(_wanted(data.scene.criteria))
    if data.scene.shown.has_table("outcomes") or data.scene.shown.has_figure("trials"):
        needed |= {"outcome"}
    if data.overlay:
        needed |= required(("delay", "mass", "damping"))
    # nothing is said of a device by its logs before they are held against the law that they were made by
    return needed | {"wall_law"} if "delay" in needed else needed


_LEFT_OUT = {
    "outcome": "neither the table of outcomes nor the trials are shown",
    "wall_law": "no estimate is shown",
    "delay": "overshoot and the measured boundary need no delay",
    "model": "neither mass nor damping nor settling time is asked for",
    "damping": "damping enters no measured cost, and no theory is drawn from estimates",
    "mass": "only energy costs need the mass",
    "overshoot": "overshoot is not asked for",
    "settling": "no settling time is asked for",
    "energy": "no energy cost is asked for",
    "windows": "only energy costs need the mass",
}


def plan_measured(data: SceneData) -> list[PlannedStage]:
    """Return for each experiment and stage what is done with it, and why."""
    needed = needed_stages(data)
    plan = []
    for experiment in data.experiments:
        for stage in STAGES:
            name = f"{experiment.experiment}: {stage}"
            if stage not in needed:
                plan.append(PlannedStage(name, LEAVE_OUT, _LEFT_OUT[stage]))
            elif experiment.is_stored(stage):
                plan.append(PlannedStage(name, REUSE, "logs, code and earlier stages are unchanged"))
            else:
                plan.append(PlannedStage(name, RUN, experiment.why_run(stage)))
    return plan

"""Records of devices, experiments, tables and scenes. They are frozen and validated, in SI.

Units depend on the motion of the device: N, N/m, Ns/m, kg and m for ``translation``; Nm, Nm/rad, Nms/rad, kg m^2 and
rad for ``rotation``. ``docs/definitions.md`` lists the symbols. The JSON Schemas in ``schemas/`` are generated from
these classes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import ConfigDict, Field, ValidationInfo, model_validator

from pipeline.base.errors import ParameterError
from pipeline.device.loop import Loop
from pipeline.device.parts import LoopTable, NonNegative, Number, Positive, Sensor, SimulationParts
from pipeline.records.criteria import MEASURED, REPORTED, SETTLING_BANDS, is_measured
from pipeline.records.findings import BoundaryPoint, Estimate, Record
from pipeline.records.findings import Grip as Grip
from pipeline.records.findings import Motion as Motion
from pipeline.records.findings import Name as Name

STATED = "stated"
"""Validation context of files written by users, in which a stated delay must not contradict the stated jitter."""


class Limits(Record):
    """Largest distance from the workspace centre [m, rad] and, if known, largest force [N, Nm]."""

    travel: Positive = 1.0
    force: Positive | None = None


class Experiment(Record):
    """An experiment: configuration, plant as published, and the grid of tested (K, B).

    If the grid is omitted, it covers the walls that are stable in theory (`simulation.tested_grid`). If the delay of
    each command is drawn from ``jitter_samples``, ``delay_samples`` is their mean. A file may state any delay between
    the smallest and the largest.
    """

    name: Name
    configuration: str = ""
    grip: Grip = "none"
    mass: Positive
    damping: NonNegative = 0.0
    stiffness: NonNegative = 0.0
    delay_samples: NonNegative
    added_delay_samples: Annotated[int, Field(ge=0)] = 0
    jitter_samples: tuple[Annotated[int, Field(ge=0)], ...] = ()
    damping_first: Number = 0.0
    damping_last: Number | None = None
    damping_step: Positive | None = None
    stiffness_step: Positive | None = None
    loop: LoopTable = LoopTable()
    simulation: SimulationParts = SimulationParts()

    @model_validator(mode="after")
    def _grid_is_ordered(self) -> Self:
        if self.damping_last is not None and self.damping_last < self.damping_first:
            raise ValueError(f"damping_last ({self.damping_last}) is below damping_first ({self.damping_first})")
        return self

    @model_validator(mode="after")
    def _delay_is_that_of_its_jitter(self, info: ValidationInfo) -> Self:
        if self.jitter_samples:
            low, high = min(self.jitter_samples), max(self.jitter_samples)
            if info.context == STATED and not low <= self.delay_samples <= high:
                raise ValueError(
                    f"delay_samples ({self.delay_samples:g}) is outside the range of jitter_samples, {low:g} to "
                    f"{high:g}. Set delay_samples to the mean of jitter_samples, or omit it"
                )
            # The frozen record is still under construction.
            object.__setattr__(self, "delay_samples", sum(self.jitter_samples) / len(self.jitter_samples))
        return self


class PublishedBound(Record):
    """Straight bound of measured limits, K <= stiffness + slope B [N/m, N/m per Ns/m], by equation number.

    Source: Hulin 2017, eq. 6.5.
    """

    device: Name
    equation: Name
    stiffness: float
    slope: float


class PublishedMass(Record):
    """Mass or inertia [kg, kg m^2] of a device without an operator that was not estimated from logs, keyed by section.

    Source: Hulin 2017, secs. 6.1.2 and 6.2.2.
    """

    device: Name
    section: Name
    mass: Positive


class TableLayout(Record):
    """Layout of a published table: its criteria, its experiments, and the source of the parameters for theory."""

    name: Name
    criteria: tuple[str, ...]
    experiments: tuple[Name, ...]
    theory_from: Name
    kind: Literal["optima", "delay"] = "optima"

    @model_validator(mode="after")
    def _criteria_are_known(self) -> Self:
        unknown = [c for c in self.criteria if not is_measured(c)]
        if unknown:
            raise ValueError(f"unknown criteria {unknown}; expected some of {list(MEASURED)}")
        return self


class Device(Record):
    """Haptic device as data: all information that simulation, theory and reports need.

    A device file may omit further fields (`device_data.devices.read_device`). ``published_as`` is the device whose
    printed values appear next to the values of this device in tables, by default the device itself.
    """

    name: Name
    title: str
    source: str = ""
    published_as: str = ""
    motion: Motion = "translation"
    sampling_period_s: Positive
    step: Positive = 1.0
    centre: Number = 0.0
    duration_s: Positive
    baseline_s: Positive
    sensor: Sensor = Sensor()
    limits: Limits = Limits()
    loop: LoopTable = LoopTable()
    simulation: SimulationParts = SimulationParts()
    experiments: tuple[Experiment, ...] = Field(alias="experiment", min_length=1)
    tables: tuple[TableLayout, ...] = Field(default=(), alias="table")

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_by_name=True)

    def loop_table(self, experiment: Experiment) -> LoopTable:
        """Return the ``[loop]`` table of an experiment, with missing entries taken from the device."""
        return experiment.loop.over(self.loop)

    def loop_for(self, experiment: Experiment) -> Loop:
        """Return the loop of an experiment.

        Raises
        ------
        ParameterError
            If the parameters contradict each other.
        """
        return Loop(
            mass=experiment.mass,
            damping=experiment.damping,
            stiffness=experiment.stiffness,
            sampling_period_s=self.sampling_period_s,
            delay_samples=experiment.delay_samples,
            motion=self.motion,
            jitter_samples=experiment.jitter_samples,
            sensor=self.sensor,
            force_limit=self.limits.force,
            **dict(self.loop_table(experiment)),
        )

    def simulation_of(self, experiment: Experiment) -> SimulationParts:
        """Return the simulation settings of an experiment, with missing settings taken from the device."""
        return experiment.simulation.over(self.simulation)

    @model_validator(mode="after")
    def _loops_are_possible(self) -> Self:
        mistakes = []
        for experiment in self.experiments:
            of_experiment = self.simulation_of(experiment).mistakes(self.duration_s, self.limits.force)
            try:
                self.loop_for(experiment)
            except ParameterError as error:
                of_experiment.insert(0, str(error))
            mistakes += [f"experiment {experiment.name!r}: {mistake}" for mistake in of_experiment]
        if mistakes:
            raise ValueError("; ".join(mistakes))
        return self

    @model_validator(mode="after")
    def _names_fit_together(self) -> Self:
        names = [e.name for e in self.experiments]
        double = sorted({n for n in names if names.count(n) > 1})
        if double:
            raise ValueError(f"experiment names must be unique; given more than once: {double}")
        for table in self.tables:
            missing = [n for n in (*table.experiments, table.theory_from) if n not in names]
            if missing:
                raise ValueError(f"table {table.name} names experiments that are not defined: {missing}")
        if self.baseline_s >= self.duration_s:
            raise ValueError(f"baseline_s ({self.baseline_s}) must be shorter than duration_s ({self.duration_s})")
        return self


class Deviation(Record):
    """Factors of the deviation of a measured optimal cost, minus 1, in percent. Their product is the total deviation.

    ``range`` and ``grid`` are the effects of the tested range and grid on theory. ``model`` is the deviation from
    theory of the smoothed measured cost, which is free of the noise of single trials, with its 95 % interval.
    ``selection`` is the deviation of the best single trial from the smoothed cost. The model component is ``steady`` if
    it does not depend on any single trial.
    """

    range: float
    grid: float
    model: float
    selection: float
    model_low: float
    model_high: float
    steady: bool = True


class ComparisonRow(Record):
    """A row of Tables D.1 to D.6: a computed or measured value with the published value.

    ``experiment`` and ``trial_id`` name the trial of a measured row. In rows of theory, both are null, and so are the
    deviations of cost, stiffness and damping from discrete theory. ``published_deviation_percent`` is the deviation of
    a printed measurement from the printed theory. ``theory_mass``, ``theory_damping`` and ``theory_source`` state the
    device of a row of theory. ``margin`` is the stability limit at the damping of the wall, divided by its stiffness:
    theory's limit in rows of theory, and the lower end of the measured one in other rows.

    A table may compare several experiments with the theory of one of them. Where the stated device of an experiment is
    another one, ``own_deviation_percent`` is the deviation of its cost from the discrete theory of this device, and
    ``own_model_percent`` the part of it that is due to the device. Both are null otherwise.
    """

    table: str
    criterion: str
    condition: str
    delay_samples: float | None
    stiffness: float | None
    damping: float | None
    cost: float | None
    published_stiffness: float | None = None
    published_damping: float | None = None
    published_cost: float | None = None
    published_deviation_percent: float | None = None
    deviation_percent: float | None = None
    stiffness_deviation_percent: float | None = None
    damping_deviation_percent: float | None = None
    deviation: Deviation | None = None
    own_deviation_percent: float | None = None
    own_model_percent: float | None = None
    censored: bool = False
    note: str | None = None
    experiment: str | None = None
    trial_id: str | None = None
    theory_mass: float | None = None
    theory_damping: float | None = None
    theory_source: str | None = None
    margin: float | None = None


FigureKind = Literal["response", "boundaries", "plane", "maps", "residuals", "delay", "trend", "trials"]
"""Figures of a report.

The figures are the first response (Fig. 6.2), boundaries (6.3, 6.4, 6.9), boundaries in the normalised plane, cost maps
(6.5 to 6.7, 6.10, 6.11), measured minus theory, costs over delay (6.12), trends, and the trials to inspect.
"""

Overlay = Literal["theory", "estimates", "band", "linear", "passive", "friction", "robust"]
"""Curves drawn over measured boundaries.

The overlays are theory, the limit of the identified loop with its 95 % interval, the linear condition (3.25), the
passive region (4.12), the limit for a larger step (for a device with friction), and, only on request, the walls that
are stable with any spring (4.3.3).
"""


MOMENTUM_WINDOW_S = 0.015
"""Length of the window of the momentum balance, starting at the command edge (6.1.2). With a longer window, the
velocity would saturate real drives."""


class Measuring(Record):
    """Conventions of measurements, which follow the thesis.

    Parameters
    ----------
    final : {"expected", "measured"}
        Final position to which costs refer: x_0 + F_0/K (6.1), or the mean of the last tenth of the log.
    momentum_delay : int, optional
        Delay [samples] for the momentum balance (6.1.2: 5). By default, the delay from the first change of the
        position.
    momentum_window_s : float
        Length of the window of the momentum balance, starting at the command edge [s].
    """

    final: Literal["expected", "measured"] = "expected"
    momentum_delay: int | None = Field(default=None, ge=0)
    momentum_window_s: float = Field(default=MOMENTUM_WINDOW_S, gt=0, allow_inf_nan=False)


class Shown(Record):
    """Content of a report, and conventions of its measurements. None includes everything with available data.

    ``tables`` are names of published tables (``D.1``) or of other tables of the report (``boundary``). ``delays`` are
    the delays [samples] of the theoretical curves that are drawn with boundaries without operator, by default those of
    the device file.
    """

    figures: tuple[FigureKind, ...] | None = None
    tables: tuple[Name, ...] | None = None
    overlays: tuple[Overlay, ...] | None = None
    delays: tuple[NonNegative, ...] | None = None
    measuring: Measuring = Measuring()

    def has_figure(self, kind: FigureKind) -> bool:
        """Return True if a figure is requested."""
        return self.figures is None or kind in self.figures

    def has_table(self, name: str) -> bool:
        """Return True if a table is requested."""
        return self.tables is None or name in self.tables

    def has_overlay(self, kind: Overlay) -> bool:
        """Return True if an overlay is requested. By default, all overlays except the robust region are requested."""
        return kind != "robust" if self.overlays is None else kind in self.overlays


class Scene(Record):
    """Inputs of a comparison, from which the required stages follow."""

    device: Name
    experiments: tuple[Name, ...]
    criteria: tuple[str, ...] = REPORTED
    delay_sweep: bool = False
    operator: bool = False
    shown: Shown = Shown()


_BANDS = {round(100 * band): name for name, band in SETTLING_BANDS.items()}

if TYPE_CHECKING:
    Band = int
    CriterionWord = str
else:
    Band = Literal[tuple(_BANDS)]
    """Settling bands [%] for which a cost exists."""

    CriterionWord = Literal[("settle", *MEASURED)]
    """A criterion in a scene file. ``settle`` means the settling times for its ``bands``."""


class SceneFile(Shown):
    """Scene as a TOML file: the content of a report. A missing key includes everything with available data.

    Parameters
    ----------
    device : str
    experiments : tuple of str, optional
    criteria : tuple of str, optional
    bands : tuple of int
        Settling bands [%] of the criterion ``settle``.
    delays, overlays, figures, tables, measuring : optional
        As in `Shown`.
    report : str, optional
        HTML file, relative to the folder in which the command is run.
    """

    device: Name
    experiments: tuple[Name, ...] | None = Field(default=None, min_length=1)
    criteria: tuple[CriterionWord, ...] | None = Field(default=None, min_length=1)
    bands: tuple[Band, ...] = Field(default=tuple(_BANDS), min_length=1)
    delays: tuple[NonNegative, ...] | None = Field(default=None, min_length=1)
    report: Name | None = None

    @property
    def chosen_criteria(self) -> tuple[str, ...]:
        """Criteria with ``settle`` expanded, without duplicates."""
        settling = tuple(_BANDS[band] for band in self.bands)
        words = self.criteria or ("settle", *(name for name in REPORTED if name not in SETTLING_BANDS))
        return tuple(dict.fromkeys(c for word in words for c in (settling if word == "settle" else (word,))))

    @property
    def shown(self) -> Shown:
        """Requested content of the comparison."""
        return Shown(**{name: getattr(self, name) for name in Shown.model_fields})


SCHEMA_MODELS: dict[str, type[Record]] = {
    "device": Device,
    "experiment": Experiment,
    "estimate": Estimate,
    "boundary_point": BoundaryPoint,
    "comparison_row": ComparisonRow,
    "scene": Scene,
    "scene_file": SceneFile,
}
"""Records whose JSON Schema is stored in ``schemas/<name>.json``."""

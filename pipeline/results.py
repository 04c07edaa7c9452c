"""Finished numbers of a comparison: what `compare --json` prints and what figures and report are drawn from.

Records (pydantic) are the JSON document; the dataclasses below them carry the arrays of the figures.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from pydantic import Field

from pipeline.accuracy import AccuracyReport
from pipeline.batch import Floats
from pipeline.models import BoundaryPoint, ComparisonRow, Estimate, ModelCheck, Motion, Optimum, Record


class TheoryParameters(Record):
    """Parameters of a theoretical curve or map: m [kg, kg m^2], b, k, T [s], d and where they come from."""

    mass: float
    damping: float
    stiffness: float
    sampling_period_s: float
    delay_samples: float
    source: str


class MassWindow(Record):
    """Mass by the momentum balance of the thesis for one window: median and scatter of the trials that have one."""

    window_s: float
    mass: float | None
    scatter: float | None
    trials: int


class OtherDefinitions(Record):
    """Settling time [samples] and overshoot [1] of one trial by this report and by other tools."""

    criterion: str
    trial_id: str
    stiffness: float
    damping: float
    settle_2pct: float | None
    settle_matlab_final_value: float | None
    settle_matlab_peak_error: float | None
    settle_python_control: float | None
    overshoot: float | None
    overshoot_last_sample: float | None


class ExperimentResult(Record):
    """All that was found for one experiment."""

    experiment: str
    configuration: str
    grip: str
    simulated: bool
    trials: int
    verdicts: dict[str, int]
    outcomes: dict[str, int] = Field(default_factory=dict)
    model_check: ModelCheck | None = None
    mass_windows: tuple[MassWindow, ...] = ()
    other_definitions: tuple[OtherDefinitions, ...] = ()
    estimates: dict[str, Estimate]
    boundary: tuple[BoundaryPoint, ...]
    optimum: dict[str, Optimum]
    missing: dict[str, str] = Field(default_factory=dict)
    theory: TheoryParameters | None = None


class ComparisonResult(Record):
    """The document that `pipeline compare --json` prints."""

    device: str
    title: str
    motion: Motion
    known_device: bool
    simulated: bool
    criteria: tuple[str, ...]
    experiments: tuple[ExperimentResult, ...]
    tables: tuple[ComparisonRow, ...]
    summary: tuple[str, ...]
    warnings: tuple[str, ...]
    report: str | None = None
    provenance: dict[str, str]


@dataclass(frozen=True, eq=False)
class Curve:
    """A line in the plane of stiffness (abscissa) and damping (ordinate), in physical units.

    ``kind`` is ``measured`` (solid), ``theory`` (dashed), ``linear`` (dotted) or ``band`` (thin dots).
    A label that begins with an underscore is not shown. ``censored`` marks the points
    of a measured curve where the tested range ended before an unstable trial.
    """

    label: str
    kind: str
    stiffness: Floats
    damping: Floats
    censored: Floats | None = None


@dataclass(frozen=True)
class BoundaryFigure:
    """Stability boundaries of several experiments against theory (Figs. 6.3, 6.4, 6.9); panels share axes."""

    identifier: str
    title: str
    caption: str
    panels: tuple[tuple[str, tuple[Curve, ...]], ...]


@dataclass(frozen=True, eq=False)
class CostMap:
    """One cost map: a theoretical grid, or the trials of an experiment.

    Parameters
    ----------
    label : str
    kind : str
        ``theory`` or ``measured``.
    stiffness, damping : float64, shapes (p,), (q,)
        Axes of the grid [N/m, Nm/rad], [Ns/m, Nms/rad].
    cost : float64, shape (q, p)
        Cost; NaN where unstable, not tested or not available.
    boundary : Curve
        Stability boundary that belongs to the map.
    optimum : Optimum or None
    trial_stiffness, trial_damping, trial_cost : float64, shape (n,)
        The single trials (empty for theory).
    """

    label: str
    kind: str
    stiffness: Floats
    damping: Floats
    cost: Floats
    boundary: Curve
    optimum: Optimum | None
    trial_stiffness: Floats
    trial_damping: Floats
    trial_cost: Floats


@dataclass(frozen=True)
class CostFigure:
    """Cost maps of one criterion side by side with the front view below (Figs. 6.5 to 6.7, 6.10, 6.11)."""

    identifier: str
    title: str
    caption: str
    criterion: str
    maps: tuple[CostMap, ...]


@dataclass(frozen=True, eq=False)
class DelayPanel:
    """Optimal cost over total delay for one criterion (Fig. 6.12); an entry without data is NaN.

    ``damped`` is the theory for the relative damping named in ``damped_label``.
    """

    criterion: str
    delay_samples: Floats
    theory: Floats
    damped: Floats
    damped_label: str
    measured: Floats


@dataclass(frozen=True)
class DelayFigure:
    """Influence of delay on the optimal costs, one panel a criterion (Fig. 6.12)."""

    identifier: str
    title: str
    caption: str
    panels: tuple[DelayPanel, ...]


@dataclass(frozen=True)
class ReportData:
    """Everything that one HTML report shows."""

    result: ComparisonResult
    boundaries: tuple[BoundaryFigure, ...] = ()
    costs: tuple[CostFigure, ...] = ()
    delays: tuple[DelayFigure, ...] = ()
    stages: tuple[tuple[str, str, str], ...] = field(default=())
    """Stage, what was done with it (run, reuse, leave out), and why."""
    accuracy: AccuracyReport | None = None
    """Error and run time of the methods behind the theory, where `pipeline accuracy` was run with this code here."""

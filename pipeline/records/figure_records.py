"""What figures are drawn from: finished curves, maps and responses, in SI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from pipeline.records.batch import Floats
from pipeline.records.findings import Optimum
from pipeline.records.models import FigureKind

P = TypeVar("P")


@dataclass(frozen=True)
class Figure(Generic[P]):
    """A figure of a report: panels of one kind side by side.

    Parameters
    ----------
    kind : FigureKind
        ``boundaries`` (Figs. 6.3, 6.4, 6.9), and ``plane``, whose curves hold alpha = K T^2/m and beta = B T/m in place
        of stiffness and damping: panels are `Limits`. ``maps`` (Figs. 6.5 to 6.7, 6.10, 6.11): `CostMap`. ``delay``
        (Fig. 6.12): `DelayPanel`. ``trend``: `TrendPanel`. ``response`` (Fig. 6.2): one `Response`.
        ``residuals``: `ResidualMap`.
    identifier : str
        Unique in the report.
    title, caption : str
    panels : tuple
    criterion : str
        Whose costs are shown, where they are of one.
    group : str
        What figures of all criteria show: costs of a table's experiments, or departures from theory.
    theory_label : str
        Names the dashed curves in the legend where their own labels stand beside them or are not shown.
    simulated : bool
        Whether it shows simulated logs, which each panel then bears on it.
    """

    kind: FigureKind
    identifier: str
    title: str
    caption: str
    panels: tuple[P, ...]
    criterion: str = ""
    group: str = ""
    theory_label: str = ""
    simulated: bool = False


@dataclass(frozen=True, eq=False)
class Curve:
    """A line in the plane of stiffness (abscissa) and damping (ordinate), in physical units.

    ``kind`` is ``measured`` (solid), ``theory`` (dashed), ``linear`` and ``bound`` (dotted: condition (3.25), and
    the straight upper bound of a measurement), ``friction`` (dash, dot, dot), ``passive`` (thin, filled), ``robust``
    (thin), ``band`` (thin dots), ``envelope`` (filled between ``low`` and ``high``), ``use`` (a filled outline), or
    ``stable`` and ``unstable`` (dots and crosses, one a trial). A label that begins with an
    underscore is not shown. ``censored`` marks the points of a measured curve where the tested range ended before an
    unstable trial. ``low`` and ``high`` are stiffnesses at the dampings of the curve: an envelope, or what a measured
    limit leaves open (NaN where that is not known). ``number`` is the place of its experiment in the report, by which
    it has the same colour and marker in each figure; None where it belongs to none.
    """

    label: str
    kind: str
    stiffness: Floats
    damping: Floats
    censored: Floats | None = None
    low: Floats | None = None
    high: Floats | None = None
    number: int | None = None


Limits = tuple[str, tuple[Curve, ...]]
"""Title and curves of a panel of stability boundaries; all panels of a figure share their axes."""


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
    best_damping, best_stiffness : Curve or None
        Optimal curves: best damping for each stiffness, best stiffness for each damping.
    lines : float64, shape (q, p), or None
        Costs of which lines of equal value are drawn, where these are not ``cost`` itself.
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
    best_damping: Curve | None = None
    best_stiffness: Curve | None = None
    lines: Floats | None = None


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


@dataclass(frozen=True, eq=False)
class Response:
    """One step response with a close-up of its beginning (Fig. 6.2).

    Parameters
    ----------
    time : float64, shape (n,)
        Time after the command edge [s].
    position : float64, shape (n,)
        Displacement [m, rad].
    command : float64, shape (n,)
        Commanded force [N, Nm], before any delay.
    sampling_period_s : float
        T [s].
    first_change : int
        Rows from the command edge to the first change of position: t_obs/T (6.2).
    final : float
        Displacement at rest F_0/K [m, rad].
    period : tuple of float or None
        Time [s] of two neighbouring maxima, which stand one oscillation period apart; None where there are not two.
    """

    time: Floats
    position: Floats
    command: Floats
    sampling_period_s: float
    first_change: int
    final: float
    period: tuple[float, float] | None


@dataclass(frozen=True)
class TrendPanel:
    """A quantity over experiments, in the order in which they are drawn.

    Parameters
    ----------
    label : str
        Quantity with its unit.
    names : tuple of (str, str)
        Of each experiment, and what its logs say in a header line.
    value, low, high : tuple of float or None
        Value and 95 % interval of each.
    bound : tuple of bool
        Whether a value is a lower bound only.
    """

    label: str
    names: tuple[tuple[str, str], ...]
    value: tuple[float | None, ...]
    low: tuple[float | None, ...]
    high: tuple[float | None, ...]
    bound: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class Beside:
    """The response of a loop beside a log.

    Parameters
    ----------
    label, source : str
        Its name in the figure, and where the loop comes from.
    position : float64, shape (n,)
        Displacement [m, rad]; NaN from where on it is out of all proportion to the log.
    deviation : float
        Root mean square of log minus it from the command edge on [m, rad].
    """

    label: str
    source: str
    position: Floats
    deviation: float


@dataclass(frozen=True, eq=False)
class TrialCourse:
    """A log beside the loops that may explain it, and how far its command is from the wall law.

    Parameters
    ----------
    time : float64, shape (n,)
        Time after the command edge [s].
    position : float64, shape (n,)
        Displacement [m, rad].
    final : float
        Displacement at rest F_0/K [m, rad]; NaN without a wall.
    beside : tuple of Beside
    residual : float64, shape (n,)
        Logged command minus that of the wall law F_0 - K (x_k - x_0) - B (x_k - x_{k-1})/T [N, Nm].
    rounding : float
        What rounding of the printed numbers leaves of the residual at most [N, Nm].
    """

    time: Floats
    position: Floats
    final: float
    beside: tuple[Beside, ...]
    residual: Floats
    rounding: float


@dataclass(frozen=True, eq=False)
class ResidualMap:
    """Measured against theoretical cost over the plane of one experiment, in cells.

    Parameters
    ----------
    label : str
    stiffness, damping : float64, shape (n,)
        Centre of each cell [N/m, Nm/rad], [Ns/m, Nms/rad].
    residual : float64, shape (n,)
        Median over the trials of the cell: log2 of measured over theoretical cost, or measured minus theoretical
        overshoot [1].
    boundary : Curve
        Boundary of theory.
    trials : int
        Trials with both costs.
    median : float
        Median residual over these trials; NaN without any.
    """

    label: str
    stiffness: Floats
    damping: Floats
    residual: Floats
    boundary: Curve
    trials: int
    median: float


@dataclass(frozen=True, eq=False)
class RecordedColumn:
    """A column of a log as it was recorded, over time [s] or the number of the row.

    Parameters
    ----------
    name, unit : str
        ``unit`` is empty where it is not known.
    place, values : float64, shape (rows,)
    jumps : tuple of int
        Rows at which it jumps.
    rests : tuple of (int, int)
        First row of each rest, and the one behind its last.
    gaps : tuple of int
        Rows before which rows are missing.
    step_row : int or None
        Row of the step, where it is known.
    """

    name: str
    unit: str
    place: Floats
    values: Floats
    jumps: tuple[int, ...]
    rests: tuple[tuple[int, int], ...]
    gaps: tuple[int, ...]
    step_row: int | None = None

"""What figures are drawn from: finished curves, maps and responses, in SI."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.records.batch import Floats
from pipeline.records.models import Optimum


@dataclass(frozen=True, eq=False)
class Curve:
    """A line in the plane of stiffness (abscissa) and damping (ordinate), in physical units.

    ``kind`` is ``measured`` (solid), ``theory`` (dashed), ``linear`` and ``bound`` (dotted: condition (3.25), and the
    straight upper bound of a measurement), ``passive`` (thin, filled), ``band`` (thin dots) or ``envelope`` (filled
    between ``low`` and ``high``). A label that begins with an underscore is not shown. ``censored`` marks the points of
    a measured curve where the tested range ended before an unstable trial. ``low`` and ``high`` are stiffnesses at the
    dampings of the curve: an envelope, or what a measured limit leaves open (NaN where that is not known).
    """

    label: str
    kind: str
    stiffness: Floats
    damping: Floats
    censored: Floats | None = None
    low: Floats | None = None
    high: Floats | None = None


@dataclass(frozen=True)
class BoundaryFigure:
    """Stability boundaries of several experiments against theory (Figs. 6.3, 6.4, 6.9); panels share axes.

    In a ``normalised`` figure the curves hold alpha = K T^2/m and beta = B T/m in place of stiffness and damping.
    ``theory_label`` names the dashed curves in the legend where their own labels stand beside them or are not shown.
    """

    identifier: str
    title: str
    caption: str
    panels: tuple[tuple[str, tuple[Curve, ...]], ...]
    normalised: bool = False
    theory_label: str = ""


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


@dataclass(frozen=True, eq=False)
class ResponseFigure:
    """One step response with a close-up of its beginning (Fig. 6.2).

    Parameters
    ----------
    identifier, title, caption : str
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

    identifier: str
    title: str
    caption: str
    time: Floats
    position: Floats
    command: Floats
    sampling_period_s: float
    first_change: int
    final: float
    period: tuple[float, float] | None


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
    cell : tuple of float
        Size of a cell in stiffness and damping.
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
    cell: tuple[float, float]
    boundary: Curve
    trials: int
    median: float


@dataclass(frozen=True)
class ResidualFigure:
    """Residuals of one criterion, one map an experiment, on equal axes."""

    identifier: str
    title: str
    caption: str
    criterion: str
    maps: tuple[ResidualMap, ...]

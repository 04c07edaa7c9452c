"""Figure of the largest stable stiffness over two quantities of a rig, with marks for the rig and for its changes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.device.parameters import unit_of
from pipeline.records.trials import Floats
from pipeline.rig.design import DesignAnswer
from pipeline.rig.quantities import QUANTITIES, Quantity
from pipeline.rig.wish import stiffness_max
from pipeline.surface.physical_loop import Loop

_PLACES, _REACH = 15, np.log(4.0)
"""Number of points along each axis, and logarithm of the factor by which the axis extends to either side."""


def picture(loop: Loop, answer: DesignAnswer, over: Sequence[str], path: Path) -> None:
    """Draw the largest stable stiffness over two quantities. All other quantities are unchanged.

    Parameters
    ----------
    loop : Loop
        Unchanged rig.
    answer : DesignAnswer
        Design of the rig. Its changes of these two quantities are marked.
    over : sequence of str
        Names of the quantities on the horizontal and the vertical axis, from `quantities.QUANTITIES`.
    path : Path
        Output file with the suffix .svg, .pdf or .png.

    Raises
    ------
    ParameterError
        If the names are not two different quantities of the rig.
    """
    across, up = _two(loop, over)
    stiffest = _stiffest(loop, across, up)
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    with matplotlib.rc_context({"svg.hashsalt": "pipeline", "svg.fonttype": "none", "font.size": 10}):
        figure = Figure(figsize=(6.4, 4.8), layout="constrained")
        axes = figure.subplots()
        x, y = (np.array([_value(loop, q, part) for part in _parts()]) for q in (across, up))
        unit = unit_of("stiffness", loop.motion)
        wanted = answer.wish.stiffness
        levels = [level for level in _levels(stiffest) if wanted is None or not 0.8 < level / wanted < 1.25]
        drawn = axes.contour(x, y, stiffest, levels=levels, colors="0.55", linewidths=1)
        for label in axes.clabel(drawn, fmt=lambda level: f"{level:g}", fontsize=9, inline=False):
            label.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 1})
        if wanted is not None:
            wanted *= answer.wish.margin
            if np.nanmin(stiffest) < wanted < np.nanmax(stiffest):
                axes.contour(x, y, stiffest, levels=[wanted], colors="tab:red", linewidths=2.5)
            axes.plot([], [], color="tab:red", linewidth=2.5, label=f"limit of {wanted:g} {unit} (stability only)")
        # all rigs that meet the further requirements have nearly the same limit
        if (answer.changes or answer.reached) and wanted is not None:
            limits = [change.wall["stiffness_limit"] or np.nan for change in answer.changes]
            if answer.reached and answer.stiffness_reached:
                share = answer.stiffness_reached * answer.wish.margin / stiffness_max(loop)
                limits = [wanted / share]
            beyond = float(np.median(limits))
            if np.nanmin(stiffest) < beyond < np.nanmax(stiffest) and beyond > 1.02 * wanted:
                axes.contour(x, y, stiffest, levels=[beyond], colors="tab:red", linewidths=1.5, linestyles="dashed")
                axes.plot(
                    [], [], color="tab:red", linewidth=1.5, linestyle="dashed", label="all requirements (approximately)"
                )
        axes.plot(_value(loop, across, 0.0), _value(loop, up, 0.0), "o", color="black", label="unchanged rig")
        for i, change in enumerate(c for c in answer.changes if set(c.after) <= {across.name, up.name}):
            place = [change.after.get(q.name, _value(loop, q, 0.0)) for q in (across, up)]
            axes.plot(
                *place, "x", color="tab:red", markersize=9, label="" if i else "changes that meet the requirements"
            )
        axes.set(xscale="log", yscale="log", xlabel=_label(loop, across), ylabel=_label(loop, up))
        axes.set(xlim=(x.min(), x.max()), ylim=(y.min(), y.max()))
        axes.set_title(f"Largest stable stiffness [{unit}]", loc="left", fontsize=11)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_locator(NullLocator())
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def _two(loop: Loop, over: Sequence[str]) -> tuple[Quantity, Quantity]:
    names = [name for name, quantity in QUANTITIES.items() if quantity.read(loop)]
    if len(over) != 2 or over[0] == over[1] or not set(over) <= set(names):
        raise ParameterError(f"over = {', '.join(over)}: expected two of {', '.join(names)}.")
    return QUANTITIES[over[0]], QUANTITIES[over[1]]


def _parts() -> Floats:
    return np.linspace(-_REACH, _REACH, _PLACES)


def _value(loop: Loop, quantity: Quantity, part: float) -> float:
    return float((quantity.read(loop) or 0.0) * np.exp(part))


def _label(loop: Loop, quantity: Quantity) -> str:
    return f"{quantity.label} [{quantity.unit(loop)}]"


def _stiffest(loop: Loop, across: Quantity, up: Quantity) -> Floats:
    """Compute the largest stable stiffness at each point, shape (up, across), or nan for an invalid rig."""
    parts, result = _parts(), np.full((_PLACES, _PLACES), np.nan)
    for i, j in np.ndindex(*result.shape):
        try:
            rig = up.changed(across.changed(loop, float(parts[j])), float(parts[i]))
            result[i, j] = stiffness_max(rig)
        except ParameterError:  # invalid rig, or a rig without a stable wall
            continue
    return result


def _levels(values: Floats) -> list[float]:
    """Return contour levels of 1, 2 and 5 times powers of ten."""
    powers = 10.0 ** np.arange(-3, 10)
    every = np.sort(np.concatenate([powers, 2 * powers, 5 * powers]))
    return [float(level) for level in every if np.nanmin(values) < level < np.nanmax(values)]

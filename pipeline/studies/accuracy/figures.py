"""Figures of the accuracy page: error against run time, and error along the sweeps of numerical stability."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from pipeline.records.accuracy import OURS, SMALLEST, SUPERSCRIPTS, WRONG, Rung, Sweep
from pipeline.rendering import style

WIDTH, PLOT_HEIGHT, LEGEND_LINE = 470.0, 270.0, 15.0
"""Size of a panel and of a line of its legend [px]."""

LARGEST = 10.0
"""Error at the upper end of the axis of a sweep; what is beyond, or no number at all, is drawn there."""


@dataclass(frozen=True)
class Look:
    """What a ladder shows on its axes, and which methods stand out.

    Parameters
    ----------
    error, time : str
        Labels of abscissa and ordinate.
    seconds : callable
        Ordinate of a rung.
    leading : collection of str
        Methods that stand out; at most one in a panel.
    smallest : float
        Error at which smaller ones, and 0, are drawn.
    most_missing : float
        Share of trials without a value from which on a marker is hollow.
    wanted : float, optional
        Error that is marked by a line.
    """

    error: str = "largest error"
    time: str = "run time [s]"
    seconds: Callable[[Rung], float] = lambda rung: rung.seconds
    leading: Collection[str] = (OURS,)
    smallest: float = SMALLEST
    most_missing: float = 1.0
    wanted: float | None = None


def look_of(method: str, others: Sequence[str]) -> dict[str, Any]:
    """Return colour, marker and line of a method; one that is not among the others stands out."""
    if method not in others:
        return {"color": style.INK, "marker": "*", "markersize": 13, "linestyle": "-", "linewidth": 2.2, "zorder": 5}
    i = others.index(method)
    colours = [c for c in style.SERIES if c != style.INK]
    lines = ("-", (0, (5, 2)), (0, (1, 1.5)))
    return {
        "color": colours[i % len(colours)],
        "marker": style.MARKERS[i % len(style.MARKERS)],
        "markersize": 5,
        "linestyle": lines[i // len(colours) % len(lines)],
        "linewidth": 1.4,
        "zorder": 3,
    }


def ladder(quantity: str, rungs: Sequence[Rung], identifier: str, look: Look | None = None) -> str:
    """Draw error (abscissa) against run time (ordinate) for one quantity, one line a method.

    A method without any number is left out; the table beside the figure says so.
    """
    look = look or Look()
    known = [r for r in rungs if r.error is not None]
    names = list(dict.fromkeys(r.method for r in known))
    others = [n for n in names if n not in look.leading]
    with matplotlib.rc_context(style.RC):
        figure, axes = _axes(len(names))
        for name in names:
            line = [r for r in known if r.method == name]
            error = np.maximum([r.error or 0.0 for r in line], look.smallest)
            drawn = look_of(name, others)
            axes.plot(error, [look.seconds(r) for r in line], label=name, **drawn)
            hollow = [i for i, r in enumerate(line) if (r.missing or 0.0) > look.most_missing]
            empty = drawn | {"linestyle": "none", "markerfacecolor": style.PAPER}
            axes.plot(error[hollow], [look.seconds(line[i]) for i in hollow], **empty)
        axes.set_xscale("log")
        axes.set_yscale("log")
        _decades(axes)
        axes.set_xlabel(look.error)
        axes.set_ylabel(look.time)
        axes.annotate("better", (0.02, 0.03), xycoords="axes fraction", fontsize=9.5, style="italic")
        times = np.log10([look.seconds(r) for r in known])
        axes.set_ylim(10 ** (np.floor(times.min()) - 0.1), 10 ** (np.ceil(times.max()) + 0.1))
        if look.smallest == SMALLEST:
            axes.set_xlim(right=max(axes.get_xlim()[1], 1e-15), left=min(axes.get_xlim()[0], SMALLEST))
        else:
            errors = np.log10([max(r.error or 0.0, look.smallest) for r in known])
            axes.set_xlim(10 ** (np.floor(errors.min()) - 0.1), 10 ** (np.ceil(errors.max()) + 0.1))
        if look.wanted is not None:
            axes.axvline(look.wanted, color=style.INK, linewidth=0.8, linestyle=(0, (2, 2)))
        title = f"{quantity}: error against {look.time.split(' [')[0]}"
        return _svg(figure, axes, identifier, title, [_words(r, look) for r in known])


def sweep(title: str, abscissa: str, sweeps: Sequence[Sweep], identifier: str, *, rising: bool) -> str:
    """Draw the error of each method along a sweep; a cross on the upper edge stands for no number at all.

    Parameters
    ----------
    rising : bool
        Whether it gets harder to the right with growing x; else the abscissa is turned round.
    """
    names = [s.method for s in sweeps]
    others = [n for n in names if n != OURS]
    with matplotlib.rc_context(style.RC):
        figure, axes = _axes(len(names))
        for s in sweeps:
            look = look_of(s.method, others)
            error = [np.nan if e is None else min(max(e, SMALLEST), LARGEST) for e in s.error]
            axes.plot(s.x, error, label=s.method, **look)
            nothing = [x for x, e in zip(s.x, s.error, strict=True) if e is None]
            axes.plot(nothing, [LARGEST] * len(nothing), "x", color=look["color"], markersize=7, clip_on=False)
        axes.axhline(WRONG, color=style.INK, linewidth=0.8, linestyle=(0, (2, 2)))
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(SMALLEST / 2, LARGEST)
        _decades(axes)
        if not rising:
            axes.invert_xaxis()
        axes.set_xlabel(abscissa)
        axes.set_ylabel("error")
        axes.annotate("wrong above", (0.01, WRONG * 1.5), xycoords=("axes fraction", "data"), fontsize=9)
        return _svg(figure, axes, identifier, title, [_course(s) for s in sweeps])


def _axes(entries: int) -> tuple[Figure, Axes]:
    legend = LEGEND_LINE * -(-entries // 2) + 6
    height = PLOT_HEIGHT + legend
    figure = Figure(figsize=(WIDTH / 72, height / 72))
    left, bottom, right, top = 58, 44 + legend, 12, 8
    axes = figure.add_axes(
        (left / WIDTH, bottom / height, (WIDTH - left - right) / WIDTH, (height - bottom - top) / height)
    )
    axes.tick_params(length=3)
    return figure, axes


def _decades(axes: Axes) -> None:
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(base=10, numticks=8))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: power(value)))


def power(value: float) -> str:
    """Return a power of ten as people write it."""
    exponent = round(np.log10(value)) if value > 0 else 0
    return {0: "1", 1: "10", 2: "100", 3: "1000"}.get(exponent, "10" + str(exponent).translate(SUPERSCRIPTS))


def _svg(figure: Figure, axes: Axes, identifier: str, title: str, words: Sequence[str]) -> str:
    height = figure.get_figheight() * 72
    entries = len(axes.get_legend_handles_labels()[0])
    legend = LEGEND_LINE * -(-entries // 2) + 6
    figure.legend(
        *axes.get_legend_handles_labels(),
        ncols=2,
        loc="upper left",
        bbox_to_anchor=(10 / WIDTH, legend / height),
        handlelength=2.4,
        columnspacing=1.2,
        labelspacing=0.2,
        borderpad=0.1,
        fontsize=9.5,
    )
    return style.svg(figure, identifier, title, "; ".join(words))


def _words(rung: Rung, look: Look) -> str:
    unit = look.time.rpartition("[")[2].removesuffix("]")
    return f"{rung.method}, {rung.setting}: error {rung.error:.1e} in {look.seconds(rung):.1e} {unit}"


def _course(s: Sweep) -> str:
    if s.starts is None:
        return f"{s.method}: never above {WRONG:.0e}"
    return f"{s.method}: wrong from {s.starts:.1e} on"

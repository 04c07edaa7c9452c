"""Figures of the accuracy page: error against run time, and error along the sweeps of numerical stability."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.records.accuracy import OURS, WRONG, Rung, Sweep
from pipeline.studies.figure import Note, Panel, Trace

SIZE = (470.0, 300.0)
"""Width and height of a panel without its legend [px]."""

SMALLEST = 1e-17
"""Error that stands for 0 on a logarithmic axis: below the rounding of a double near 1."""

LARGEST = 10.0
"""Error at the upper end of the axis of a sweep; what is beyond, or no number at all, is drawn there."""

COLOURS = ("blue", "vermillion", "green", "purple", "orange", "sky")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
DASHES = ("solid", "dashed", "dotted")
"""Looks of the methods that do not stand out, in turn."""


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


def ladder(quantity: str, rungs: Sequence[Rung], look: Look) -> Panel:
    """Return error (abscissa) against run time (ordinate) for one quantity, one line a method.

    A method without any number is left out; the table beside the figure says so.
    """
    known = [r for r in rungs if r.error is not None]
    x_range = _decades([max(r.error or 0.0, look.smallest) for r in known])
    y_range = _decades([look.seconds(r) for r in known])
    traces = []
    for name, line in _lines([r.method for r in known], look.leading).items():
        of = [r for r in known if r.method == name]
        error = np.maximum([r.error or 0.0 for r in of], look.smallest)
        time = np.array([look.seconds(r) for r in of])
        traces.append(line.moved(error, time))
        hollow = np.array([(r.missing or 0.0) > look.most_missing for r in of])
        if hollow.any():
            traces.append(line.moved(error[hollow], time[hollow], label="", dash="none", filled=False))
    if look.wanted is not None:
        traces.append(Trace(np.full(2, look.wanted), np.array(y_range), "ink", "dotted", width=0.8))
    corner = (_between(x_range, 0.02), _between(y_range, 0.05))
    unit = look.time.rpartition("[")[2].removesuffix("]")
    return Panel(
        "",
        look.error,
        look.time,
        x_range,
        y_range,
        tuple(traces),
        notes=(Note(*corner, "better", right=0.0),),
        logarithmic=True,
        name=f"{quantity}: error against {look.time.split(' [')[0]}",
        description="; ".join(
            f"{r.method}, {r.setting}: error {r.error:.1e} in {look.seconds(r):.1e} {unit}" for r in known
        ),
    )


def sweep(title: str, abscissa: str, sweeps: Sequence[Sweep], *, rising: bool) -> Panel:
    """Return the error of each method along a sweep; a cross on the upper edge stands for no number at all.

    Parameters
    ----------
    rising : bool
        Whether it gets harder to the right with growing x; else the abscissa is turned round.
    """
    places = [x for s in sweeps for x in s.x]
    x_range = _decades(places) if rising else _decades(places)[::-1]
    lines = _lines([s.method for s in sweeps], (OURS,))
    traces = [Trace(np.array(x_range), np.full(2, WRONG), "ink", "dotted", width=0.8)]
    for s in sweeps:
        error = np.array([np.nan if e is None else min(max(e, SMALLEST), LARGEST) for e in s.error])
        nothing = np.array(s.x)[np.isnan(error)]
        traces.append(lines[s.method].moved(np.array(s.x), error))
        edge = np.full(len(nothing), LARGEST)
        traces.append(lines[s.method].moved(nothing, edge, label="", dash="none", marker="x"))
    return Panel(
        "",
        abscissa,
        "error",
        x_range,
        (SMALLEST / 2, LARGEST),
        tuple(traces),
        notes=(Note(_between(x_range, 0.01), WRONG, "wrong above", right=0.0, up=7.0),),
        logarithmic=True,
        name=title,
        description="; ".join(
            f"{s.method}: never above {WRONG:.0e}" if s.starts is None else f"{s.method}: wrong from {s.starts:.1e} on"
            for s in sweeps
        ),
    )


def _lines(methods: Sequence[str], leading: Collection[str]) -> dict[str, Trace]:
    """Line of each method without its points; a leading one stands out."""
    nothing = np.zeros(0)
    result = {}
    others = 0
    for name in dict.fromkeys(methods):
        if name in leading:
            result[name] = Trace(nothing, nothing, "ink", "solid", name, "*", 2.2, filled=True)
            continue
        dash = DASHES[others // len(COLOURS) % len(DASHES)]
        colour, marker = COLOURS[others % len(COLOURS)], MARKERS[others % len(MARKERS)]
        result[name] = Trace(nothing, nothing, colour, dash, name, marker, filled=True)
        others += 1
    return result


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Whole decades around values, with room for their signs."""
    logs = np.log10(values)
    low, high = float(np.floor(logs.min())), float(np.ceil(logs.max()))
    room = 0.1 + 0.03 * (high - low)
    return 10 ** (low - room), 10 ** (high + room)


def _between(ends: tuple[float, float], share: float) -> float:
    """Place between the ends of a logarithmic axis."""
    return float(ends[0] * (ends[1] / ends[0]) ** share)

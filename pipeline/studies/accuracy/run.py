"""Measure error and run time of all methods, also in extreme cases, and make the page with the results."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from pipeline.base.json_object import JsonObject
from pipeline.base.wording import duration, error_text, power_of_ten
from pipeline.records import accuracy
from pipeline.records.accuracy import OURS, WRONG, AccuracyReport, LeftOut, MeasuredAccuracy, Rung, Sweep
from pipeline.rendering.report.page_template import fill_template
from pipeline.studies.accuracy.extremes import sweeps
from pipeline.studies.accuracy.measure import Table, grouped
from pipeline.studies.accuracy.measured import RECOMMENDED, measured_tables
from pipeline.studies.accuracy.theory import theory_tables

BUDGETS = {"theory": (0.12, 0.03), "measured": (0.02, 0.02)}
"""Time [s] for which each method is repeated, in a full and in a quick study.

Measurement methods have less time, because calls with thousands of trials need no warm-up.
"""

Say = Callable[[str], None]


@cache
def words() -> JsonObject:
    """Return the texts of quantities, paths of extreme cases, and omissions, from ``words.toml`` in this folder."""
    return tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))


def measure(
    quick: bool = False, say: Say = lambda _: None, *, theory: bool = True, measured: bool = True
) -> AccuracyReport:
    """Run every method on every quantity, and return errors and times.

    Parameters
    ----------
    quick : bool
        Whether to use fewer settings, trials and repetitions.
    say : callable
        Function that is called with the name of each part when it starts.
    theory, measured : bool
        Whether to measure the methods of theory, and the methods for logs. A part that is not measured stays empty in
        the report.
    """
    key, machine = accuracy.key(), accuracy.machine()
    begun, begin = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"), time.perf_counter()
    rungs, found, omitted, seconds, branch = tuple[Rung, ...](), tuple[Sweep, ...](), tuple[LeftOut, ...](), 0.0, None
    if theory:
        rungs = _rungs(theory_tables(), quick, say, BUDGETS["theory"])
        say("extreme cases")
        found, omitted, seconds = tuple(sweeps(quick)), left_out(), time.perf_counter() - begin
    if measured:
        begin = time.perf_counter()
        of_logs = _rungs(measured_tables(quick), quick, say, BUDGETS["measured"])
        branch = MeasuredAccuracy(rungs=of_logs, seconds=time.perf_counter() - begin)
    return AccuracyReport(
        key=key,
        quick=quick,
        measured=begun,
        machine=machine,
        rungs=rungs,
        sweeps=found,
        left_out=omitted,
        seconds=seconds,
        measured_branch=branch,
    )


def _rungs(tables: Iterable[Table], quick: bool, say: Say, budgets: tuple[float, float]) -> tuple[Rung, ...]:
    """Return the rungs of all tables, quantity by quantity."""
    rungs: list[Rung] = []
    for table in tables:
        say(next(iter(table.exact)))
        rungs += table.rungs(quick, budgets[quick])
    return tuple(rung for group in grouped(rungs, "quantity").values() for rung in group)


def left_out() -> tuple[LeftOut, ...]:
    """Return the methods of theory that are not measured in this run, with the reasons.

    Methods that are not installed come first.
    """
    entries = [entry for entry in words()["left_out"] if "library" not in entry or find_spec(entry["library"]) is None]
    return tuple(LeftOut(**{name: entry[name] for name in LeftOut.model_fields}) for entry in entries)


COLUMNS = 3
"""Number of panels in a row of the figure."""

WIDTH, HEIGHT = 4.0, 3.0
"""Size of a panel [in]."""

SMALLEST = 1e-17
"""Value that replaces a zero error on a logarithmic axis. It is below the rounding error of a double near 1."""


def render(report: AccuracyReport) -> str:
    """Return the page as an HTML document."""
    measured = report.measured_branch.rungs if report.measured_branch else ()
    return fill_template(
        "accuracy.html.j2",
        report=report,
        summary=summary_rows(report),
        paths=list(_paths(report.sweeps)),
        parts=[
            {"name": name, "title": title, "svg": picture(rungs, f"picture-{name}"), "rows": list(map(_row, rungs))}
            for name, title, rungs in (("theory", "Theory", report.rungs), ("measured", "Measured branch", measured))
            if rungs
        ],
        wrong=error_text(WRONG),
        meaning=words()["meaning"],
    )


def summary_rows(report: AccuracyReport) -> tuple[dict[str, str], ...]:
    """Return a row for each quantity, with the error and the time of this package, and of the fastest other method
    whose error is at most `WRONG`."""
    rows = []
    for quantity, rungs in grouped(report.rungs, "quantity").items():
        ours = next((r for r in rungs if r.method == OURS), None)
        good = [r for r in rungs if r.method != OURS and r.error is not None and r.error <= WRONG]
        other = min(good, key=lambda r: r.seconds, default=None)
        rows.append(
            {
                "quantity": quantity,
                "error": error_text(ours.error) if ours else "–",
                "time": duration(ours.seconds) if ours else "–",
                "other": f"{other.method}, {other.setting}".removesuffix(", one setting") if other else "none measured",
                "other time": duration(other.seconds) if other else "–",
            }
        )
    return tuple(rows)


def picture(rungs: Sequence[Rung], identifier: str) -> str:
    """Return a plot of error (abscissa) and run time as ``<svg>``. Each quantity has a panel, and each method a
    line."""
    import matplotlib  # this import takes half a second, and other commands do not need it
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    from pipeline.rendering.figures import drawing as style

    quantities = {q: of for q, of in grouped(rungs, "quantity").items() if len(grouped(of, "method")) > 1}
    lines = -(-max(len(quantities), 1) // COLUMNS)
    with matplotlib.rc_context(style.RC | {"font.size": 8.0, "axes.titlesize": 9.0, "legend.fontsize": 6.5}):
        drawing = Figure(figsize=(COLUMNS * WIDTH, lines * HEIGHT), dpi=72, layout="constrained")
        panels = drawing.subplots(lines, COLUMNS, squeeze=False).ravel()
        for axes in panels[len(quantities) :]:
            axes.set_visible(False)
        for axes, (quantity, of) in zip(panels, quantities.items(), strict=False):
            axes.set(xscale="log", yscale="log", title=quantity, xlabel="error", ylabel="run time [s]")
            for number, (method, known) in enumerate(grouped((r for r in of if r.error is not None), "method").items()):
                leading = method == OURS or method in RECOMMENDED
                error = np.maximum([r.error or 0.0 for r in known], SMALLEST)
                look = {"color": style.INK, "marker": "*", "ms": 9} if leading else {"marker": "o", "ms": 3}
                look.setdefault("color", style.SERIES[number % (len(style.SERIES) - 1)])
                axes.plot(error, [r.seconds for r in known], label=method, **look)
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(LogLocator(numticks=5))
                axis.set_major_formatter(lambda value, _: power_of_ten(round(np.log10(value))))
            axes.minorticks_off()
            axes.legend(markerscale=0.6)
        text = "; ".join(f"{r.quantity} by {r.method}, {r.setting}: {r.error} in {r.seconds:.1e} s" for r in rungs)
        return style.svg_of(drawing, identifier, "Error against run time of every method", text)


def _paths(sweeps: Sequence[Sweep]) -> Iterator[dict[str, object]]:
    """Yield the extreme cases with the outcome of each method."""
    for name, path in words()["sweeps"].items():
        rows = [
            {
                "method": s.method,
                "starts": "correct on the whole path" if s.starts is None else f"wrong from {s.starts:.3g} on",
                "fine": s.starts is None,
                "worst": error_text(s.worst),
                "verdicts": "" if s.wrong_verdicts is None else f"{s.wrong_verdicts} of {len(s.x)}",
            }
            for s in sweeps
            if s.sweep == name
        ]
        if rows:
            yield {"path": path, "rows": rows}


def _row(rung: Rung) -> tuple[str, ...]:
    missing = "" if rung.missing is None else f"{rung.missing:.0%}"
    return rung.quantity, rung.method, rung.setting, error_text(rung.error), duration(rung.seconds), missing

"""The accuracy page: tables and one picture, error against run time, from a finished measurement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pipeline.base.wording import duration, error_text, power_of_ten
from pipeline.records.accuracy import OURS, WRONG, AccuracyReport, Rung, Sweep
from pipeline.rendering.report.page_template import fill_template
from pipeline.studies.accuracy.measure import grouped
from pipeline.studies.accuracy.measured import RECOMMENDED
from pipeline.studies.accuracy.run import words

COLUMNS = 3
"""Panels of the picture side by side."""

WIDTH, HEIGHT = 4.0, 3.0
"""Size of a panel [in]."""

SMALLEST = 1e-17
"""Error that stands for 0 on a logarithmic axis: below the rounding of a double near 1."""


def render(report: AccuracyReport) -> str:
    """Return the page as one HTML document."""
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
    """Return one row a quantity: error and time of this package, and the quickest other method within `WRONG`."""
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
    """Return error (abscissa) against run time, a panel a quantity with several methods, a line each, as ``<svg>``."""
    import matplotlib  # takes half a second that other commands do without
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
    """Extreme cases with what happened to each method."""
    for name, path in words()["sweeps"].items():
        rows = [
            {
                "method": s.method,
                "starts": "right to the end" if s.starts is None else f"wrong from {s.starts:.3g} on",
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

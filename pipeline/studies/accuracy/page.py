"""The accuracy page: one self-contained HTML file from a finished measurement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.base.disk import write_text
from pipeline.base.wording import duration, error_text
from pipeline.records.accuracy import OURS, WRONG, AccuracyReport, Advice, MeasuredAccuracy, Rung, Sweep
from pipeline.rendering.report.page_template import fill_template
from pipeline.studies.accuracy.figures import SIZE, Look, ladder, sweep
from pipeline.studies.accuracy.measured_advice import MOST_MISSING, WANTED, error_of, minutes, percent
from pipeline.studies.accuracy.names import AREA, RECOMMENDED, words
from pipeline.studies.accuracy.rungs import grouped, sorted_by
from pipeline.studies.accuracy.theory_advice import compared, fails, longest, name_of, place_of
from pipeline.studies.figure import Panel

MEASURED = Look("error", leading=RECOMMENDED, smallest=1e-6, most_missing=MOST_MISSING)
"""Look of the measured branch: no experiment tells anything to a millionth."""


def render(report: AccuracyReport) -> str:
    """Return the page as one HTML document."""
    return fill_template(
        "accuracy.html.j2",
        report=report,
        ladders=list(_ladders(report)),
        paths=list(_paths(report.sweeps)),
        wrong=error_text(WRONG),
        summary=summary_rows(report),
        measured_groups=_groups(report.measured_branch) if report.measured_branch else [],
    )


def write(report: AccuracyReport, path: Path) -> None:
    """Render the page and write it so that a reader sees all of it or nothing."""
    write_text(path, render(report))


def summary_rows(report: AccuracyReport) -> tuple[dict[str, str], ...]:
    """Return one row a quantity: error and time of this package, and the quickest other within `WRONG`."""
    return tuple(_summary_row(name, here, report.sweeps) for name, here in grouped(report.rungs, "quantity").items())


def _summary_row(quantity: str, rungs: Sequence[Rung], sweeps: Sequence[Sweep]) -> dict[str, str]:
    row = {"quantity": quantity, "error": "–", "time": "–", "other": "none measured", "compared": "–"}
    ours = next((r for r in rungs if r.method == OURS), None)
    good = [r for r in rungs if r.method != OURS and r.error is not None and r.error <= WRONG]
    other = min(good, key=lambda r: r.seconds, default=None)
    if ours:
        row |= {"error": error_text(ours.error), "time": duration(ours.seconds)}
    if other:
        row["other"] = name_of(other)
    if ours and other:
        warning = ", but fails in hard cases" if fails(other.method, sweeps) else ""
        row["compared"] = compared(other.seconds, ours.seconds) + warning
    return row


def _drawn(panel: Panel, identifier: str) -> str:
    from pipeline.studies.drawing import draw_panel  # with its library, half a second that other commands do without

    return draw_panel(panel, identifier, SIZE)


def _text(quantity: str, advice: Sequence[Advice]) -> str:
    return next((a.text for a in advice if a.quantity == quantity), "")


def _ladders(report: AccuracyReport) -> Iterator[dict[str, Any]]:
    """Cards of the theory."""
    for i, (name, rungs) in enumerate(grouped(report.rungs, "quantity").items()):
        yield {
            "name": name,
            "meaning": words()["meaning"].get(name, ""),
            "svg": _drawn(ladder(name, rungs, Look()), f"ladder-{i}"),
            "advice": _text(name, report.advice),
            "columns": ("error", "time"),
            "rows": [(r.method, r.setting, (error_text(r.error), duration(r.seconds))) for r in rungs],
        }


def _paths(sweeps: Sequence[Sweep]) -> Iterator[dict[str, Any]]:
    """Cards of numerical stability."""
    for i, (name, path) in enumerate(words()["sweeps"].items()):
        found = [s for s in sweeps if s.sweep == name]
        if not found:
            continue
        panel = sweep(path["title"], path["abscissa"], found, rising=path.get("rising", False))
        rows = [_sweep_row(s) for s in found]
        yield {"path": path, "svg": _drawn(panel, f"sweep-{i}"), "rows": rows, "longest": longest(found)}


def _sweep_row(s: Sweep) -> dict[str, str | bool]:
    return {
        "method": s.method,
        "starts": place_of(s) or "nowhere",
        "fine": s.starts is None,
        "worst": error_text(s.worst),
        "verdicts": "" if s.wrong_verdicts is None else f"{s.wrong_verdicts} of {len(s.x)}",
    }


def _groups(measured: MeasuredAccuracy) -> list[dict[str, Any]]:
    """Headings of the measured branch with their cards, in the order of what a reader asks first."""
    rungs = {name: sorted_by(of, "method") for name, of in grouped(measured.rungs, "quantity").items()}
    found = []
    for group in words()["groups"]:
        names = [name for begin in group["begins"] for name in rungs if name.startswith(begin)]
        cards = [card for name in names for card in _cards(name, list(rungs).index(name), rungs[name], measured)]
        if cards:
            found.append({"group": group, "cards": cards})
    return found


def _cards(name: str, index: int, rungs: list[Rung], measured: MeasuredAccuracy) -> Iterator[dict[str, Any]]:
    """Cards of a quantity of the measured branch: one a figure, of which the first bears words and table."""
    text = next(text for begin, text in words()["measured_meaning"].items() if name.startswith(begin))
    advice, rows = _text(name, measured.advice), [_row(r) for r in rungs]
    device = rungs[0].device_seconds is not None
    columns = ("trials", "on the device", "error", "run time") if device else ("without value", "error", "time")
    known = any(r.error is not None for r in rungs)
    for title, look in _looks(name, device and known).items():
        end = "" if title == name else "-run"
        svg = _drawn(ladder(title, rungs, look), f"measured-{index}{end}") if known else ""
        yield {"name": title, "meaning": text, "svg": svg, "advice": advice, "columns": columns, "rows": rows}
        advice, rows = "", []


def _looks(name: str, device: bool) -> dict[str, Look]:
    """Figures of a quantity by title: over the time on the device where there is one, that of the area over both."""
    run = replace(MEASURED, error="error [samples]" if name.startswith("delay") else "error")
    if not device:
        return {name: run}
    if name.startswith(AREA):
        run = replace(run, wanted=WANTED)
    over_device = replace(run, time="time on the device [min]", seconds=minutes)
    return {name: over_device} | ({f"{name}: run time": run} if name.startswith(AREA) else {})


def _row(rung: Rung) -> tuple[str, str, tuple[str, ...]]:
    device = rung.device_seconds is not None
    effort = (str(rung.trials), f"{minutes(rung):.2g} min") if device else (percent(rung.missing or 0.0),)
    return rung.method, rung.setting, (*effort, error_of(rung), duration(rung.seconds))

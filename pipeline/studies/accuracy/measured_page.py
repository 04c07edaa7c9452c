"""The part of the accuracy page on the measured branch: its cards, in the order of what a reader asks first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from pipeline.records.accuracy import MeasuredAccuracy, Rung, duration
from pipeline.records.accuracy_measured_advice import AREA, LIMITS, MOST_MISSING, RECOMMENDED, WANTED, error_of, percent
from pipeline.rendering import accuracy_figures
from pipeline.rendering.accuracy_figures import Look

SMALLEST = 1e-6
"""Error at which smaller ones, and 0, are drawn: no experiment tells anything to a millionth."""


@dataclass(frozen=True)
class _Group:
    """Cards under one heading: identifier, heading, introduction, and how the names of its quantities begin."""

    identifier: str
    title: str
    text: str
    begins: tuple[str, ...]


_HOLLOW = "A hollow marker: more than a tenth of the trials have no value at that setting."

GROUPS = (
    _Group(
        "courses",
        "How long a course must be",
        "Courses from full to coarse: every n-th damping with n times the step of stiffness. The fine steps behind the "
        "last stable trial are the second pass; with one pass they are left out. Time is measuring time on the device, "
        "for the area also the run time of the evaluation. Verdicts lie above the truth, because growth that the "
        "sensor hides is called stable. With jitter a trial may grow by chance; the course stops there, and the finer "
        "its steps, the sooner.",
        (AREA, LIMITS, "optimum of energy", "optimum of settling"),
    ),
    _Group(
        "delay",
        "Delay",
        f"Every marker is a window, a length of the log, or a number of trials. {_HOLLOW}",
        ("delay",),
    ),
    _Group("mass", "Mass and damping", f"Relative errors. {_HOLLOW}", ("mass", "damping")),
    _Group(
        "costs",
        "Costs",
        "Mean error of the trials against the exact cost of the noise-free response, over the length of the log and "
        f"over the sensor's quantum. {_HOLLOW}",
        ("settling", "overshoot", "energy"),
    ),
)
"""Headings of the part, in order."""


def groups_of(measured: MeasuredAccuracy) -> list[dict[str, Any]]:
    """Return what the page shows of the measured branch: headings with their cards, figures drawn."""
    names = list(dict.fromkeys(r.quantity for r in measured.rungs))
    advice = {a.quantity: a.text for a in measured.advice}
    found = []
    for group in GROUPS:
        cards = []
        for name in (n for begin in group.begins for n in names if n.startswith(begin)):
            rungs = [r for r in measured.rungs if r.quantity == name]
            methods = list(dict.fromkeys(r.method for r in rungs))
            rungs.sort(key=lambda r: methods.index(r.method))
            for i, (title, svg) in enumerate(_figures(name, rungs, f"measured-{names.index(name)}")):
                first = i == 0
                cards.append(
                    {
                        "name": title,
                        "meaning": meaning(name),
                        "svg": svg,
                        "advice": advice.get(name, "") if first else "",
                        "columns": _columns(rungs),
                        "rows": [_row(r) for r in rungs] if first else [],
                    }
                )
        if cards:
            found.append({"group": group, "cards": cards})
    return found


def meaning(quantity: str) -> str:
    """Return what the error of a quantity is."""
    for begin, text in (
        (AREA, "relative error of the area, the largest of the courses; dotted line: 1 %"),
        (LIMITS, "median over the dampings, relative to the largest limit; the largest of the courses"),
        (
            "optimum of settling time: cost",
            "exact cost at the chosen trial over that of the exact optimum, less 1; ±2 %",
        ),
        ("optimum of energy: cost", "exact cost at the chosen trial over that of the exact optimum, less 1; w = 0"),
        ("optimum", "distance of the chosen trial from the exact optimum (its region), relative"),
        ("delay of a trial, coarse", "median error of single trials; quantum 60 µm, noise 1 µm; time a trial"),
        ("delay of a trial", "median error of single trials; time a trial"),
        ("delay", "median error of experiments of 10 to 300 trials; time for all of them"),
        ("mass of a trial", "median relative error of single trials; time a trial"),
        ("damping of a trial", "median relative error of single trials; time a trial"),
        ("damping of an", "median relative error of experiments; K = 0: 3 to 100 trials there, time for all"),
        ("mass", "median relative error of experiments of 10 to 300 trials; time for all of them"),
        ("overshoot", "mean error in parts of the final displacement; time a trial"),
        ("settling", "mean relative error, ±2 %; time a trial"),
    ):
        if quantity.startswith(begin):
            return text
    return "mean relative error of the step response's energy cost; time a trial for all three weights"


def _figures(name: str, rungs: list[Rung], identifier: str) -> list[tuple[str, str]]:
    """Titles and figures of a quantity; without any number one that is empty."""
    if not any(r.error is not None for r in rungs):
        return [(name, "")]
    error = "error [samples]" if name.startswith("delay") else "error"
    run = Look(error=error, leading=RECOMMENDED, smallest=SMALLEST, most_missing=MOST_MISSING)
    if rungs[0].device_seconds is None:
        return [(name, accuracy_figures.ladder(name, rungs, identifier, run))]
    wanted = WANTED if name.startswith(AREA) else None
    device = replace(run, time="time on the device [min]", seconds=_device_minutes, wanted=wanted)
    found = [(name, accuracy_figures.ladder(name, rungs, identifier, device))]
    if name.startswith(AREA):
        title = f"{name}: run time"
        found.append((title, accuracy_figures.ladder(title, rungs, f"{identifier}-run", replace(run, wanted=wanted))))
    return found


def _device_minutes(rung: Rung) -> float:
    return (rung.device_seconds or 0.0) / 60


def _columns(rungs: list[Rung]) -> tuple[str, ...]:
    if rungs[0].device_seconds is not None:
        return ("trials", "on the device", "error", "run time")
    return ("without value", "error", "time")


def _row(rung: Rung) -> tuple[str, str, tuple[str, ...]]:
    if rung.device_seconds is not None:
        minutes = f"{rung.device_seconds / 60:.2g} min"
        return rung.method, rung.setting, (str(rung.trials), minutes, error_of(rung), duration(rung.seconds))
    missing = percent(rung.missing or 0.0)
    return rung.method, rung.setting, (missing, error_of(rung), duration(rung.seconds))

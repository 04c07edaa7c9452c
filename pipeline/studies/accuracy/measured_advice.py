"""What the accuracy of the measured branch comes to, in sentences: how long a course, which estimator, which window."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.base.wording import duration, error_text
from pipeline.records.accuracy import Rung
from pipeline.studies.accuracy.names import AREA, BALANCE, CORRECTED, MODEL_THIN, OPTIMUM_TWO, RATES_TWO
from pipeline.studies.accuracy.rungs import grouped
from pipeline.studies.accuracy.theory_advice import name_of

WANTED = 0.01
"""Error of the boundary's area that the length of a course is asked for."""

USUAL_WINDOW = "15 ms"
"""Window of the momentum balance in the thesis, as a setting."""

MOST_MISSING = 0.1
"""Share of trials without a value up to which a setting is recommended: beyond, it is right where it is easy."""

CLOSE = 1.25
"""Factor between two errors up to which they count as equal: medians of some hundred trials scatter by a tenth."""


def course_length(label: str, rungs: Sequence[Rung], wanted: float = WANTED) -> str:
    """Return how long a course must be for an error of the boundary's area, in trials and minutes on the device.

    Parameters
    ----------
    label : str
        Of the simulated condition.
    rungs : sequence of Rung
        Of any quantities; those of the area under this condition's boundary are used.
    wanted : float
        Error.

    Notes
    -----
    A course is long enough when it and the next longer one of the same kind are within the error: a coarse grid that
    is right by chance does not count. Where still longer ones are not, that is said too.
    """
    here = [r for r in rungs if r.quantity == f"{AREA}, {label}" and r.device_seconds is not None]
    if not _of(f"{AREA}, {label}", RATES_TWO, here):
        return f"{label}: no course was simulated."
    enough = {method: _enough(group, wanted) for method, group in grouped(here, "method").items()}
    full, found = _fullest(here, RATES_TWO), enough.get(RATES_TWO)
    longest = f"the longest course, {_size(full)}, has {percent(full.error)}"
    if found is None:
        parts = [
            f"{label}: no course reaches {percent(wanted)} in the area under the boundary with {RATES_TWO}; {longest}."
        ]
    else:
        least = found[0]
        parts = [
            f"{label}: for {percent(wanted)} in the area under the boundary a course must take {least.trials} trials, "
            f"{minutes(least):.1f} minutes on the device: {least.setting}, {RATES_TWO}, "
            f"error {percent(least.error)}."
        ]
    others = [f"with {m} {_size(r[0])}" for m, r in enough.items() if r is not None and m != RATES_TWO]
    if others:
        parts.append(f"It takes {'; '.join(others)}.")
    missed = [(m, _fullest(here, m)) for m, r in enough.items() if r is None and m != RATES_TWO]
    if missed:
        names = ", ".join(f"{m} ({percent(r.error)} with the longest course)" for m, r in missed)
        parts.append(f"It is not reached with {names}.")
    if found is not None and found[1] is not full:
        parts.append(f"More than {_size(found[1])} is not better: {longest}.")
    elif found is not None:
        parts.append(f"{longest[:1].upper()}{longest[1:]}.")
    return " ".join(parts)


def advise(quantity: str, rungs: Sequence[Rung]) -> str:
    """Return which method and setting to trust for a quantity, from nothing but errors, times and missing values.

    Parameters
    ----------
    quantity : str
    rungs : sequence of Rung
        Of any quantities.
    """
    here = [r for r in rungs if r.quantity == quantity]
    close = trusted(quantity, here)
    if close is None:
        return "No method gives nine of ten trials a value."
    parts = [f"Trust {name_of(close)}: error {error_of(close)}{_effort_text(close)}."]
    others = [_at_best(method, of) for method, of in grouped(here, "method").items() if method != close.method]
    if others:
        parts.append(f"The others at their best: {'; '.join(others)}.")
    return " ".join(parts)


def _at_best(method: str, rungs: Sequence[Rung]) -> str:
    """Least error of a method, or why none counts."""
    least = min(_usable(rungs), key=lambda r: r.error or 0.0, default=None)
    if least is not None:
        return f"{name_of(least)} {error_of(least)}"
    known = [r.missing for r in rungs if r.missing is not None]
    share = f" ({percent(min(known))} of the trials have no value)" if known else ""
    return f"{method} cannot be recommended{share}"


def trusted(quantity: str, rungs: Sequence[Rung]) -> Rung | None:
    """Return the rung of least error, or the one of least effort among those that are hardly worse; None if none is.

    Rungs of which more than `MOST_MISSING` of the trials have no value are passed over.
    """
    usable = _usable([r for r in rungs if r.quantity == quantity])
    if not usable:
        return None
    level = min(r.error or 0.0 for r in usable) * CLOSE
    return min((r for r in usable if (r.error or 0.0) <= level), key=_effort)


def summarise(rungs: Sequence[Rung]) -> tuple[str, ...]:
    """Return what to use for delay, mass, damping and costs, one sentence each."""
    lines = []
    for title, quantities in (
        ("Delay", ("delay of a trial", "delay of a trial, coarse sensor", "delay of an experiment")),
        ("Mass", ("mass of a trial", "mass of an experiment")),
        ("Damping", ("damping of a trial", "damping of an experiment")),
        ("Costs", ("settling time", "overshoot", "energy, w = 0", "energy, w = 2")),
    ):
        best = [(name, trusted(name, rungs)) for name in quantities]
        found = [f"{name} by {name_of(rung)}, error {error_of(rung)}" for name, rung in best if rung is not None]
        if found:
            lines.append(f"{title}: {'; '.join(found)}.")
    lines += _optima(rungs)
    windows = _usable(_of("mass of a trial", BALANCE, rungs))
    usual, less = (
        next((r for r in _of("mass of a trial", method, rungs) if r.setting == USUAL_WINDOW), None)
        for method in (BALANCE, CORRECTED)
    )
    if windows and usual is not None and less is not None:
        window = min(windows, key=lambda r: r.error or 0.0)
        lines.append(
            f"Window of the momentum balance (6.4): {window.setting} has the least error, {percent(window.error)}; the "
            f"thesis's {USUAL_WINDOW} have {percent(usual.error)}, and {percent(less.error)} less the viscous damping."
        )
    thin = [r for r in rungs if r.method == MODEL_THIN and r.quantity == "damping of a trial" and r.error is not None]
    if thin:
        text = "; ".join(f"{r.setting}: {percent(r.error)}" for r in thin)
        lines.append(
            f"Record every sample: the model takes the command as held between rows, and is wrong on thinned logs "
            f"(error of the damping, {text})."
        )
    return tuple(lines)


def _optima(rungs: Sequence[Rung]) -> list[str]:
    """How near a course comes to each optimum: by the cost of the trial that it chooses."""
    lines = []
    chosen = [
        r for r in rungs if r.quantity.startswith("optimum") and ": cost" in r.quantity and r.method == OPTIMUM_TWO
    ]
    for name in dict.fromkeys(r.quantity for r in chosen):
        here = [r for r in chosen if r.quantity == name]
        full, enough = _fullest(here, OPTIMUM_TWO), _enough(here, WANTED)
        text = f"none reaches {percent(WANTED)}" if enough is None else f"{percent(WANTED)} takes {_size(enough[0])}"
        lines.append(
            f"{name[:1].upper()}{name[1:].replace(': cost', '')}: the trial with the least measured cost costs up to "
            f"{percent(full.error)} more than the optimum after the longest course, {_size(full)}; {text}."
        )
    return lines


def error_of(rung: Rung) -> str:
    """Return the error of a rung in its unit: samples for a delay, else percent."""
    if rung.error is not None and rung.quantity.startswith("delay"):
        return f"{rung.error:.2g} samples" if rung.error >= 1e-3 else f"{error_text(rung.error)} samples"
    return percent(rung.error)


def percent(error: float | None) -> str:
    """Return a relative error in percent with two digits at most; the space does not break."""
    if error is None:
        return "no number"
    value = 100 * error
    digits = f"{value:.0f}" if value >= 99.5 else f"{value:.2g}"
    text = "less than 0.001" if 0 < value < 1e-3 else digits
    return f"{text}\N{NO-BREAK SPACE}%"


def _enough(rungs: Sequence[Rung], wanted: float) -> tuple[Rung, Rung] | None:
    """Shortest and longest course of those next to each other that are all within the error.

    Of several such runs it is that of the longest courses. A single course counts where it is the longest of all.
    """
    runs: list[list[Rung]] = [[]]
    ordered = sorted(rungs, key=minutes)
    for rung in ordered:
        if rung.error is not None and rung.error <= wanted:
            runs[-1].append(rung)
        elif runs[-1]:
            runs.append([])
    good = [run for run in runs if len(run) > 1 or (run and run[0] is ordered[-1])]
    return (good[-1][0], good[-1][-1]) if good else None


def _fullest(rungs: Sequence[Rung], method: str) -> Rung:
    return max((r for r in rungs if r.method == method), key=minutes)


def _size(rung: Rung) -> str:
    return f"{rung.trials} trials ({minutes(rung):.1f} min)"


def minutes(rung: Rung) -> float:
    """Return the measuring time on the device [min], 0 where there is none."""
    return (rung.device_seconds or 0.0) / 60


def _effort(rung: Rung) -> float:
    return rung.seconds if rung.device_seconds is None else rung.device_seconds


def _effort_text(rung: Rung) -> str:
    if rung.device_seconds is not None:
        return f" after {_size(rung)}"
    return f" in {duration(rung.seconds)}" + ("" if rung.trials else " a trial")


def _of(quantity: str, method: str, rungs: Sequence[Rung]) -> list[Rung]:
    return [r for r in rungs if r.quantity == quantity and r.method == method]


def _usable(rungs: Sequence[Rung]) -> list[Rung]:
    return [r for r in rungs if r.error is not None and (r.missing or 0.0) <= MOST_MISSING]

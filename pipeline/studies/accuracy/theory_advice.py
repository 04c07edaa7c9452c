"""What a measurement of errors and times comes to, in sentences: which method to trust where."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from pipeline.base.wording import duration, error_text, listed
from pipeline.records.accuracy import OURS, WRONG, Rung, Sweep
from pipeline.studies.accuracy.names import words
from pipeline.studies.accuracy.rungs import grouped

USES = (1e-3, 1e-6, 1e-10)
"""Errors that stand for a plot, a table, and a reference value."""

EVEN = 1.5
"""Ratio of two run times up to which they count as equal: repeated measurements scatter by as much."""

EVEN_STEPS = 2
"""Steps of a sweep (decades, mostly) by which a method may fail earlier than this package without a warning."""


def advise(quantity: str, rungs: Sequence[Rung], sweeps: Sequence[Sweep] = ()) -> str:
    """Return in words which method to use for a quantity, from nothing but errors and times.

    Parameters
    ----------
    quantity : str
    rungs : sequence of Rung
        Of any quantities; those of others are passed over.
    sweeps : sequence of Sweep
        A method that fails well before this package on one of them is named with a warning.
    """
    ours, others = _split(quantity, rungs)
    if ours is None or ours.error is None:
        return "This package gave no result here; it cannot be recommended."
    parts = [f"This package: error {error_text(ours.error)} in {duration(ours.seconds)}."]
    found = [(level, _quickest(others, level)) for level in USES]
    for best, group in groupby(found, key=lambda pair: pair[1]):
        levels = listed([error_text(level) for level, _ in group])
        if best is None:
            nearest = min(others, key=lambda r: r.error or 0.0, default=None)
            tail = "" if nearest is None else f"; the nearest is {name_of(nearest)}, error {error_text(nearest.error)}"
            parts.append(f"No other method measured reaches {levels}{tail}.")
        else:
            warning = ", but it fails in hard cases (numerical stability, below)" if fails(best.method, sweeps) else ""
            parts.append(
                f"To {levels} the quickest other is {name_of(best)}, {compared(best.seconds, ours.seconds)}{warning}."
            )
    missed = [level for level in USES if ours.error > level]
    if missed:
        parts.append(f"This package itself does not reach {listed([error_text(level) for level in missed])}.")
    return " ".join(parts)


def summarise(rungs: Sequence[Rung], sweeps: Sequence[Sweep]) -> tuple[str, ...]:
    """Return what a newcomer should know, most important first."""
    quantities = grouped(rungs, "quantity")
    quickest, rough = [], []
    for name, here in quantities.items():
        ours, others = _split(name, here)
        if ours is None or ours.error is None:
            continue
        good, fast = (_quickest(others, level) for level in (WRONG, USES[0]))
        if ours.error <= WRONG and (good is None or good.seconds > ours.seconds / EVEN):
            quickest.append(name)
        if fast is not None and fast.seconds < ours.seconds / EVEN:
            warning = ", but fails in hard cases" if fails(fast.method, sweeps) else ""
            rough.append(f"{name}: {name_of(fast)}, {compared(fast.seconds, ours.seconds)}{warning}")
    lines = [
        f"For errors of at most {error_text(WRONG)}, this package is the quickest method measured, or as quick as it, "
        f"for {len(quickest)} of {len(quantities)} quantities: {'; '.join(quickest)}."
    ]
    if rough:
        lines.append(f"Where {error_text(USES[0])} is enough, others are quicker for: {'; '.join(rough)}.")
    own = _places([s for s in sweeps if s.method == OURS])
    limits = "; ".join(own) if own else "not reached on any path measured"
    lines.append(f"Limits of this package, where its own error exceeds {error_text(WRONG)}: {limits}.")
    return tuple(lines)


def longest(sweeps: Sequence[Sweep]) -> tuple[str, ...]:
    """Return the methods of one path that stay right longest, all of those that stay right to its end."""
    reach = {s.method: _reach(s) for s in sweeps}
    furthest = max(reach.values())
    return tuple(method for method, steps in reach.items() if steps == furthest)


def distrusted(sweeps: Sequence[Sweep]) -> tuple[str, ...]:
    """Return from where on each other method is wrong, one sentence a method."""
    lines = []
    for method in dict.fromkeys(s.method for s in sweeps if s.method != OURS):
        places = _places([s for s in sweeps if s.method == method])
        if places:
            lines.append(f"Do not trust {method} from here on: {'; '.join(places)}.")
    return tuple(lines)


def fails(method: str, sweeps: Sequence[Sweep]) -> bool:
    """Return whether a method, at any of its settings, is wrong well before this package on some path."""
    own = {s.sweep: _reach(s) for s in sweeps if s.method == OURS}
    early = [s.method for s in sweeps if _reach(s) < own.get(s.sweep, 0) - EVEN_STEPS]
    return any(name == method or name.startswith(f"{method},") for name in early)


def compared(seconds: float, ours: float) -> str:
    """Return how a time compares with that of this package."""
    ratio = seconds / ours
    if 1 / EVEN < ratio < EVEN:
        return "about as quick"
    return f"{_times(ratio)} slower" if ratio > 1 else f"{_times(1 / ratio)} quicker"


def name_of(rung: Rung) -> str:
    """Return a method with its setting."""
    return rung.method if rung.setting == "one setting" else f"{rung.method} ({rung.setting})"


def place_of(sweep: Sweep) -> str | None:
    """Return where a sweep's method starts to be wrong, as a value of its abscissa; None if nowhere."""
    if sweep.starts is None:
        return None
    rising = sweep.x[-1] > sweep.x[0]
    return f"{sweep.starts:.0f}" if rising else error_text(sweep.starts)


def _places(sweeps: Sequence[Sweep]) -> list[str]:
    return [words()["sweeps"][s.sweep]["place"].format(place) for s in sweeps if (place := place_of(s)) is not None]


def _reach(sweep: Sweep) -> int:
    """Steps of a path that a method gets right."""
    return len(sweep.x) if sweep.starts is None else sweep.x.index(sweep.starts)


def _split(quantity: str, rungs: Sequence[Rung]) -> tuple[Rung | None, list[Rung]]:
    """Our own rung of a quantity, and those of others that gave a number."""
    here = [r for r in rungs if r.quantity == quantity and r.error is not None]
    ours = next((r for r in here if r.method == OURS), None)
    return ours, [r for r in here if r.method != OURS]


def _quickest(rungs: Sequence[Rung], level: float) -> Rung | None:
    good = [r for r in rungs if r.error is not None and r.error <= level]
    return min(good, key=lambda r: r.seconds, default=None)


def _times(ratio: float) -> str:
    return f"{ratio:.1f} times" if ratio < 10 else f"{ratio:.0f} times"

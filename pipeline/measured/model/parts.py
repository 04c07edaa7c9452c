"""Which parts a device has: those without which held-out trials are less likely."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.model.estimation import Device, Fit, begun, moments_of, refined
from pipeline.measured.model.recordings import Recording, Scales, Stretches, stretches
from pipeline.measured.model.scatter import inverse, solve

BASE = ("gain", "delta", "delay", "force")
"""Numbers of every device."""

NUMBERS = {"friction": ("coulomb",), "stiffness": ("gamma",), "lag": ("lag",), "mode": ("turn", "ratio", "share")}
"""Numbers of each part."""

FOLDS = 5

WORTH = 3.0
"""Gain of held-out log-likelihood from which on a part is one: odds of 20 to 1."""

MOST_TRIALS = 100
"""Trials by which parts are chosen; all are fitted in the end."""

LONGEST_DELAY = 48
"""Longest delay [samples] that is looked for."""

TURNS = (0.06, 0.09, 0.13, 0.2, 0.3, 0.45, 0.7, 1.0)
"""Frequencies [rad a sample] from which a mode is looked for, a factor of 1.5 apart."""


@dataclass(frozen=True, eq=False)
class Choice:
    """A fit with the parts that it has, and by how much each made held-out trials likelier."""

    fit: Fit
    held: Stretches
    scales: Scales
    parts: dict[str, float]

    @property
    def moving(self) -> bool:
        """Whether rows at which the direction of motion is not seen are left out."""
        return "friction" in self.parts


def held_out(fit: Fit) -> float:
    """Return the log-likelihood of units by fits without their fold, each one Newton step from the whole fit."""
    solved = fit.solved
    total, units = solved.total, len(solved.score)
    lost = 0.0
    for fold in range(min(FOLDS, units)):
        inside = np.arange(units) * FOLDS // units == fold if units >= 8 else np.arange(units) == fold
        information, score = solved.information[inside].sum(axis=0), solved.score[inside].sum(axis=0)
        step = -inverse(total - information) @ score
        lost += float(score @ step - 0.5 * step @ information @ step)
    return fit.likelihood + lost


def chosen(recordings: list[Recording]) -> Choice:
    """Return the likeliest device of recordings with the parts that held-out ones ask for.

    Parameters
    ----------
    recordings : list of Recording
        At least one with `recordings.SHORTEST` rows.
    """
    scales = Scales.of(recordings)
    places = np.unique(np.linspace(0, len(recordings) - 1, min(MOST_TRIALS, len(recordings))).round().astype(int))
    some = [recordings[i] for i in places]
    rows = min(len(each.time) for each in some)
    start = _started(some, scales, int(np.clip(rows // 8, 2, LONGEST_DELAY)))
    lead = int(np.ceil(start.numbers["delay"])) + 3
    best: tuple[float, Fit, Stretches, dict[str, float]] | None = None
    for moving in (True, False):
        held = stretches(some, scales, lead, moving)
        if not len(held):
            continue
        found = _laddered(held, start, len(some), moving)
        if best is None or "friction" not in best[3]:
            best = (held_out(found[0]), found[0], held, found[1])
        if "friction" in best[3]:
            break
    assert best is not None
    fit, parts = best[1], best[3]
    held = stretches(recordings, scales, lead, "friction" in parts)
    if len(places) < len(recordings):
        fit = refined(held, replace(fit.device, effects=None), len(recordings), 4)
    return Choice(fit, held, scales, parts)


def _started(recordings: list[Recording], scales: Scales, lead: int) -> Device:
    """Return the best start with the numbers of an ideal device, a spring and friction."""
    names = (*BASE, "gamma", "coulomb")
    held = stretches(recordings, scales, lead, True)
    if not len(held):
        names, held = (*BASE, "gamma"), stretches(recordings, scales, lead, False)
    return begun(held, names, lead)


def _laddered(held: Stretches, start: Device, trials: int, moving: bool) -> tuple[Fit, dict[str, float]]:
    """Return the fit whose parts make held-out units likeliest, each part by at least `WORTH`."""
    delay = start.numbers["delay"]
    first: list[tuple[float, Fit, tuple[str, ...]]] = []
    for names in ((), ("stiffness",), *([("friction",), ("friction", "stiffness")] if moving else [])):
        numbers = (*BASE, *(number for name in names for number in NUMBERS[name]))
        found = refined(held, begun(held, numbers, delay + 2), trials)
        if all(found.device.numbers[each] > 0 for each in numbers if each in ("gamma", "coulomb")):
            first.append((held_out(found) - WORTH * len(names), found, names))
    best, fit, names = max(first, key=lambda each: each[0])
    score = best + WORTH * len(names)
    parts = dict.fromkeys(names, score - first[0][0])
    while len(parts) < len(NUMBERS):
        tried = [
            (held_out(other) - score, name, other)
            for name in NUMBERS
            if name not in parts and (name != "friction" or moving)
            for other in (refined(held, each, trials, 10) for each in _having(held, fit.device, trials, name))
        ]
        gain, name, other = max(tried, key=lambda each: each[0])
        if gain < WORTH:
            break
        fit, score, parts = other, score + gain, parts | {name: gain}
    return fit, parts


def _promise(held: Stretches, device: Device, trials: int) -> float:
    """Return the likelihood one step from a device."""
    moments, spread = moments_of(held, device, trials)
    return solve(moments, np.empty(0, dtype=np.int64)).likelihood - spread


def _having(held: Stretches, device: Device, trials: int, part: str) -> Iterator[Device]:
    """Yield devices with one part more, from which a search starts."""
    numbers, delay = device.numbers, device.numbers["delay"]
    if part == "lag":
        for lag in (1.0, 4.0):
            yield replace(device, numbers=numbers | {"lag": lag, "delay": max(delay - lag, 0.0)}, effects=None)
    elif part == "mode":
        likeliest = max(
            (replace(device, numbers=numbers | {"turn": turn, "ratio": 0.05, "share": 0.03}) for turn in TURNS),
            key=lambda each: _promise(held, each, trials),
        )
        yield replace(likeliest, effects=None)
    else:
        (name,) = NUMBERS[part]
        yield replace(device, numbers=numbers | {name: 0.0}, effects=None)

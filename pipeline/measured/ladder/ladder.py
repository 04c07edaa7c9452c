"""The simplest device that explains an experiment's trials, chosen on trials that it was not fitted to.

Parts are added one by one, each time the one by which the held-out trials become likeliest, until these are explained;
then every part that is not missed is taken away again. What explains as well with as many parts cannot be told apart
from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.measured.explained import holds
from pipeline.measured.ladder.device import Device
from pipeline.measured.ladder.parts import GROUPS, LIGHT, PARTS, RIVALS, likeliest, parts_of, without
from pipeline.measured.ladder.search import covariance_of, judged, search
from pipeline.measured.ladder.trials import LadderTrials
from pipeline.records.batch import Floats

MISSED = 6.0
"""Fall of the held-out logarithm of the likelihood by which a part is missed: odds of 400 to 1."""

LIKENESS = 20.0
"""As `MISSED`, for a fast mode in place of a lag: it has two numbers more, which few trials hardly tell."""

WORTH = 0.1
"""Share of what a device lacks to explain the trials that another part must bring: less is but its likeness."""

CHOICE_TRIALS, CHOICE_ROWS = 48, 500
"""Trials and rows by which parts are chosen, half of the trials held out; more choose the same and take longer."""

FEWEST_TRIALS = 6
"""Trials below which none can be held out."""

MOST_PARTS = 5
"""Parts beside mass, damper and delay."""

LOST = 0.5
"""Share of the trials that must be explained for the others to be left out of the last fit."""


@dataclass(frozen=True, eq=False)
class Rung:
    """A device fitted to some trials and judged by others.

    Parameters
    ----------
    device : Device
    explained, of : int
        Number of held-out trials that it explains, and of all of them.
    score : float
        Logarithm of the likelihood of the held-out trials, each with noise of unknown size.
    """

    device: Device
    explained: int
    of: int
    score: float

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the device's parts."""
        return parts_of(self.device)

    @property
    def holds(self) -> bool:
        """Whether the device explains nearly all of the held-out trials."""
        return holds(self.explained, self.of)


@dataclass(frozen=True, eq=False)
class Ladder:
    """What a climb found.

    Parameters
    ----------
    best : Rung
        The simplest device that explains, or the likeliest where none does, by all trials.
    covariance : float64, shape (P, P)
        Of its numbers.
    ideal : Rung
        The device with mass, damper and delay alone.
    next_best : Rung or None
        The likeliest device with as many parts, or with one more or less.
    alike : tuple of Rung
        Devices with as many parts that cannot be told apart from it.
    """

    best: Rung
    covariance: Floats
    ideal: Rung
    next_best: Rung | None
    alike: tuple[Rung, ...]


def climb(trials: LadderTrials, ideal: Device, groups: Sequence[Sequence[str]] = GROUPS) -> Ladder:
    """Return the simplest device that explains the trials, from the ideal one upwards.

    Parameters
    ----------
    trials : LadderTrials
        At least `FEWEST_TRIALS`, in the order of their place in the plane.
    ideal : Device
        With the mass, damper and delay to start from.
    groups : sequence of sequences of str, optional
        Parts that are looked for, those of a later group only where no earlier part explains the trials.
    """
    few = trials.select(np.unique(np.linspace(0, len(trials) - 1, CHOICE_TRIALS).astype(np.int64))).head(CHOICE_ROWS)
    fitted, held = _halves(few)
    now = _rung(fitted, held, [ideal])
    tried, bases = [now], [now.device, ideal]
    for _ in range(MOST_PARTS):
        more = _more(fitted, held, now, bases, groups)
        tried += more
        # what explains the trials may still be the likeness of a part that costs little to look for
        least = MISSED if now.holds else max(MISSED, -WORTH * now.score)
        if not more or more[0].score - now.score <= least:
            break
        now = more[0]
        bases = [now.device]
    now, less = _pruned(fitted, held, now)
    rivals = _rivals(fitted, held, now)
    for rival in rivals:
        if rival.holds and rival.score - now.score > MISSED:
            tried, now = [*tried, now], rival
    tried += rivals
    others = [rung for rung in (*tried, *less) if not set(now.parts) <= set(rung.parts)]
    others.sort(key=lambda rung: -rung.score)
    alike = [
        rung
        for rung in others
        if rung.holds
        and len(rung.parts) == len(now.parts)
        and now.score - rung.score <= (LIKENESS if rung in rivals else MISSED)
    ]
    # of what does not hold with few trials more of them tell nothing
    best, covariance = _refined(trials if now.holds else few, now.device)
    return Ladder(best, covariance, tried[0], others[0] if others else None, tuple(alike))


def _halves(trials: LadderTrials) -> tuple[LadderTrials, LadderTrials]:
    even = np.arange(len(trials)) % 2 == 0
    return trials.select(even), trials.select(~even)


def _rung(fitted: LadderTrials, held: LadderTrials, starts: list[Device]) -> Rung:
    """Return the best device of searches from some starts."""
    found = [search(fitted, start) for start in starts]
    # while frequency and delay are far off, the far mass runs away from where it is when they are right
    found += [search(fitted, fit.device.having(**LIGHT)) for fit in found if fit.device.sensor]
    device = min(found, key=lambda fit: fit.cost).device
    misfit, good = judged(held, device)
    score = -float((held.information * np.log(np.maximum(misfit, 1e-3))).sum())
    return Rung(device, int(good.sum()), len(good), score)


def _more(
    fitted: LadderTrials, held: LadderTrials, now: Rung, bases: list[Device], groups: Sequence[Sequence[str]]
) -> list[Rung]:
    """Return the device with each part that it lacks, likeliest first.

    Parts that take longer to look for are left out where another one explains the trials.
    """
    found: list[Rung] = []
    for group in groups:
        if now.holds and group is not groups[0]:
            break
        for part in group:
            if part in now.parts or (part.startswith("mode") and now.device.sensor):
                continue
            starts = [start for base in bases for start in PARTS[part][1](fitted, base)]
            found.append(_rung(fitted, held, likeliest(fitted, starts)))
        if any(rung.holds for rung in found):
            break
    return sorted(found, key=lambda rung: -rung.score)


def _rivals(fitted: LadderTrials, held: LadderTrials, now: Rung) -> list[Rung]:
    """Return the devices with a fast mode in place of a lag: both hold back what follows a command."""
    if "lag" not in now.parts or now.device.sensor:
        return []
    base = without(now.device, "lag")
    return [_rung(fitted, held, likeliest(fitted, starts(fitted, base))) for starts in RIVALS]


def _pruned(fitted: LadderTrials, held: LadderTrials, now: Rung) -> tuple[Rung, list[Rung]]:
    """Return the device without the parts that it does not miss, and those with one part less that it is missed by."""
    while now.parts:
        less = [_rung(fitted, held, [without(now.device, part)]) for part in now.parts]
        likeliest = max(less, key=lambda rung: rung.score)
        if now.score - likeliest.score > MISSED or (now.holds and not likeliest.holds):
            return now, less
        now = likeliest
    return now, []


def _refined(trials: LadderTrials, device: Device) -> tuple[Rung, Floats]:
    """Return a device fitted to half of all trials and judged by the other, then to all that it explains."""
    fitted, held = _halves(trials)
    rung = _rung(fitted, held, [device])
    _, good = judged(trials, rung.device)
    used = trials.select(good) if good.mean() >= LOST else trials
    final = search(used, rung.device)
    return Rung(final.device, rung.explained, rung.of, rung.score), covariance_of(used, final)

"""Which parts a device has: those without which held-out trials are less likely."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.model.estimation import Device, Fit, begun, moments_of, refined
from pipeline.measured.model.intervals import Errors, physical
from pipeline.measured.model.recordings import Holding, Recording, Scales, Stretches, stretches
from pipeline.measured.model.scatter import Moments, inverse, solve

BASE = ("gain", "delta", "delay", "force")
"""Numbers of every device."""

NUMBERS = {"friction": ("coulomb",), "stiffness": ("gamma",), "lag": ("lag",), "mode": ("turn", "ratio", "share")}
"""Numbers of each part."""

FOLDS = 5

WORTH = 5.0
"""Gain of held-out log-likelihood from which on a part is one: odds of 150 to 1."""

MOST_TRIALS = 100
"""Trials by which parts are chosen; all are fitted in the end."""

LONGEST_DELAY = 48
"""Longest delay [samples] that is looked for."""

SHARES = (0.05, 0.2)
"""Shares of the far mass from which a mode is looked for."""

TURNS = (0.06, 0.09, 0.13, 0.2, 0.3, 0.45, 0.7, 1.0)
"""Frequencies [rad a sample] from which a mode is looked for, a factor of 1.5 apart."""


OPEN = 0.02
"""Friction, relative to the largest command, that may act unseen before it must be taken along as unknown: a mass is
too large by as much."""

CONSTANT = 1e-3
"""Change of the commands, relative to the largest, below which they count as one constant command."""


@dataclass(frozen=True, eq=False)
class Choice:
    """A fit with the parts that it has, and by how much each made held-out trials likelier.

    A part with 0 may be there or not: its number is taken along as unknown. ``assumed`` names what is taken as none.
    """

    fit: Fit
    held: Stretches
    scales: Scales
    parts: dict[str, float]
    assumed: tuple[str, ...]

    @property
    def moving(self) -> bool:
        """Whether rows at which the direction of motion is not seen are left out."""
        return "friction" in self.parts


def held_out(fit: Fit) -> float:
    """Return the log-likelihood of units by fits without their fold, each one Newton step from the whole fit.

    Each portion of few logs is a fold, and the step that of first order (Takeuchi's criterion).
    """
    solved = fit.solved
    total, units, lost = solved.total, len(solved.score), 0.0
    if fit.few:
        known = inverse(total)
        return fit.likelihood - float(np.einsum("ti,ij,tj->", solved.score, known, solved.score))
    for fold in range(FOLDS):
        inside = np.arange(units) % FOLDS == fold
        information, score = solved.information[inside].sum(axis=0), solved.score[inside].sum(axis=0)
        step = -inverse(total - information) @ score
        # never above 0 but for rounding, where a direction is hardly known
        lost += min(float(score @ step - 0.5 * step @ information @ step), 0.0)
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
    rows = int(np.median([len(each.time) for each in some]))
    base, assumed = _base(some)
    if "force" not in base:
        # a spring is then taken as relaxed where the logs begin
        scales = replace(scales, origin=float(np.median([each.position[0] for each in some])))
    delay = _delay(some, scales, base, int(np.clip(rows // 8, 2, LONGEST_DELAY)))
    lead = int(np.ceil(delay)) + 3
    held = stretches(some, scales, lead, True)
    found = _with_friction(held, base, delay, len(some)) if len(held) else None
    if found is None:
        held = stretches(some, scales, lead, False)
        found = _worth(held, (*base, "gamma"), delay, len(some))
    fit, parts = found
    holding = None
    if parts.get("friction", 0.0) > 0:
        holding = _holding(fit, scales)
        held = stretches(some, scales, lead, True, holding)
        fit = refined(held, replace(fit.device, effects=None), len(some))
    fit, parts = _further(held, fit, parts, len(some))
    if {"lag", "mode"} & set(parts):
        held, fit, parts = _pruned((some, scales, lead), held, fit, parts)
    if len(places) < len(recordings):
        held = stretches(recordings, scales, lead, "friction" in parts, holding)
        fit = refined(held, replace(fit.device, effects=None), len(recordings))
    return Choice(fit, held, scales, parts, assumed)


def again(choice: Choice, recordings: list[Recording], steps: int) -> Choice:
    """Return the fit of other recordings with the parts of an earlier choice, after so many steps from its numbers."""
    found, scales = choice.fit, choice.scales
    holding = _holding(found, scales) if choice.parts.get("friction", 0.0) > 0 else None
    held = stretches(recordings, scales, choice.held.lead, choice.moving, holding)
    fit = refined(held, replace(found.device, effects=None), len(recordings), steps)
    return Choice(fit, held, scales, choice.parts, choice.assumed)


def _holding(fit: Fit, scales: Scales) -> Holding:
    """Return what may hold the device in SI, friction a tenth larger than found."""
    found, numbers = physical(scales), fit.device.numbers
    spring = found["stiffness"](numbers) if "gamma" in numbers else 0.0
    late = found["delay"](numbers) if "delay" in numbers else 0.0
    return Holding(1.1 * found["friction"](numbers), spring, late)


def _base(recordings: list[Recording]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the numbers that commands can tell, and those that are taken as none."""
    largest = max(float(np.abs(each.command).max()) for each in recordings)
    if any(np.ptp(each.command) > CONSTANT * largest for each in recordings):
        return BASE, ()
    if any(each.edge is not None for each in recordings):
        return ("gain", "delta", "delay"), ("constant_force",)
    levels = np.array([float(each.command[0]) for each in recordings])
    if np.ptp(levels) > CONSTANT * largest:
        return ("gain", "delta", "force"), ("delay",)
    return ("gain", "delta"), ("delay", "constant_force")


def _delay(recordings: list[Recording], scales: Scales, base: tuple[str, ...], lead: int) -> float:
    """Return the delay [samples] of the best start with a spring and friction."""
    names = (*base, "gamma", "coulomb")
    held = stretches(recordings, scales, lead, True)
    if not len(held):
        names, held = (*base, "gamma"), stretches(recordings, scales, lead, False)
    return begun(held, names, lead).numbers.get("delay", 0.0)


def _worth(held: Stretches, names: tuple[str, ...], delay: float, trials: int) -> tuple[Fit, dict[str, float]]:
    """Return the fit with a spring where there is one, else without, and what it is worth."""
    fit = refined(held, begun(held, names, delay + 2), trials)
    gain = _loss(fit, "gamma")
    if gain > WORTH:
        return fit, {"stiffness": gain}
    left = tuple(name for name in names if name != "gamma")
    return refined(held, begun(held, left, delay + 2), trials), {}


def _pruned(
    logs: tuple[list[Recording], Scales, int], held: Stretches, fit: Fit, parts: dict[str, float]
) -> tuple[Stretches, Fit, dict[str, float]]:
    """Return stretches, fit and parts without friction and spring that only stood for a lag or a mode."""
    recordings, scales, lead = logs
    for name, number in (("friction", "coulomb"), ("stiffness", "gamma")):
        if name not in parts or _loss(fit, number) > WORTH:
            continue
        if name == "friction":
            friction = Errors.of(fit).interval(lambda n: n["coulomb"] / n["gain"], bounded=True)
            if friction.high >= OPEN:
                parts = parts | {"friction": 0.0}
                continue
            held = stretches(recordings, scales, lead, False)
        left = {key: value for key, value in fit.device.numbers.items() if key != number}
        fit = refined(held, Device(left, fit.device.disturbance), len(recordings))
        parts = {key: value for key, value in parts.items() if key != name}
    return held, fit, parts


def _loss(fit: Fit, name: str) -> float:
    """Return by how much the likelihood falls without a number that is not negative, in which the motion is linear."""
    found = Errors.of(fit).interval(lambda n: n[name])
    return 0.5 * (found.value / found.error) ** 2 if found.value > 0 and found.error > 0 else 0.0


def _with_friction(
    held: Stretches, base: tuple[str, ...], delay: float, trials: int
) -> tuple[Fit, dict[str, float]] | None:
    """Return the fit with friction where there is some or may be, None where there is none."""
    fit, parts = _worth(held, (*base, "gamma", "coulomb"), delay, trials)
    gain = _loss(fit, "coulomb")
    if gain > WORTH:
        return fit, {"friction": gain} | parts
    friction = Errors.of(fit).interval(lambda n: n["coulomb"] / n["gain"], bounded=True)
    return None if friction.high < OPEN else (fit, {"friction": 0.0} | parts)


def _further(held: Stretches, fit: Fit, parts: dict[str, float], trials: int) -> tuple[Fit, dict[str, float]]:
    """Return the fit with lag and mode, where held-out units are likelier with them."""
    for name, size in (("lag", "lag"), ("mode", "share")):
        if "delay" not in fit.device.numbers:
            break
        other = refined(held, _having(held, fit.device, trials, name), trials)
        if _loss(other, size) < WORTH or held_out(other) - held_out(fit) < WORTH:
            continue
        # the search for the part went on where that without it had ended
        fit = refined(held, replace(fit.device, effects=None), trials)
        gain = held_out(other) - held_out(fit)
        if gain > WORTH * len(NUMBERS[name]):
            fit, parts = other, parts | {name: gain}
    return fit, parts


def _promise(held: Stretches, device: Device, trials: int) -> float:
    """Return the likelihood of a mode as it stands, with the best of the device's other numbers."""
    moments, spread = moments_of(held, device, trials)
    others = [i for i, name in enumerate(device.names) if name not in NUMBERS["mode"]] + [len(device.names)]
    left = Moments(moments.products[:, others][:, :, others], moments.rows)
    return solve(left, np.empty(0, dtype=np.int64)).likelihood - spread


def _having(held: Stretches, device: Device, trials: int, part: str) -> Device:
    """Return a device with one part more, from which a search starts."""
    numbers, delay = device.numbers, device.numbers["delay"]
    if part == "lag":
        lag = max(0.5 * delay, 0.5)
        return replace(device, numbers=numbers | {"lag": lag, "delay": max(delay - lag, 0.0)}, effects=None)
    likeliest, turns = replace(device, effects=None), np.array(TURNS)
    for shares in (SHARES, (1.0,)):
        modes = [
            numbers | {"turn": float(turn), "ratio": 0.04, "share": share * likeliest.numbers.get("share", 1.0)}
            for turn in turns
            for share in shares
        ]
        likeliest = max(
            (replace(likeliest, numbers=each) for each in modes), key=lambda each: _promise(held, each, trials)
        )
        turns = likeliest.numbers["turn"] * np.array([0.86, 0.93, 1.0, 1.07, 1.15])
    return likeliest

"""The device that was fitted to all trials of an experiment, as the stage `ladder` stores it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pipeline.measured.experiment.stored import Stored
from pipeline.measured.explained import holds
from pipeline.measured.intervals import NORMAL_95
from pipeline.records.batch import Floats
from pipeline.records.findings import Estimate
from pipeline.records.loop_records import Parameter

METHOD = "one device fitted to all trials"

LIKELIEST = "likeliest device of all trials, friction and scatter included"

TOLD = 0.5
"""Share of the held-out trials that a device must explain, or follow, for its parts to be named as causes."""


@dataclass(frozen=True, eq=False)
class FittedDevice:
    """The best device of a ladder.

    Parameters
    ----------
    parts : tuple of str
        What it has beside mass, damper and delay, as in the stage `ladder`.
    explained, held_out : int
        Trials that it was not fitted to: how many it explains, and all of them.
    values : dict of str to float
        Its numbers in SI by name.
    covariance : float64, shape (P, P)
        Of these.
    alike : tuple of str
        Parts of devices that cannot be told apart from it.
    next_best : tuple of str
        Parts of the likeliest other device, and in how many trials it holds; empty where there is none.
    saturated : float
        Share of the stable trials that command more force than it has.
    likely : bool
        Whether it is the likeliest one of all logs: what it does not explain is in its covariance, and ``explained``
        counts the trials that its free runs follow.
    open : tuple of str
        Names of its numbers that the logs leave open.
    scatter : dict of str to float
        Standard deviations from run to run by name.
    folds : tuple of dict of str to float
        Its values by the trials but every fifth from the first, the second ... on; empty where they are not known.
    trials : tuple of str
        That it was fitted to, in the order of these folds.
    """

    parts: tuple[str, ...]
    explained: int
    held_out: int
    values: dict[str, float]
    covariance: Floats
    alike: tuple[str, ...]
    next_best: str
    saturated: float
    likely: bool = False
    open: tuple[str, ...] = ()
    scatter: Mapping[str, float] = field(default_factory=dict)
    folds: tuple[Mapping[str, float], ...] = ()
    trials: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether it explains nearly all trials that it was not fitted to, or widens its intervals by what is left."""
        return self.likely or holds(self.explained, self.held_out)

    @property
    def method(self) -> str:
        """How it was found, in words."""
        return LIKELIEST if self.likely else METHOD

    @property
    def is_trusted(self) -> bool:
        """Whether its intervals stand where its loop is no linear one."""
        return self.tells if self.likely else self.is_nonlinear

    @property
    def is_nonlinear(self) -> bool:
        """Whether it has a part that linear theory cannot hold: where it explains, its numbers stand, no limit does."""
        return not {"friction", "saturation"}.isdisjoint(self.parts)

    @property
    def tells(self) -> bool:
        """Whether it explains enough of them for its parts to be real."""
        return self.explained >= TOLD * self.held_out

    def parameter(self, name: str) -> Parameter | None:
        """Return one of its numbers with its 95 % interval; None where it has none."""
        return self.known(name) if name in self.values else None

    def known(self, name: str) -> Parameter:
        """Return one of the numbers that it has with its 95 % interval."""
        value = self.values[name]
        reach = NORMAL_95 * float(np.sqrt(self.covariance[(place := list(self.values).index(name)), place]))
        return Parameter(value=value, low=value - reach, high=value + reach)

    def estimate(self, name: str, unit: str) -> Estimate | None:
        """Return one of its numbers as an estimate; None where it has none."""
        number = self.parameter(name)
        if number is None:
            return None
        found = number.model_dump()
        if name in self.open:
            found |= {"value": None, "low": max(number.low, 0.0), "reason": "the logs leave it open"}
        return Estimate(**found, unit=unit, method=self.method, trials=self.held_out)


def fitted_device(of: Stored) -> FittedDevice | None:
    """Return the best device of the stage `ladder`, None where there is none."""
    roles = of.texts("ladder", "role")
    if not roles:
        return None
    parts, numbers = of.texts("ladder", "parts"), json.loads(of.texts("ladder", "numbers")[0])
    explained, held_out = (of.column("ladder", name).astype(int).tolist() for name in ("explained", "held_out"))
    after = roles.index("next best") if "next best" in roles else None
    return FittedDevice(
        tuple(filter(None, parts[0].split(","))),
        explained[0],
        held_out[0],
        dict(zip(numbers["names"], numbers["values"], strict=True)),
        np.array(numbers["covariance"]),
        tuple(part for role, part in zip(roles, parts, strict=True) if role == "alike"),
        "" if after is None else f"{_words(parts[after])}: {explained[after]} of {held_out[after]}",
        numbers["saturated"],
        "scatter" in numbers,
        tuple(numbers.get("open", ())),
        numbers.get("scatter", {}),
        tuple(numbers.get("folds", ())),
        tuple(numbers.get("trials", ())),
    )


def explaining_device(of: Stored) -> FittedDevice | None:
    """Return the device fitted to all trials where it explains nearly all that it was not fitted to, else None."""
    device = of.once(fitted_device)
    return device if device is not None and device.holds else None


def _words(parts: str) -> str:
    return parts.replace(",", ", ") or "mass, damping and delay alone"

"""What a fit says in SI: quantities of a device, each with one interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.measured.model.likelihood import LINEAR, Fit
from pipeline.measured.model.motion import Physics
from pipeline.measured.model.recordings import Scales
from pipeline.measured.model.scatter import inverse, untold
from pipeline.measured.student import NORMAL_95, student_95
from pipeline.records.batch import Floats

COMPUTED = 1e-9
"""Error relative to a value that computing it leaves: the search ends there in logs without noise."""


FAR = 1e3
"""Deviation, relative to the size of a number, of what logs tell nothing about."""

GROUPS = 10
"""Neighbours in the order of walls that a jackknife leaves out together, from twice as many units on."""


@dataclass(frozen=True)
class Interval:
    """A quantity with its 95 % interval; ``error`` is its standard error."""

    value: float
    low: float
    high: float
    error: float = 0.0


Quantity = Callable[[dict[str, float]], float]

Numbers = dict[str, float]


def physical(scales: Scales) -> dict[str, Quantity]:
    """Return each quantity in SI as a function of a device's numbers; all per unit of command."""
    acceleration = scales.position / scales.command / scales.period**2
    command = scales.command

    def mass(n: Numbers) -> float:
        return 1 / (n["gain"] * acceleration) if n["gain"] else float("inf")

    def damper(n: Numbers) -> float:
        if "within" in n:
            return n["ratio"] * n["within"]
        drag, far = n.get("drag", 0.0), n["share"] / (1 - n["share"])
        return n["ratio"] - ((n["delta"] - drag) * far + drag / far) / (2 * n["turn"])

    return {
        "mass": mass,
        "damping": lambda n: n["delta"] / scales.period * mass(n),
        "stiffness": lambda n: n["gamma"] / scales.period**2 * mass(n),
        "delay": lambda n: n["delay"] * scales.period,
        "friction": lambda n: n["coulomb"] / n["gain"] * command,
        "constant_force": lambda n: n["force"] / n["gain"] * command,
        "actuator_lag": lambda n: n["lag"] * scales.period,
        "mode_frequency": lambda n: n["turn"] / (2 * np.pi * scales.period),
        "mode_damping_ratio": damper,
        "mode_mass": lambda n: Physics.of(n).far * mass(n),
        "load_damping": lambda n: n["drag"] / scales.period * mass(n),
        "force_limit": lambda n: n["limit"] * command,
    }


NEEDED = {
    "mass": "gain",
    "damping": "delta",
    "stiffness": "gamma",
    "delay": "delay",
    "friction": "coulomb",
    "constant_force": "force",
    "actuator_lag": "lag",
    "mode_frequency": "turn",
    "mode_damping_ratio": "ratio",
    "mode_mass": "turn",
    "load_damping": "drag",
    "force_limit": "limit",
}
"""Number of a device that each quantity stands for: it is told where the device has it."""

BOUNDED = {*NEEDED} - {"mass", "constant_force", "mode_frequency", "force_limit"}
"""Quantities that are not negative."""


@dataclass(frozen=True, eq=False)
class Errors:
    """What intervals rest on: numbers and their covariance, those without each unit, degrees of freedom, the change of
    the numbers by an error of the noise, what each phase of the motion adds to them, and the steps to other optima."""

    numbers: Numbers
    covariance_of_numbers: Floats
    without: Floats
    freedom: float
    open: Floats
    phases: Floats
    optima: Floats

    @classmethod
    def of(cls, fit: Fit) -> Errors:
        """Return the errors of a fit: by its information, and by leaving out one unit, each with one Newton step.

        A portion of few logs may be the only one that tells a number, such as the delay: its step is of first order.
        """
        solved, numbers = fit.solved, fit.device.numbers
        total = solved.total
        told = np.einsum("tii->t", solved.information) > 0
        information, score = solved.information[told], solved.score[told]
        without = (total if fit.few else total - own for own in information)
        steps = np.stack([-(inverse(rest) @ each) for rest, each in zip(without, score, strict=True)])
        freedom = max(float(told.sum() - 1), 1.0)
        nothing = untold(total)
        sizes = [max(abs(value), numbers.get("gain", 0.0) * (name in LINEAR), 1e-6) for name, value in numbers.items()]
        nothing *= FAR / np.abs(nothing / sizes).max(axis=1, keepdims=True, initial=1e-300)
        # equal readings count as one
        known = fit.alike * inverse(total) + nothing.T @ nothing
        return cls(numbers, known, steps, freedom, fit.open, fit.phases, fit.optima)

    def interval(self, quantity: Quantity, bounded: bool = False, unit: float = 0.0) -> Interval:
        """Return a quantity's value and interval; one that is not negative by its profile likelihood at 0.

        ``unit`` is the size of what it is told beside, of which computing leaves an error.
        """
        value, slope = quantity(self.numbers), self._slope(quantity)
        error = max(float(np.sqrt(self._spread(slope[None])[0])), COMPUTED * max(abs(value), unit))
        reach = float(student_95(self.freedom)) * error
        if bounded and value - reach < 0:
            # from the likeliest value that is allowed the likelihood falls by as much as it does inside
            top = value + reach if value >= 0 else value + float(np.hypot(value, reach))
            return Interval(max(value, 0.0), 0.0, max(top, 0.0), error)
        return Interval(value, value - reach, value + reach, error)

    def covariance(self, quantities: Sequence[Quantity]) -> Floats:
        """Return the covariance (Q, Q) of quantities, as large as their intervals of 95 % are for a normal one."""
        slopes = np.stack([self._slope(quantity) for quantity in quantities])
        known = slopes @ self.covariance_of_numbers @ slopes.T
        size = np.sqrt(np.maximum(np.diagonal(known), 1e-300))
        reach = float(student_95(self.freedom)) / NORMAL_95
        wide = reach * np.sqrt(self._spread(slopes)) / size
        return np.asarray(known * wide[:, None] * wide[None, :])

    def _slope(self, quantity: Quantity) -> Floats:
        """Return the derivative of a quantity along each number, (p,)."""
        names = list(self.numbers)
        base = np.array([self.numbers[name] for name in names])
        sizes = np.sqrt(np.maximum(np.diagonal(self.covariance_of_numbers), 0.0))
        slope = np.zeros(len(names))
        for i, size in enumerate(np.minimum(sizes, np.abs(base) + 1e-6) * 1e-3):
            ends = [
                quantity(dict(zip(names, base + sign * size * (np.arange(len(names)) == i), strict=True)))
                for sign in (1, -1)
            ]
            slope[i] = (ends[0] - ends[1]) / (2 * size) if size > 0 else 0.0
        return slope

    def _spread(self, slopes: Floats) -> Floats:
        """Return the variance along slopes (Q, p): of the information, or of a jackknife where that is larger.

        What the model leaves out moves units of alike walls alike, which follow each other, and acts in each phase of
        the motion otherwise: these are left out together, too.
        """
        variance = np.einsum("qi,ij,qj->q", slopes, self.covariance_of_numbers, slopes)
        count, spread = len(self.without), (self.without - self.without.mean(axis=0)) @ slopes.T
        variance = np.maximum(variance, (count - 1) / count * (spread**2).sum(axis=0))
        phases = self.phases @ slopes.T
        together = [phases, phases[::2] + phases[1::2]]
        if count >= 2 * GROUPS:
            together.append(np.array([each.sum(axis=0) for each in np.array_split(spread, GROUPS)]))
        for groups in together:
            freedom = len(groups) - 1.0
            wider = float(student_95(freedom) / student_95(self.freedom))
            variance = np.maximum(variance, wider**2 * (1 + 1 / freedom) * (groups**2).sum(axis=0))
        optima = np.abs(slopes @ self.optima.T).max(axis=1, initial=0.0) / float(student_95(self.freedom))
        return np.asarray(variance + (slopes @ self.open) ** 2 + optima**2)

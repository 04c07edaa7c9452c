"""Convert the result of a fit into quantities in SI with 95 % intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.measured.identification.estimated import ESTIMATED, Numbers, Quantity
from pipeline.measured.identification.likelihood import LINEAR, Fit
from pipeline.measured.identification.recordings import LogUnits
from pipeline.measured.identification.scatter import inverse, unidentified
from pipeline.measured.student import NORMAL_95, student_95
from pipeline.records.trials import Floats, Integers

COMPUTED = 1e-9
"""Relative numerical error of a value, equal to the accuracy of the search in logs without noise."""

FAR = 1e3
"""Deviation, relative to the size of a number, that is assumed if the logs contain no information on the number."""

SHARED = 0.1
"""Information of all logs that is added to the information of each group, as a multiple of the information of an
average group. A group that does not separate two numbers then has a wide error instead of an arbitrary estimate."""

BY_CHANCE = 1e-3
"""Probability below which a disagreement between groups is not attributed to chance."""

GROUPS = 10
"""Number of groups of neighbouring walls for a jackknife. It is used if there are at least twice as many units."""


@dataclass(frozen=True)
class Interval:
    """A quantity with its 95 % interval and its standard error ``error``."""

    value: float
    low: float
    high: float
    error: float = 0.0


@dataclass(frozen=True, eq=False)
class OwnEstimates:
    """Separate estimates of groups: the logs, or the halves of few logs.

    Parameters
    ----------
    steps : float64, shape (G, p)
        Separate estimates, as steps from the common estimate.
    covariance : float64, shape (G, p, p)
        Their covariances, if the model is complete.
    """

    steps: Floats
    covariance: Floats

    @classmethod
    def of(cls, fit: Fit, groups: Integers) -> OwnEstimates:
        """Return the separate estimates, from the group (U,) of each unit of a fit."""
        solved, count = fit.solved, int(groups.max()) + 1
        information = np.zeros((count, *solved.information.shape[1:]))
        score = np.zeros((count, solved.score.shape[1]))
        np.add.at(information, groups, solved.information)
        np.add.at(score, groups, solved.score)
        covariance = inverse(information + SHARED / count * solved.total)
        return cls((covariance @ score[..., None])[..., 0], fit.repeats * covariance)

    def variances(self, slopes: Floats) -> Floats:
        """Return the variance between groups along slopes (Q, p), or 0 where chance explains it.

        The statistic q = sum w_g (v_g - mean)^2 of G estimates v_g with weights w_g = 1/e_g^2 has the mean G - 1.
        A larger statistic gives the variance (q - G + 1)/(sum w - sum w^2/sum w). Weights are relative to the smallest
        one.

        Source: DerSimonian and Laird 1986, "Meta-analysis in clinical trials".
        """
        from scipy.special import chdtri

        values = self.steps @ slopes.T
        squares = np.einsum("qi,gij,qj->gq", slopes, self.covariance, slopes)
        # a group without information has neither an estimate nor an error
        informed, largest = squares > 0, np.maximum(squares.max(axis=0), 1e-300)
        weight = np.where(informed, largest / np.where(informed, squares, 1.0), 0.0)
        total, chance = np.maximum(weight.sum(axis=0), 1.0), np.maximum(informed.sum(axis=0) - 1.0, 0.0)
        mean = (weight * values).sum(axis=0) / total
        statistic = (weight * (values - mean) ** 2).sum(axis=0) / largest
        spread = np.maximum((total - (weight**2).sum(axis=0) / total) / largest, 1e-300)
        disagree = (chance > 0) & (statistic > chdtri(np.maximum(chance, 1.0), BY_CHANCE))
        return np.where(disagree, (statistic - chance) / spread, 0.0)


@dataclass(frozen=True, eq=False)
class Errors:
    """Inputs for intervals.

    Parameters
    ----------
    numbers : dict of str to float
    covariance_of_numbers : float64, shape (p, p)
    without : float64, shape (U, p)
        Change of the numbers if one unit is left out.
    freedom : float
        Degrees of freedom.
    open : float64, shape (p,)
        Change of the numbers due to an error of the noise.
    phases : float64, shape (F, p)
        Contributions of the phases of the motion.
    optima : float64, shape (O, p)
        Steps to other optima.
    own : OwnEstimates, optional
        Separate estimates of groups, if their disagreement widens the intervals.
    """

    numbers: Numbers
    covariance_of_numbers: Floats
    without: Floats
    freedom: float
    open: Floats
    phases: Floats
    optima: Floats
    own: OwnEstimates | None = None

    @classmethod
    def of(cls, fit: Fit) -> Errors:
        """Return the errors of a fit, from its information matrix and from one Newton step without each unit.

        In few logs, only a single portion may identify a number, such as the delay. The step without it is then of
        first order.

        Raises
        ------
        numpy.linalg.LinAlgError
            If no unit contains information, because the errors cannot be computed in double precision.
        """
        solved, numbers = fit.solved, fit.device.numbers
        total = solved.total
        informative = np.einsum("tii->t", solved.information) > 0
        if not informative.any():
            raise np.linalg.LinAlgError("its errors exceed the range of double precision")
        information, score = solved.information[informative], solved.score[informative]
        without = inverse(total)[None] if fit.few else inverse(total - information)
        steps = -(without @ score[..., None])[..., 0]
        freedom = max(float(informative.sum() - 1), 1.0)
        nothing = unidentified(total)
        # numbers of the shape are per sample and for unit mass
        least = {name: numbers.get("gain", 0.0) if name in LINEAR else 1.0 for name in numbers}
        sizes = [max(abs(value), least[name], 1e-6) for name, value in numbers.items()]
        nothing *= FAR / np.abs(nothing / sizes).max(axis=1, keepdims=True, initial=1e-300)
        # repeated equal readings count as one reading
        known = fit.repeats * inverse(total) + nothing.T @ nothing
        return cls(numbers, known, steps, freedom, fit.open, fit.phases, fit.optima)

    def parameter(self, name: str, units: LogUnits) -> Interval:
        """Return a parameter of the loop with its interval. ``name`` is a key of `ESTIMATED`."""
        row, mass = ESTIMATED[name], ESTIMATED["mass"].quantity(units)(self.numbers)
        return self.interval(row.quantity(units), row.ends_at_zero, row.unit_size(mass, units))

    def interval(self, quantity: Quantity, ends_at_zero: bool = False, unit: float = 0.0) -> Interval:
        """Return a quantity with its interval. ``ends_at_zero`` bounds the interval by 0, with the profile likelihood.

        If the value is 0, ``unit`` scales the numerical error.
        """
        value, slope = quantity(self.numbers), self._slope(quantity)
        error = max(float(np.sqrt(self._spread(slope[None])[0])), COMPUTED * max(abs(value), unit))
        reach = float(student_95(self.freedom)) * error
        if ends_at_zero and value - reach < 0:
            # the drop of the likelihood from the best admissible value to the end of the interval equals the drop
            # from an interior optimum to the end of its interval
            top = value + reach if value >= 0 else value + float(np.hypot(value, reach))
            return Interval(max(value, 0.0), 0.0, max(top, 0.0), error)
        return Interval(value, value - reach, value + reach, error)

    def covariance(self, names: Sequence[str], units: LogUnits) -> Floats:
        """Return the covariance (Q, Q) of parameters, scaled so that its normal 95 % intervals equal the intervals of
        the parameters."""
        slopes = np.stack([self._slope(ESTIMATED[name].quantity(units)) for name in names])
        known = slopes @ self.covariance_of_numbers @ slopes.T
        size = np.sqrt(np.maximum(np.diagonal(known), 1e-300))
        reach = float(student_95(self.freedom)) / NORMAL_95
        wide = reach * np.sqrt(self._spread(slopes)) / size
        return np.asarray(known * wide[:, None] * wide[None, :])

    def _slope(self, quantity: Quantity) -> Floats:
        """Return the derivative of a quantity with respect to each number, (p,)."""
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
        """Return the variance along slopes (Q, p): the larger of those from the information and from the jackknife.

        Unmodelled behaviour shifts the units of similar walls together, and it differs between phases of the motion.
        Similar walls are neighbours. Therefore, neighbouring units and phases are also left out as groups.
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
        between = self.own.variances(slopes) if self.own is not None else 0.0
        return np.asarray(variance + (slopes @ self.open) ** 2 + optima**2 + between)


def with_delay(values: dict[str, float], covariance: Floats) -> tuple[dict[str, float], Floats]:
    """Add a delay of 0 to values and covariance if the logs show no delay, in the order of `ESTIMATED`."""
    if "delay_samples" in values:
        return values, covariance
    complete = {name: values.get(name, 0.0) for name in ESTIMATED if name in values or name == "delay_samples"}
    place = list(complete).index("delay_samples")
    return complete, np.insert(np.insert(covariance, place, 0.0, axis=0), place, 0.0, axis=1)

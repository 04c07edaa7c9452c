"""Simulated truth for the accuracy of the measured branch: devices, trials, and the exact values behind them.

Truth never comes from an estimator: parameters are those that were simulated, costs and limits those of theory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.device_data.devices import find_experiment, load_device
from pipeline.loop.loop import Loop, Normalised
from pipeline.measured.signal.response import Response, find_response
from pipeline.measured.signal.verdict import Verdicts, judge
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.models import Device, Experiment
from pipeline.simulation.setup import Setup, setup_of
from pipeline.simulation.simulate import simulate
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.limits import boundary, stiffness_limit
from pipeline.theory.optimum import optimal_point
from pipeline.theory.poles import spectral_radius
from pipeline.theory.search import OptimalPoint

AREA_POINTS = 20001
"""Points of the integral of the limit over B: trapezoids err by 1e-6, a hundredth of any error that is measured."""

STIFFNESS_SHARES = (0.1, 0.95)
"""Stiffness of the simulated trials relative to the limit at their damping: nearer to it they hardly decay."""

LOWEST_DAMPING = 0.03
"""Virtual damping, relative to the largest stable one, below which no trial is drawn: the limit is near 0 there."""

SLOWEST = 0.999
"""Largest spectral radius of a trial of which parameters are estimated: all but the last percents below the limit."""

SLOWEST_COST = 0.985
"""As `SLOWEST` for costs: after the 380 rows of a Falcon trial 0.3 % of the motion is left."""

USUAL_ROWS = 400
"""Rows of a Falcon's log."""

LONGEST = 20000
"""Samples within which the exact responses have settled: a radius of `SLOWEST_COST` needs 1,000."""


@dataclass(frozen=True)
class Truth:
    """One device as simulated, without jitter of the delay, and its loop.

    Parameters
    ----------
    device : Device
        With this experiment alone.
    experiment : Experiment
    """

    device: Device
    experiment: Experiment

    @cached_property
    def units(self) -> Normalised:
        """Factors between physical and normalised parameters."""
        return Normalised(self.experiment.mass, self.device.sampling_period_s)

    @cached_property
    def loop(self) -> Loop:
        """The ideal loop, whose limits and costs are the truth."""
        e = self.experiment
        return self.units.loop(e.stiffness, e.damping, e.delay_samples)

    def setup(self, *, rows: int | None = None, quantum: float | None = None, noise: float | None = None) -> Setup:
        """Return what is simulated: constant delay, the device's sensor unless it is given here.

        Parameters
        ----------
        rows : int, optional
            Samples of a trial.
        quantum, noise : float, optional
            Sensor quantum and noise [m, rad].
        """
        setup = setup_of(self.device, self.experiment)
        return replace(
            setup,
            jitter_samples=(),
            rows=setup.rows if rows is None else rows,
            quantum=setup.quantum if quantum is None else quantum,
            noise=setup.noise if noise is None else noise,
        )

    def limit(self, damping: Floats) -> Floats:
        """Return the exact limit of stability, at least 0, shape (n,) [N/m, Nm/rad]."""
        found = stiffness_limit(self.loop, np.asarray(damping) / self.units.damping) * self.units.stiffness
        return np.maximum(found, 0.0)

    def area(self, last: float) -> float:
        """Return the area under the limit, K >= 0, from B = 0 to the last damping [N^2 s/m^2, Nm Nms/rad^2]."""
        damping = np.linspace(0.0, min(last, self.largest_damping), AREA_POINTS)
        return float(np.trapezoid(self.limit(damping), damping))

    @cached_property
    def largest_damping(self) -> float:
        """Largest stable virtual damping [Ns/m, Nms/rad]."""
        return boundary(self.loop).beta_max * self.units.damping

    def radius(self, stiffness: Floats, damping: Floats) -> Floats:
        """Return the exact spectral radius of each pair (K, B), shape (n,)."""
        return spectral_radius(self.loop, stiffness / self.units.stiffness, damping / self.units.damping)

    def costs(self, stiffness: Floats, damping: Floats, names: Sequence[str]) -> dict[str, Floats]:
        """Return the exact costs of the sampled, noise-free response by criterion, shape (n,) each.

        Parameters
        ----------
        stiffness, damping : float64, shape (n,)
            Stable pairs K [N/m, Nm/rad] > 0 and B [Ns/m, Nms/rad].
        names : sequence of str
            Criteria without ``_discrete``.
        """
        alpha, beta = stiffness / self.units.stiffness, damping / self.units.damping
        found = point_costs_by_name(self.loop, alpha, beta, [f"{name}_discrete" for name in names], LONGEST)
        return {name: found[f"{name}_discrete"] for name in names}

    def optimum(self, criterion: str) -> OptimalPoint:
        """Return the exact optimum of the sampled response, normalised."""
        return optimal_point(self.loop, f"{criterion}_discrete")


def truth_of(
    device: str,
    experiment: str,
    *,
    mass_factor: float = 1.0,
    damping_factor: float = 1.0,
    delay_samples: float | None = None,
) -> Truth:
    """Return a shipped experiment as the truth, with other parameters where they are given.

    Parameters
    ----------
    device, experiment : str
        Names.
    mass_factor, damping_factor : float
        Of the experiment's mass and viscous damping.
    delay_samples : float, optional
        Constant delay, in place of the experiment's.

    Raises
    ------
    DeviceError
        If there is no such device or experiment.
    """
    known = load_device(device)
    found = find_experiment(known, experiment)
    changed = found.model_copy(
        update={
            "mass": found.mass * mass_factor,
            "damping": found.damping * damping_factor,
            "delay_samples": found.delay_samples if delay_samples is None else delay_samples,
        }
    )
    return Truth(known.model_copy(update={"experiments": (changed,), "tables": ()}), changed)


@dataclass(frozen=True, eq=False)
class Trials:
    """Simulated trials with what every estimator starts from.

    Parameters
    ----------
    truth : Truth
    batch : TrialBatch
    response : Response
    verdicts : Verdicts
    step : int
        Every how many rows of the simulation there is one in the logs.
    """

    truth: Truth
    batch: TrialBatch
    response: Response
    verdicts: Verdicts
    step: int = 1

    def __len__(self) -> int:
        return len(self.batch)

    @classmethod
    def of(cls, truth: Truth, batch: TrialBatch, step: int = 1) -> Trials:
        """Return trials with their response and verdicts."""
        response = find_response(batch)
        return cls(truth, batch, response, judge(batch, response), step)

    @property
    def delay_samples(self) -> int:
        """Integer delay factor, in rows of these logs."""
        return round(self.truth.experiment.delay_samples / self.step)

    def shortened(self, rows: int) -> Trials:
        """Return the trials as if recording had stopped after some rows."""
        b = self.batch
        cut = {name: getattr(b, name)[:, :rows] for name in ("time", "command", "position")}
        return Trials.of(self.truth, replace(b, rows=np.minimum(b.rows, rows), **cut), self.step)

    def thinned(self, step: int) -> Trials:
        """Return the trials as if only every ``step``-th row had been recorded, the row of the edge among them."""
        b = self.batch
        first = int(self.response.edge_row[0]) % step
        cut = {name: getattr(b, name)[:, first::step] for name in ("time", "command", "position")}
        rows = -(-(b.rows - first) // step)
        thin = replace(b, rows=rows, sampling_period_s=b.sampling_period_s * step, **cut)
        return Trials.of(self.truth, thin, self.step * step)


def draw_pairs(truth: Truth, count: int, seed: int, slowest: float = SLOWEST) -> tuple[Floats, Floats]:
    """Return stable pairs (K, B), drawn over the region between the limits, shape (count,) each.

    Parameters
    ----------
    truth : Truth
    count, seed : int
    slowest : float
        Largest spectral radius; pairs beyond it are drawn again.
    """
    random = np.random.default_rng(seed)
    lowest = LOWEST_DAMPING * truth.largest_damping
    stiffness, damping = np.zeros(0), np.zeros(0)
    while len(stiffness) < count:
        B = random.uniform(lowest, truth.largest_damping, 2 * count)
        K = truth.limit(B) * random.uniform(*STIFFNESS_SHARES, 2 * count)
        good = truth.radius(K, B) <= slowest
        stiffness, damping = np.append(stiffness, K[good]), np.append(damping, B[good])
    return stiffness[:count], damping[:count]


def draw_trials(
    truth: Truth,
    count: int,
    *,
    seed: int,
    rows: int | None = None,
    quantum: float | None = None,
    noise: float | None = None,
    slowest: float = SLOWEST,
) -> Trials:
    """Return simulated trials at random pairs (K, B).

    Parameters
    ----------
    truth : Truth
    count, seed : int
        Number of trials; seed of pairs and noise.
    rows, quantum, noise
        As in `Truth.setup`.
    slowest : float
        As in `draw_pairs`.
    """
    K, B = draw_pairs(truth, count, seed, slowest)
    return Trials.of(truth, simulate(truth.setup(rows=rows, quantum=quantum, noise=noise), K, B, seed=seed))


def joined(parts: Sequence[Trials]) -> Trials:
    """Return trials of several truths as one batch; the truth of the first part stands for what they share."""
    names = ("stiffness", "damping", "step", "sampling_period_s", "rows", "time", "command", "position")
    columns = {name: np.concatenate([getattr(part.batch, name) for part in parts]) for name in names}
    count = sum(map(len, parts))
    return Trials.of(parts[0].truth, TrialBatch(tuple(str(i) for i in range(count)), **columns))

"""Estimates and costs from logs. Each method is a row of a table and is compared with the simulated truth.

The logs are those of the Falcon's experiment 1 without jitter, at random stable pairs (K, B). Errors are medians over
trials for estimates, and means for costs. Errors are relative to the true value, with two exceptions. Errors of the
delay are in samples, and errors of the overshoot are fractions of the final displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from pipeline.device.parts import Sensor
from pipeline.device_data.devices import find_experiment, load_device
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.measured.cost import costs
from pipeline.measured.cost.energy import energy_interval
from pipeline.measured.cost.reading_error import ReadingError, gain_at_rest, reading_error, sensor_error, usual_gain
from pipeline.measured.identification.identified import OWN, identified, own_numbers
from pipeline.measured.signal.response import Response, find_response
from pipeline.measured.signal.verdict import Verdict, judge
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.measured.stages.stage_device import recording
from pipeline.measured.thesis import by_momentum, first_change
from pipeline.records.trials import Floats, Trial, Trials
from pipeline.simulation.setup import Setup, setup_of
from pipeline.simulation.simulate import simulate
from pipeline.studies.accuracy.measure import Row, Table, Values, mean, median
from pipeline.studies.accuracy.theory import COSTS
from pipeline.theory.boundary import boundary, stiffness_limit
from pipeline.theory.costs import point_costs_by_name
from pipeline.theory.poles import spectral_radius

DELAY, DELAYS = 4.0, (4.1, 4.3, 4.5, 4.7, 4.9)
"""Delay [samples], and delays of the trials whose delay is estimated.

The delays of the trials are fractional, because the delay of a real controller is not an integer.
"""

USUAL_ROWS, ROWS = 400, (60, 100, 200, 400, 1000)
"""Number of rows of a Falcon log, and of the compared logs. The baseline has 20 of these rows."""

WINDOWS_MS = (5, 10, 15, 30, 80)
"""Windows of the momentum balance [ms]. A delay of 4 samples fills a window of 5 ms."""

QUANTA = (2e-6, 10e-6, 60e-6)
"""Sensor resolutions [m]. The shipped Falcon has 2 um. Encoders of haptic devices have 10 to 60 um."""

SENSOR = Sensor(quantum=2e-6, noise=0.5e-6)
"""Sensor of the shipped Falcon [m]. With other resolutions, the noise is also a quarter of the resolution."""

SLOWEST, SLOWEST_COST = 0.999, 0.985
"""Largest spectral radius of a trial, and of a trial with costs. With the second radius, 0.3 % of the motion remains at
the end of a usual trial."""

LONGEST = 20000
"""Number of samples within which the exact responses settle. A radius of `SLOWEST_COST` needs 1,000."""

DELAY_OF, MASS, DAMPING = (f"{name} of a trial" for name in ("delay", "mass", "damping"))

MODEL, SETTLE, LARGEST, COMPLETE = RECOMMENDED = (
    "likelihood of all trials",
    "band about x₀ + F₀/K",
    "largest reading",
    "bias removed, tail added",
)
"""Methods that `pipeline compare` prefers. The figure highlights them."""


@dataclass(frozen=True, eq=False)
class Logs:
    """Simulated trials with the input of all estimators. ``delay`` (n,) is the true delay [samples]."""

    trials: Trials
    delay: Floats
    responses: tuple[Response, ...]
    verdicts: tuple[Verdict, ...]

    @classmethod
    def of(cls, trials: Trials, delay: Floats) -> Logs:
        """Return trials with their responses and verdicts."""
        responses = tuple(map(find_response, trials))
        return cls(trials, delay, responses, tuple(map(judge, trials, responses)))

    def shortened(self, rows: int) -> Logs:
        """Return the trials as if recording had stopped after ``rows`` rows."""
        return Logs.of(Trials.of(trial.window(0, rows) for trial in self.trials), self.delay)

    @property
    def samples(self) -> int:
        """The delay, rounded to an integer [samples]."""
        return round(float(self.delay[0]))

    @property
    def measured(self) -> Iterator[tuple[Trial, Response, Verdict]]:
        """Yield each trial with its response and verdict."""
        return zip(self.trials, self.responses, self.verdicts, strict=True)


def truth(delay_samples: float = DELAY) -> tuple[Setup, LoopUnits, NormalisedLoop]:
    """Return the simulated device with constant delay, its units, and its loop, which determines the true costs."""
    device = load_device("falcon")
    setup = setup_of(device, find_experiment(device, "1")).with_loop(jitter_samples=(), delay_samples=delay_samples)
    return setup, LoopUnits.of(setup.loop), NormalisedLoop.of(setup.loop)


def drawn(
    count: int, seed: int, rows: int, sensor: Sensor = SENSOR, *, d: float = DELAY, slow: float = SLOWEST
) -> Logs:
    """Return simulated trials with delay d at random stable pairs whose spectral radius is below ``slow``."""
    setup, units, loop = truth(d)
    random, last = np.random.default_rng(seed), boundary(loop).beta_max
    beta = random.uniform(0.03 * last, last, 8 * count)
    alpha = np.maximum(stiffness_limit(loop, beta), 0.0) * random.uniform(0.1, 0.95, 8 * count)
    some = np.flatnonzero(spectral_radius(loop, alpha, beta) <= slow)[:count]
    setup = replace(setup, rows=rows).with_loop(sensor=sensor)
    walls = alpha[some] * units.stiffness, beta[some] * units.damping
    return Logs.of(simulate(setup, *walls, seed=seed), np.full(len(some), d))


def true_costs(logs: Logs) -> Values:
    """Return the exact costs of the sampled, noise-free responses by quantity, shape (n,) each."""
    _, units, loop = truth()
    wall = logs.trials.stiffness / units.stiffness, logs.trials.damping / units.damping
    found = point_costs_by_name(loop, *wall, [f"{name}_discrete" for name in COSTS.values()], LONGEST)
    return {quantity: found[f"{name}_discrete"] for quantity, name in COSTS.items()}


def measured_tables(quick: bool = False) -> Iterator[Table]:
    """Yield tables of the errors of delay, of mass and damping, and of costs.

    A quick run has fewer trials and settings.
    """
    count, lengths = (60, ROWS[1:4]) if quick else (300, ROWS)
    for name, sensor in ((DELAY_OF, SENSOR), (f"{DELAY_OF}, coarse sensor", Sensor(quantum=QUANTA[-1], noise=1e-6))):
        delays = DELAYS[::4] if quick else DELAYS
        parts = [drawn(count // len(delays), i, lengths[-1], sensor, d=d) for i, d in enumerate(delays)]
        trials = Trials.of(trial for part in parts for trial in part.trials)
        yield _delay(name, Logs.of(trials, np.concatenate([part.delay for part in parts])), lengths)
    yield _mass_and_damping(drawn(count, 11, lengths[-1]), lengths)
    logs = drawn(count, 51, lengths[-1], slow=SLOWEST_COST)
    yield _costs("", logs, "{} rows", lengths[1:], logs.shortened)

    def with_quantum(quantum: float) -> Logs:
        return drawn(count, 51, USUAL_ROWS, Sensor(quantum=quantum, noise=quantum / 4), slow=SLOWEST_COST)

    yield _costs(", over sensor resolution", logs, "{:.0e} m", QUANTA, with_quantum)


def _delay(name: str, logs: Logs, lengths: tuple[int, ...]) -> Table:
    usual, words = logs.shortened(USUAL_ROWS), ("{} rows", lengths)

    def by_first_change() -> Values:
        """Return the middle of the sampling period in which the position first changes (6.3)."""
        factor = np.array([first_change(trial, response).delay_samples for trial, response, _ in usual.measured])
        return {name: np.where(factor >= 0, factor + 0.5, np.nan)}

    return Table(
        {name: logs.delay},
        (
            Row("first change (6.2, 6.3)", by_first_change),
            Row(MODEL, lambda of: {name: by_model(of)["delay_samples"]}, *words, given=logs.shortened),
        ),
        *(median, {name: 1.0}, len(logs.delay)),
    )


def by_model(of: Logs) -> Values:
    """Return mass, damping and delay of each trial, by maximum likelihood over all trials with equal delay."""
    values = np.full((len(of.delay), 2 * len(OWN)), np.nan)
    for delay in np.unique(of.delay):
        some = np.flatnonzero(of.delay == delay)
        trials = of.trials.select(some)
        numbers = own_numbers(identified([recording(MeasuredTrial(trial)) for trial in trials]))
        for row, trial in zip(some, trials.trial_id, strict=True):
            values[row] = numbers.get(trial, np.nan)
    return {name: values[:, 2 * place] for place, name in enumerate(OWN)}


def _mass_and_damping(logs: Logs, lengths: tuple[int, ...]) -> Table:
    device, count = truth()[0].loop, len(logs.delay)
    usual = logs.shortened(USUAL_ROWS)

    def momentum(window_ms: float) -> Values:
        balance = partial(by_momentum, delay_samples=usual.samples, window_s=window_ms / 1000)
        return {MASS: np.array([balance(trial, response).mass_momentum for trial, response, _ in usual.measured])}

    def model(of: Logs) -> Values:
        found = by_model(of)
        return {MASS: found["mass"], DAMPING: found["damping"]}

    windows, shortened = ("{} ms", WINDOWS_MS), ("{} rows", lengths)
    return Table(
        {MASS: np.full(count, device.mass), DAMPING: np.full(count, device.damping)},
        (
            Row("momentum balance (6.4)", momentum, *windows, of=(MASS,)),
            Row(MODEL, model, *shortened, given=logs.shortened),
        ),
        median,
        trials=count,
    )


def _costs(
    over: str,
    logs: Logs,
    words: str,
    settings: tuple[Any, ...],
    given: Callable[[Any], Logs],
) -> Table:
    """Return the table of all costs over settings. ``given`` simulates the trials of a setting. Mass and delay are
    assumed to be known."""
    energies, weight, shared = tuple(COSTS)[2:], truth()[0].loop.mass, cache(given)

    def settling(of: Logs) -> list[Floats]:
        return [np.array([costs.settling(*trial, of.samples)["settle_2pct"].value for trial in of.measured])]

    def about_last(of: Logs) -> list[Floats]:
        last = (replace(each, position_final_expected=each.position_final_measured) for each in of.responses)
        return settling(replace(of, responses=tuple(last)))

    def overshoot(of: Logs) -> list[Floats]:
        return [np.array([costs.overshoot(*trial).value for trial in of.measured])]

    def complete(of: Logs) -> list[Floats]:
        inputs = costs.CostInputs(costs.ReadingInputs(of.samples, None, 1.0, 0.0), mass=weight)
        measured = zip(of.measured, reading_errors(of), strict=True)
        return list(np.array([energy_interval(*trial, error, inputs).value for trial, error in measured]).T)

    rows = (
        (SETTLE, settling, ("settling time",)),
        ("band about the last tenth", about_last, ("settling time",)),
        (LARGEST, overshoot, ("overshoot",)),
        ("sum over the whole log", partial(whole_sum, weight=weight), energies),
        (COMPLETE, complete, energies),
    )

    def row(name: str, run: Callable[[Logs], list[Floats]], of: tuple[str, ...]) -> Row:
        quantities = tuple(f"{quantity}{over}" for quantity in of)

        def found(logs: Logs) -> Values:
            return dict(zip(quantities, run(logs), strict=True))

        return Row(name, found, words, settings, given=shared, of=quantities)

    exact = {f"{quantity}{over}": values for quantity, values in true_costs(logs).items()}
    table = [row(*each) for each in rows]
    return Table(exact, table, mean, {f"overshoot{over}": 1.0}, len(logs.delay))


def reading_errors(of: Logs) -> list[ReadingError]:
    """Return the reading error of each trial, from the sensor and the usual gain of all trials."""
    names = ("sensor_noise", "sensor_quantum", "edge_row")
    sensor = sensor_error(*(np.array([getattr(response, name) for response in of.responses]) for name in names))
    logs = [(trial, response, of.samples) for trial, response, _ in of.measured]
    gain = usual_gain(np.array([gain_at_rest(*log, sensor) for log in logs]))
    return [reading_error(*log, sensor=sensor, gain=gain) for log in logs]


def whole_sum(of: Logs, weight: float) -> list[Floats]:
    """Return the discrete energy cost for each weight, summed to the end of the log as in a simple script.

    The sum is k^w [(K/F_0)^2 (x_k - x_inf)^2 + K m/F_0^2 ((x_k - x_{k-1})/T)^2], with k from the command edge plus the
    delay.
    """
    sums = []
    for trial, response, _ in of.measured:
        position = trial.position[response.edge_row + of.samples :]
        k = np.arange(len(position), dtype=np.float64)
        speed = np.diff(position, prepend=position[:1]) / trial.sampling_period_s
        error, K, F = position - response.position_final_expected, trial.stiffness, trial.step
        energy = (K / F * error) ** 2 + K * weight * (speed / F) ** 2
        sums.append([k**w @ energy for w in range(3)])
    return list(np.array(sums).T)

"""Measured costs against those of the noise-free response: over log length, sensor quantum and thinning."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial

import numpy as np

from pipeline.measured.cost import costs
from pipeline.measured.cost.energy import WEIGHTS, energy_interval, energy_terms
from pipeline.measured.cost.reading_error import reading_error
from pipeline.studies.accuracy.ladder import Ladder, Method, Values, mean
from pipeline.studies.accuracy.names import COMPLETE, LARGEST, SETTLE, WHOLE, nth
from pipeline.studies.accuracy.truth import SLOWEST_COST, USUAL_ROWS, Trials, draw_trials, truth_of

CRITERION = "settle_2pct"
"""Settling band of the ladder."""

NAMES = (CRITERION, "overshoot", *(f"energy_step_w{w}" for w in WEIGHTS))
"""Criteria whose exact values the measured ones are held against."""

ROWS = (80, 120, 160, 200, 400, 1000)
"""Rows of a log, 20 of them before the step: 60 samples are two settling times of the optimum."""

QUANTA = (1e-6, 2e-6, 5e-6, 10e-6, 20e-6, 60e-6)
"""Sensor quantum [m]; the shipped Falcon has 2 um, encoders of haptic devices 10 to 60 um."""

NOISE_SHARE = 0.25
"""Noise relative to the quantum, as the shipped Falcon has it."""

THIN = (2, 4)
"""Every how many rows there is one in a thinned log; both divide the delay."""

ENERGIES = tuple(f"energy, w = {w}" for w in WEIGHTS)
QUANTITIES = dict(zip(("settling time", "overshoot", *ENERGIES), NAMES, strict=True))
"""Quantity of a rung, and the criterion that it stands for."""


def settling(of: Trials) -> Values:
    """Return the settling time [samples], with the true delay."""
    return {CRITERION: costs.settling(of.batch, of.response, of.verdicts, of.delay_samples)[CRITERION].value}


def _overshoot(of: Trials) -> Values:
    return {"overshoot": costs.overshoot(of.batch, of.response, of.verdicts).value}


def whole_sum(of: Trials) -> Values:
    """Return the discrete energy cost summed to the end of the log, as a plain script has it, by criterion.

    sum of k^w [(K/F_0)^2 (x_k - x_inf)^2 + K m/F_0^2 ((x_k - x_{k-1})/T)^2], k from the command edge plus the delay.
    """
    b, response = of.batch, of.response
    first = int(response.edge_row[0]) + of.delay_samples
    k = np.arange(b.position.shape[1] - first, dtype=np.float64)
    position = b.position[:, first:]
    error = position - response.position_final_expected[:, None]
    speed = np.diff(position, axis=1, prepend=position[:, :1]) / b.sampling_period_s[:, None]
    stiffness, step = b.stiffness[:, None], b.step[:, None]
    energy = (stiffness / step * error) ** 2 + stiffness * of.truth.experiment.mass * (speed / step) ** 2
    return {f"energy_step_w{w}": np.nansum(k**w * energy, axis=1) for w in WEIGHTS}


def _floor(of: Trials) -> Values:
    terms = energy_terms(of.batch, of.response, of.verdicts, of.delay_samples)
    values = terms.summed(of.truth.experiment.mass)
    return {f"energy_step_w{w}": values[:, w] for w in WEIGHTS}


def complete_energy(of: Trials) -> Values:
    """Return the energies less the bias of noise, with the tail beyond the log, with the true delay and mass."""
    error = reading_error(of.batch, of.response, of.delay_samples)
    found = energy_interval(of.batch, of.response, of.verdicts, error, of.delay_samples, of.truth.experiment.mass)
    return {f"energy_step_w{w}": found.value[:, w] for w in WEIGHTS}


def _thinned(of: Trials) -> Values:
    """All costs of a thinned log, in samples of the controller."""
    found = settling(of) | _overshoot(of) | complete_energy(of)
    powers = {CRITERION: 1, "overshoot": 0} | {f"energy_step_w{w}": w + 1 for w in WEIGHTS}
    return {name: values * float(of.step) ** powers[name] for name, values in found.items()}


METHODS = (
    (("settling time",), SETTLE, settling),
    (("overshoot",), LARGEST, _overshoot),
    (ENERGIES, WHOLE, whole_sum),
    (ENERGIES, "sum down to the sensor's floor", _floor),
    (ENERGIES, COMPLETE, complete_energy),
)
THINNED = ((tuple(QUANTITIES), "thinned log", _thinned),)
"""Methods with the quantities that they give."""


def cost_ladders(quick: bool = False) -> Iterator[Ladder]:
    """Yield the ladders of settling time, overshoot and energies.

    Parameters
    ----------
    quick : bool
        Fewer trials and settings.

    Notes
    -----
    Mass and delay are the true ones: what their errors do to a cost is told by its interval. The error is the mean of
    the trials, relative to the exact cost; for overshoot in parts of the final displacement.
    """
    truth = truth_of("falcon", "1")
    count, longest = (40, USUAL_ROWS) if quick else (300, ROWS[-1])
    trials = draw_trials(truth, count, seed=51, rows=longest, slowest=SLOWEST_COST)
    exact = truth.costs(trials.batch.stiffness, trials.batch.damping, NAMES)

    def with_quantum(quantum: float) -> Trials:
        noise = NOISE_SHARE * quantum
        return draw_trials(truth, count, seed=51, quantum=quantum, noise=noise, slowest=SLOWEST_COST)

    rows = [rows for rows in ROWS if rows <= longest]
    quanta = QUANTA[1::4] if quick else QUANTA
    for rungs, settings, words, given, over in (
        (METHODS, rows, "{} rows".format, trials.shortened, ""),
        (THINNED, THIN, partial(nth, what="row"), trials.shortened(USUAL_ROWS).thinned, ""),
        (METHODS, quanta, _micrometres, with_quantum, ", over the sensor's quantum"),
    ):
        logs = cache(given)
        yield Ladder(
            {f"{quantity}{over}": exact[criterion] for quantity, criterion in QUANTITIES.items()},
            [
                Method(
                    method,
                    partial(_by_quantity, run, over),
                    words,
                    settings,
                    given=logs,
                    quantities=tuple(f"{quantity}{over}" for quantity in quantities),
                )
                for quantities, method, run in rungs
            ],
            mean,
            {f"overshoot{over}": 1.0},
            count,
        )


def _micrometres(metres: float) -> str:
    return f"{1e6 * metres:g} µm"


def _by_quantity(run: Callable[[Trials], Values], over: str, of: Trials) -> Values:
    found = run(of)
    return {f"{name}{over}": found[criterion] for name, criterion in QUANTITIES.items() if criterion in found}

"""Delay, mass and damping of single trials and of experiments: error of every estimator over its settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from pipeline.accuracy_measured.accuracy_measured_rungs import BUDGET, measured_rung, median_error
from pipeline.accuracy_measured.accuracy_measured_truth import USUAL_ROWS, Trials, Truth, draw_trials, joined, truth_of
from pipeline.measured import damping, delay, fit, friction, mass, onset, verdict
from pipeline.measured.combine import combine
from pipeline.measured.fit import Fit
from pipeline.measured.mass import WINDOW_S
from pipeline.measured.onset import WINDOWS, OnsetDelays
from pipeline.measured.stage_columns import BALANCE_TERMS
from pipeline.records.accuracy import Rung, best_time
from pipeline.records.accuracy_measured_advice import (
    BALANCE,
    CORRECTED,
    DECAY,
    FIRST_CHANGE,
    FRICTION,
    LEAST_SQUARES,
    LIMIT,
    MODEL,
    MODEL_THIN,
    ONSET,
    ONSET_FIXED,
    nth,
)
from pipeline.records.batch import Floats, TrialBatch
from pipeline.simulation.simulate import simulate

DELAYS = (4.1, 4.3, 4.5, 4.7, 4.9)
"""Constant delays [samples] of the trials whose delay is estimated: that of a real controller is no whole number."""

COARSE_QUANTUM, COARSE_NOISE = 60e-6, 1e-6
"""Coarse sensor [m]: the quantum of a real haptic encoder that the delay's lateness is known from."""

ROWS = (60, 100, 200, 400, 1000)
"""Rows of a log; 20 of them are the baseline, 400 are the Falcon's."""

QUICK_ROWS = (60, 100, 400)
"""As `ROWS` in a quick run."""

THIN = (2, 4)
"""Every how many rows there is one in a thinned log."""

WINDOWS_S = (0.005, 0.008, 0.010, 0.015, 0.020, 0.030, 0.040, 0.060, 0.080)
"""Windows of the momentum balance [s]; with 5 ms the delay of 4 samples fills it."""

FRICTION_WINDOWS_S = (0.030, 0.060, 0.100, 0.200, 0.380)
"""Windows of the balance with friction [s]: its unknowns need 20 rows at least."""

COUNTS = (10, 30, 100, 300)
"""Trials of an experiment."""

COUNTS_AT_ZERO = (3, 5, 10, 30, 100)
"""Trials at K = 0 of an experiment."""

ZERO_RANGE = 2.0
"""Range of B at K = 0, from 0 to minus this times the damping of the device: the limit lies in its middle."""

EXPERIMENTS, MOST_EXPERIMENTS = 4, 12
"""Experiments of the largest size, and most of any, of which the median error is taken: with 12 it is known to some
30 %, less than what is between two rungs; with four to a factor of two."""


def parameter_rungs(quick: bool = False) -> Iterator[Rung]:
    """Yield the rungs of delay, mass and damping, of single trials first.

    Parameters
    ----------
    quick : bool
        Fewer trials and settings.
    """
    truth = truth_of("falcon", "1")
    delays = DELAYS[::4] if quick else DELAYS
    count, lengths = (60, QUICK_ROWS) if quick else (300, ROWS)
    longest = lengths[-1]
    for name, sensor in (
        ("delay of a trial", {}),
        ("delay of a trial, coarse sensor", {"quantum": COARSE_QUANTUM, "noise": COARSE_NOISE}),
    ):
        trials, true = _of_delays(delays, count // len(delays), 1, rows=longest, **sensor)
        yield from _delay_of_a_trial(name, trials, true, lengths, quick)
    yield from _of_a_trial(draw_trials(truth, count, seed=11, rows=longest), lengths, quick)
    counts = COUNTS[:2] if quick else COUNTS
    yield from _delay_of_an_experiment(*_of_delays(delays, counts[-1], 21), counts)
    yield from _of_an_experiment(draw_trials(truth, EXPERIMENTS * counts[-1], seed=31), counts)
    yield from _damping_at_zero_stiffness(truth, COUNTS_AT_ZERO[:3] if quick else COUNTS_AT_ZERO)


def _of_delays(delays: tuple[float, ...], count: int, seed: int, **sensor: float) -> tuple[Trials, Floats]:
    """Trials of several constant delays, so many of each, and the delay of each trial [samples]."""
    truths = [truth_of("falcon", "1", delay_samples=d) for d in delays]
    parts = [draw_trials(truth, count, seed=seed + i, **sensor) for i, truth in enumerate(truths)]  # type: ignore[arg-type]
    return joined(parts), np.repeat(delays, count)


def _fit(trials: Trials) -> Fit:
    return fit.fit_trials(trials.batch, trials.response)


def _first_change(of: Trials) -> Floats:
    """Middle of the period in which the position changes first (6.3) [samples]."""
    found = delay.first_change(of.batch, of.response).delay_samples
    return np.where(found >= 0, found + 0.5, np.nan)


def _onset(of: Trials, windows: tuple[int, ...] = WINDOWS) -> OnsetDelays:
    return onset.motion_onset(of.batch, of.response, delay.first_change(of.batch, of.response), windows=windows)


def _delay_of_a_trial(name: str, trials: Trials, true: Floats, lengths: tuple[int, ...], quick: bool) -> Iterator[Rung]:
    logs = trials.shortened(USUAL_ROWS)
    one = partial(measured_rung, name, trials=len(trials))
    yield one(FIRST_CHANGE, "one setting", partial(_first_change, logs), lambda found: found - true)
    for window in WINDOWS[::3] if quick else WINDOWS:
        yield one(ONSET_FIXED, f"{window} rows", partial(_onset, logs, (window,)), lambda f: f.delay_samples - true)
    yield one(ONSET, "one setting", partial(_onset, logs), lambda f: f.delay_samples - true)
    for rows in lengths:
        yield one(MODEL, f"{rows} rows", partial(_fit, trials.shortened(rows)), lambda f: f.delay - true)
    for step in THIN:
        thin = logs.thinned(step)
        yield one(MODEL_THIN, nth(step, "row"), partial(_fit, thin), partial(_in_samples_of_controller, thin, true))


def _in_samples_of_controller(of: Trials, true: Floats, found: Fit) -> Floats:
    return found.delay * of.step - true


def _of_a_trial(trials: Trials, lengths: tuple[int, ...], quick: bool) -> Iterator[Rung]:
    m, b = trials.truth.experiment.mass, trials.truth.experiment.damping
    logs, count = trials.shortened(USUAL_ROWS), len(trials)
    weight = partial(measured_rung, "mass of a trial", trials=count)
    viscous = partial(measured_rung, "damping of a trial", trials=count)

    def momentum(window: float) -> mass.Masses:
        return mass.by_momentum(logs.batch, logs.response, logs.delay_samples, window_s=window)

    def with_friction(window: float) -> friction.BalanceFit:
        return friction.fit_balance(
            logs.batch, logs.response, logs.delay_samples, terms=BALANCE_TERMS, window_s=(0.0, window)
        )

    def least_squares(of: Trials) -> damping.TrialDamping:
        return damping.from_trials(of.batch, of.response, of.delay_samples)

    for window in WINDOWS_S[::3] if quick else WINDOWS_S:
        run, setting = partial(momentum, window), f"{1000 * window:g} ms"
        yield weight(BALANCE, setting, run, lambda f: f.mass_momentum / m - 1)
        yield weight(CORRECTED, setting, run, lambda f: mass.correct(f, b) / m - 1)
    for window in FRICTION_WINDOWS_S:
        fitted, setting = partial(with_friction, window), f"{1000 * window:g} ms"
        yield weight(FRICTION, setting, fitted, lambda f: f.mass / m - 1)
        yield viscous(FRICTION, setting, fitted, lambda f: f.coefficients[:, 0] / b - 1)
    for rows in lengths:
        cut = trials.shortened(rows)
        yield viscous(LEAST_SQUARES, f"{rows} rows", partial(least_squares, cut), lambda f: f.viscous_damping / b - 1)
        yield from _by_model(weight, viscous, MODEL, f"{rows} rows", cut)
    for step in THIN:
        yield from _by_model(weight, viscous, MODEL_THIN, nth(step, "row"), logs.thinned(step))


def _by_model(
    weight: Callable[..., Rung], viscous: Callable[..., Rung], method: str, setting: str, of: Trials
) -> Iterator[Rung]:
    m, b = of.truth.experiment.mass, of.truth.experiment.damping
    found, seconds = best_time(partial(_fit, of), BUDGET)
    # one fit gives both: each rung bears its whole time
    for one, error in ((weight, found.mass / m - 1), (viscous, found.damping / b - 1)):
        rung = one(method, setting, lambda: None, lambda _, error=error: error)
        yield rung.model_copy(update={"seconds": seconds / len(of)})


def _delay_of_an_experiment(pool: Trials, true: Floats, counts: tuple[int, ...]) -> Iterator[Rung]:
    over = partial(_over_counts, "delay of an experiment", pool, true, counts)
    first, seconds = best_time(partial(_first_change, pool), BUDGET)
    yield from over(FIRST_CHANGE, first, None, seconds, relative=False)
    began, seconds = best_time(partial(_onset, pool), BUDGET)
    yield from over(ONSET, began.delay_samples, began.standard_error, seconds, relative=False)
    model, seconds = best_time(partial(_fit, pool), BUDGET)
    yield from over(MODEL, model.delay, model.delay_error, seconds, relative=False)


def _of_an_experiment(pool: Trials, counts: tuple[int, ...]) -> Iterator[Rung]:
    batch, response, samples = pool.batch, pool.response, pool.delay_samples
    m, b = (np.full(len(pool), value) for value in (pool.truth.experiment.mass, pool.truth.experiment.damping))
    weight = partial(_over_counts, "mass of an experiment", pool, m, counts)
    viscous = partial(_over_counts, "damping of an experiment", pool, b, counts)
    window = f"{1000 * WINDOW_S:g} ms"
    momentum, seconds = best_time(lambda: mass.by_momentum(batch, response, samples), BUDGET)
    yield from weight(f"{BALANCE}, {window}", momentum.mass_momentum, None, seconds)
    yield from weight(f"{CORRECTED}, {window}", mass.correct(momentum, b), None, seconds)
    balance, seconds = best_time(lambda: friction.fit_balance(batch, response, samples, terms=BALANCE_TERMS), BUDGET)
    yield from weight(FRICTION, balance.mass, balance.mass_error, seconds)
    model, model_seconds = best_time(partial(_fit, pool), BUDGET)
    yield from weight(MODEL, model.mass, model.mass_error, model_seconds)
    squares, seconds = best_time(lambda: damping.from_trials(batch, response, samples), BUDGET)
    yield from viscous(LEAST_SQUARES, squares.viscous_damping, None, seconds)
    yield from viscous(MODEL, model.damping, model.damping_error, model_seconds)


def _over_counts(
    quantity: str,
    pool: Trials,
    true: Floats,
    counts: tuple[int, ...],
    method: str,
    values: Floats,
    errors: Floats | None,
    seconds: float,
    *,
    relative: bool = True,
) -> Iterator[Rung]:
    """Rungs of experiments of so many trials, which share no trial with each other.

    Trials with errors of their own are combined as the package does it, others by their median, as in the thesis.
    ``seconds`` is the run time of all trials; trials of one truth are a multiple of the largest count.
    """
    for count in counts:
        # spread over the pool, so that all truths are among them
        blocks = np.unique(np.linspace(0, len(pool) // count - 1, MOST_EXPERIMENTS).astype(np.int64))
        found = []
        for part in (slice(at * count, (at + 1) * count) for at in blocks.tolist()):
            value = _one_value(values[part], None if errors is None else errors[part], pool.batch.trial_id[part])
            found.append((value - true[part][0]) / (true[part][0] if relative else 1.0))
        error, missing = median_error(np.array(found))
        yield Rung(
            quantity=quantity,
            method=method,
            setting=f"{count} trials",
            error=error,
            seconds=seconds / len(pool) * count,
            missing=missing,
            trials=count,
        )


def _one_value(values: Floats, errors: Floats | None, names: tuple[str, ...]) -> float:
    if errors is not None:
        value = combine(values, errors, names, "", "", "none").value
        return np.nan if value is None else value
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _damping_at_zero_stiffness(truth: Truth, counts: tuple[int, ...]) -> Iterator[Rung]:
    """Damping of an experiment by its trials at K = 0, which lie evenly on both sides of the limit."""
    e, period = truth.experiment, truth.device.sampling_period_s
    random = np.random.default_rng(41)
    for count in counts:
        batches = []
        for seed in range(MOST_EXPERIMENTS):
            # a random shift: a trial exactly at the limit would be luck
            B = -ZERO_RANGE * e.damping * (np.arange(count) + random.uniform()) / count
            batches.append(simulate(truth.setup(), np.zeros(count), B, seed=seed))

        def run(method: str, batches: list[TrialBatch] = batches) -> list[float | None]:
            values: list[float | None] = []
            for batch in batches:
                growth = verdict.judge(batch).growth_per_s
                if method == LIMIT:
                    values.append(damping.by_limit(batch.damping, batch.stiffness, growth).value)
                    continue
                found = damping.by_decay(
                    *(batch.damping, batch.stiffness, growth, e.mass),
                    delay_samples=e.delay_samples,
                    sampling_period_s=period,
                )
                values.append(found.value)
            return values

        def error(values: list[float | None]) -> Floats:
            return np.array([np.nan if v is None else v / e.damping - 1 for v in values])

        for method in (LIMIT, DECAY):
            rung = measured_rung(
                *("damping of an experiment", method, f"{count} trials at K = 0", partial(run, method), error),
                trials=MOST_EXPERIMENTS,
            )
            yield rung.model_copy(update={"trials": count})

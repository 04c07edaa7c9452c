"""Delay, mass and damping of single trials and of experiments: every estimator over its settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial

import numpy as np

from pipeline.measured.device import damping, delay, friction, mass, onset
from pipeline.measured.device.mass import WINDOW_S
from pipeline.measured.device.onset import WINDOWS, OnsetDelays
from pipeline.measured.experiment.combine import combine
from pipeline.measured.fit import fit
from pipeline.measured.signal import verdict
from pipeline.measured.stages.stage_rows import BALANCE_TERMS
from pipeline.records.accuracy import Rung
from pipeline.records.batch import Floats, TrialBatch
from pipeline.simulation.simulate import simulate
from pipeline.studies.accuracy import names
from pipeline.studies.accuracy.ladder import BUDGET, Ladder, Method, Values, best_time, median
from pipeline.studies.accuracy.truth import USUAL_ROWS, Trials, Truth, draw_trials, joined, truth_of

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

WINDOWS_MS = (5, 8, 10, 15, 20, 30, 40, 60, 80)
"""Windows of the momentum balance [ms]; with 5 ms the delay of 4 samples fills it."""

FRICTION_WINDOWS_MS = (30, 60, 100, 200, 380)
"""Windows of the balance with friction [ms]: its unknowns need 20 rows at least."""

COUNTS = (10, 30, 100, 300)
"""Trials of an experiment."""

COUNTS_AT_ZERO = (3, 5, 10, 30, 100)
"""Trials at K = 0 of an experiment."""

ZERO_RANGE = 2.0
"""Range of B at K = 0, from 0 to minus this times the damping of the device: the limit lies in its middle."""

EXPERIMENTS, MOST_EXPERIMENTS = 4, 12
"""Experiments of the largest size, and most of any, of which the median error is taken: with 12 it is known to some
30 %, less than what is between two rungs; with four to a factor of two."""


MASS, DAMPING = "mass of a trial", "damping of a trial"
_ROWS, _MILLISECONDS = "{} rows", "{:g} ms"

Estimates = dict[str, tuple[Floats, Floats | None]]
"""Values of trials by quantity and, where the method tells them, their standard errors."""


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
    coarse = {"quantum": COARSE_QUANTUM, "noise": COARSE_NOISE}
    for name, sensor in (("delay of a trial", {}), ("delay of a trial, coarse sensor", coarse)):
        trials, true = _of_delays(delays, count // len(delays), 1, rows=lengths[-1], **sensor)
        yield from _delay_of_a_trial(name, trials, true, lengths).rungs(quick, BUDGET)
    yield from _of_a_trial(draw_trials(truth, count, seed=11, rows=lengths[-1]), lengths).rungs(quick, BUDGET)
    counts = COUNTS[:2] if quick else COUNTS
    yield from _delay_of_an_experiment(*_of_delays(delays, counts[-1], 21), counts)
    yield from _of_an_experiment(draw_trials(truth, EXPERIMENTS * counts[-1], seed=31), counts)
    for ladder in _damping_at_zero_stiffness(truth, quick):
        yield from ladder.rungs(quick, BUDGET)


def _of_delays(delays: tuple[float, ...], count: int, seed: int, **sensor: float) -> tuple[Trials, Floats]:
    """Trials of several constant delays, so many of each, and the delay of each trial [samples]."""
    truths = [truth_of("falcon", "1", delay_samples=d) for d in delays]
    parts = [draw_trials(truth, count, seed=seed + i, **sensor) for i, truth in enumerate(truths)]  # type: ignore[arg-type]
    return joined(parts), np.repeat(delays, count)


def _fit(of: Trials) -> fit.Fit:
    return fit.fit_trials(of.batch, of.response)


def _first_change(of: Trials) -> Floats:
    """Middle of the period in which the position changes first (6.3) [samples]."""
    found = delay.first_change(of.batch, of.response).delay_samples
    return np.where(found >= 0, found + 0.5, np.nan)


def _onset(of: Trials, windows: tuple[int, ...] = WINDOWS) -> OnsetDelays:
    return onset.motion_onset(of.batch, of.response, delay.first_change(of.batch, of.response), windows=windows)


def _delay_of_a_trial(name: str, trials: Trials, true: Floats, lengths: tuple[int, ...]) -> Ladder:
    logs = trials.shortened(USUAL_ROWS)

    def fixed(window: int) -> Values:
        return {name: _onset(logs, (window,)).delay_samples}

    def model(of: Trials) -> Values:
        return {name: _fit(of).delay * of.step}

    return Ladder(
        {name: true},
        (
            Method(names.FIRST_CHANGE, lambda: {name: _first_change(logs)}),
            Method("onset of motion, fixed window", fixed, _ROWS, WINDOWS, WINDOWS[::3]),
            Method(names.ONSET, lambda: {name: _onset(logs).delay_samples}),
            Method(names.MODEL, model, _ROWS, lengths, given=trials.shortened),
            Method(names.MODEL_THIN, model, partial(names.nth, what="row"), THIN, given=logs.thinned),
        ),
        median,
        {name: 1.0},
        len(trials),
    )


def _of_a_trial(trials: Trials, lengths: tuple[int, ...]) -> Ladder:
    m, b = trials.truth.experiment.mass, trials.truth.experiment.damping
    logs, shortened = trials.shortened(USUAL_ROWS), cache(trials.shortened)
    of_logs = logs.batch, logs.response, logs.delay_samples

    def momentum(window_ms: float) -> mass.Masses:
        return mass.by_momentum(*of_logs, window_s=window_ms / 1000)

    def with_friction(window_ms: float) -> Values:
        found = friction.fit_balance(*of_logs, terms=BALANCE_TERMS, window_s=(0.0, window_ms / 1000))
        return {MASS: found.mass, DAMPING: found.coefficients[:, 0]}

    def least_squares(of: Trials) -> Values:
        return {DAMPING: damping.from_trials(of.batch, of.response, of.delay_samples).viscous_damping}

    def model(of: Trials) -> Values:
        found = _fit(of)
        return {MASS: found.mass, DAMPING: found.damping}

    windows = _MILLISECONDS, WINDOWS_MS, WINDOWS_MS[::3]
    return Ladder(
        {MASS: m, DAMPING: b},
        (
            Method(names.BALANCE, lambda w: {MASS: momentum(w).mass_momentum}, *windows, quantities=(MASS,)),
            Method(names.CORRECTED, lambda w: {MASS: mass.correct(momentum(w), b)}, *windows, quantities=(MASS,)),
            Method(names.FRICTION, with_friction, _MILLISECONDS, FRICTION_WINDOWS_MS),
            Method(names.LEAST_SQUARES, least_squares, _ROWS, lengths, given=shortened, quantities=(DAMPING,)),
            Method(names.MODEL, model, _ROWS, lengths, given=shortened),
            Method(names.MODEL_THIN, model, partial(names.nth, what="row"), THIN, given=logs.thinned),
        ),
        median,
        trials=len(trials),
    )


def _delay_of_an_experiment(pool: Trials, true: Floats, counts: tuple[int, ...]) -> Iterator[Rung]:
    name = "delay of an experiment"
    estimators: dict[str, Callable[[], Estimates]] = {
        names.FIRST_CHANGE: lambda: {name: (_first_change(pool), None)},
        names.ONSET: lambda: _told(_onset(pool), {name: ("delay_samples", "standard_error")}),
        names.MODEL: lambda: _told(_fit(pool), {name: ("delay", "delay_error")}),
    }
    return _over_counts(pool, {name: true}, counts, estimators, relative=False)


def _told(found: object, fields: Mapping[str, tuple[str, str]]) -> Estimates:
    """Values and standard errors that a method's result has under these names, by quantity."""
    return {quantity: (getattr(found, value), getattr(found, error)) for quantity, (value, error) in fields.items()}


def _of_an_experiment(pool: Trials, counts: tuple[int, ...]) -> Iterator[Rung]:
    weight, viscous = "mass of an experiment", "damping of an experiment"
    of_pool = pool.batch, pool.response, pool.delay_samples
    true = {weight: np.full(len(pool), pool.truth.experiment.mass)}
    true[viscous] = np.full(len(pool), pool.truth.experiment.damping)

    def momentum() -> mass.Masses:
        return mass.by_momentum(*of_pool)

    def balance() -> friction.BalanceFit:
        return friction.fit_balance(*of_pool, terms=BALANCE_TERMS)

    window = f"{1000 * WINDOW_S:g} ms"
    of_mass, of_damping = {weight: ("mass", "mass_error")}, {viscous: ("damping", "damping_error")}
    estimators: dict[str, Callable[[], Estimates]] = {
        f"{names.BALANCE}, {window}": lambda: {weight: (momentum().mass_momentum, None)},
        f"{names.CORRECTED}, {window}": lambda: {weight: (mass.correct(momentum(), true[viscous]), None)},
        names.FRICTION: lambda: _told(balance(), of_mass),
        names.LEAST_SQUARES: lambda: {viscous: (damping.from_trials(*of_pool).viscous_damping, None)},
        names.MODEL: lambda: _told(_fit(pool), of_mass | of_damping),
    }
    return _over_counts(pool, true, counts, estimators)


def _over_counts(
    pool: Trials,
    true: Mapping[str, Floats],
    counts: tuple[int, ...],
    estimators: Mapping[str, Callable[[], Estimates]],
    *,
    relative: bool = True,
) -> Iterator[Rung]:
    """Rungs of experiments of so many trials, which share no trial with each other.

    Trials with errors of their own are combined as the package does it, others by their median, as in the thesis.
    Trials of one truth are a multiple of the largest count.
    """
    for method, run in estimators.items():
        found, seconds = best_time(run, BUDGET)
        for quantity, estimate in found.items():
            for count in counts:
                parts = _experiments(len(pool), count)
                values = np.array([_one_value(*estimate, pool.batch.trial_id, part) for part in parts])
                exact = true[quantity][[part.start for part in parts]]
                error, missing = median((values - exact) / (exact if relative else 1.0))
                yield Rung(
                    quantity=quantity,
                    method=method,
                    setting=f"{count} trials",
                    error=error,
                    seconds=seconds / len(pool) * count,
                    missing=missing,
                    trials=count,
                )


def _experiments(pool: int, count: int) -> list[slice]:
    """Trials of each experiment, spread over the pool so that all truths are among them."""
    blocks = np.unique(np.linspace(0, pool // count - 1, MOST_EXPERIMENTS).astype(np.int64))
    return [slice(at * count, (at + 1) * count) for at in blocks.tolist()]


def _one_value(values: Floats, errors: Floats | None, names: tuple[str, ...], part: slice) -> float:
    if errors is not None:
        value = combine(values[part], errors[part], names[part], "", "", "none").value
        return np.nan if value is None else value
    known = values[part][np.isfinite(values[part])]
    return float(np.median(known)) if len(known) else np.nan


def _damping_at_zero_stiffness(truth: Truth, quick: bool) -> Iterator[Ladder]:
    """Damping of an experiment by its trials at K = 0, which lie evenly on both sides of the limit."""
    e, period = truth.experiment, truth.device.sampling_period_s
    random = np.random.default_rng(41)
    for count in COUNTS_AT_ZERO[:3] if quick else COUNTS_AT_ZERO:
        # a random shift: a trial exactly at the limit would be luck
        shifted = [np.arange(count) + random.uniform() for _ in range(MOST_EXPERIMENTS)]
        walls = [-ZERO_RANGE * e.damping * at / count for at in shifted]
        batches = [simulate(truth.setup(), np.zeros(count), B, seed=seed) for seed, B in enumerate(walls)]

        def by_limit(batch: TrialBatch) -> float | None:
            growth = verdict.judge(batch).growth_per_s
            return damping.by_limit(batch.damping, batch.stiffness, growth).value

        def by_decay(batch: TrialBatch) -> float | None:
            walls = batch.damping, batch.stiffness, verdict.judge(batch).growth_per_s
            return damping.by_decay(*walls, e.mass, delay_samples=e.delay_samples, sampling_period_s=period).value

        def values(of: Callable[[TrialBatch], float | None], batches: list[TrialBatch] = batches) -> Values:
            return {"damping of an experiment": np.array([of(batch) for batch in batches], dtype=np.float64)}

        methods = (("limit at K = 0 (6.1.2)", by_limit), ("decay at K = 0", by_decay))
        yield Ladder(
            {"damping of an experiment": e.damping},
            [Method(name, partial(values, of), f"{count} trials at K = 0") for name, of in methods],
            median,
            trials=MOST_EXPERIMENTS,
            counted=count,
        )

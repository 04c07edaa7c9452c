"""The trials of a comparison for the interactive part of its report.

Every trial is a point, and the most relevant trials have their response.

A page with all responses of 11,000 trials would have 8 MB. Therefore, every trial has stiffness, damping, verdict,
outcome and costs, but the total number of response samples is limited. The responses of the optima are added first.
Then, trials at the stability boundary alternate with trials of an increasingly fine grid over the plane. The loss due
to coding is invisible, because rounding moves a line by a quarter of a pixel, and rows are omitted only if several
share a column of pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.json_object import JsonObject
from pipeline.comparison.loops.loop_basis import identified_device
from pipeline.comparison.loops.wall_replay import usual_trial
from pipeline.comparison.scene.scene import StoredData, needed_stages
from pipeline.device.loop import Loop
from pipeline.device.parameters import unit_of
from pipeline.measured.signal.outcome import OUTCOMES
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.loop_limits import StepTrial, simulate_behind
from pipeline.records.criteria import CRITERIA, criterion_of
from pipeline.records.results import ExperimentNumbers
from pipeline.records.trials import Floats, Integers, Trial
from pipeline.rendering.figures.boundaries import by_theory, measured
from pipeline.rendering.figures.drawing import few_digits
from pipeline.rendering.labels import UNITS, cost_text, criterion_label, printed_scale, significant
from pipeline.rendering.report.report import pack
from pipeline.rendering.tables.trial_links import TrialPage
from pipeline.theory.predictions import Theory

SAMPLES = 200_000
"""Number of response samples in a report, about 280 kB. A report on all thesis experiments has less than 2 MB."""

PORTION = 64
"""Number of responses prepared together. Simulating a single response takes about as long as simulating this many."""

COST_DIGITS = 3
"""Digits of a cost in the plane. A trial with a response shows the cost as printed in the tables."""

EDGE_TURNS = 3
"""Number of boundary trials for each grid trial. The tables name all boundary trials."""

FINEST_GRID = 64
"""Number of cells along each axis of the finest grid. Experiments have fewer dampings."""

VERDICTS = ("stable", "unstable", "undecided")

LEVELS = 500
"""Number of steps into which the range of a response is divided. In a plot 250 pixels high, half a step is a quarter of
a pixel."""

COLUMNS, WHOLE = 700, 30
"""Number of pixel columns of the plot, and number of samples after the command edge that are all kept.

The kept samples show delay and onset.
"""

LAGS = (1, 2, 3, 4)
"""Lags of the samples that predict a sample. They suffice for two oscillations, or for one with drift and offset. More
lags save nothing."""

PARTS = 4096
"""Denominator of the coefficients. It is a power of two, so that a browser divides exactly."""


def trial_page(
    data: StoredData, results: Sequence[ExperimentNumbers], theories: Mapping[str, Theory], *, full: bool = False
) -> TrialPage:
    """Collect the trials of all experiments in the order of ``data``. With ``full``, all have their response."""
    criteria, modelled = data.scene.criteria, "model" in needed_stages(data)
    share = None if full else SAMPLES // len(results)
    gathered = [
        _Experiment(number, stages, result, theories.get(stages.experiment), criteria, modelled)
        for number, (stages, result) in enumerate(zip(data.experiments, results, strict=True))
    ]
    first = next((c for c in criteria if criterion_of(c).tabled), criteria[0])
    experiments = [e.content(share) for e in gathered]
    content = {
        "units": {"stiffness": data.units.stiffness, "damping": data.units.damping},
        "position": unit_of("length", data.motion),
        "verdicts": VERDICTS,
        "outcomes": [name.replace("_", " ") for name in OUTCOMES],
        "criteria": [
            {
                "name": c,
                "label": criterion_label(c),
                "unit": criterion_of(c).family.printed_unit,
                "band": criterion_of(c).band,
                "first": c == first,
            }
            for c in criteria
        ],
        "experiments": experiments,
    }
    return TrialPage(
        content=content,
        trials=sum(len(e.verdict) for e in gathered),
        responses=sum(e["shown"] for e in experiments),
        places={(e.name, trial): place for e in gathered for trial, place in e.places().items()},
        limits={(e.name, *point): reference(e.number, row) for e in gathered for point, row in e.boundary().items()},
    )


def reference(experiment: int, trial: int) -> str:
    """Return the reference with which cells and addresses refer to a trial.

    It consists of the numbers of the experiment and of the trial in the page, counted from 0.
    """
    return f"{experiment}-{trial}"


@dataclass
class _Experiment:
    """Content of the page for an experiment. Rows are those of its stages."""

    number: int
    stages: ExperimentStages
    result: ExperimentNumbers
    theory: Theory | None
    criteria: tuple[str, ...]
    modelled: bool

    def __post_init__(self) -> None:
        self.name = self.stages.experiment
        self.stiffness = self.stages.column("response", "stiffness")
        self.damping = self.stages.column("response", "damping")
        self.verdict = self.stages.verdicts.verdict
        self.ids = self.stages.texts("response", "trial_id")
        self.costs = {c: self.stages.cost(c)[0] for c in self.criteria}
        nothing = np.full(len(self.ids), np.nan)
        self.model = {
            name: self.stages.column("model", f"model_{name}") if self.modelled else nothing
            for name in ("mass", "damping", "delay")
        }

    def content(self, share: int | None) -> JsonObject:
        """Return the page content of the experiment, with responses of at most ``share`` samples in total."""
        limits = {s.kind: s for s in measured(self.result.boundary, "", None)}
        line, bound = limits["measured"], limits.get("bound")
        known = np.isfinite(line.x).any()
        theory = by_theory(self.theory, "") if self.theory else None
        columns: JsonObject = {
            "k": _numbers(self.stiffness, 6),
            "b": _numbers(self.damping, 6),
            "v": "".join(str(VERDICTS.index(v)) for v in self.verdict.tolist()),
            "o": "".join(str(OUTCOMES.index(o)) for o in self.stages.texts("outcome", "outcome")),
            "c": [_numbers(self.costs[c] * printed_scale(c), COST_DIGITS) for c in self.criteria],
            "measured": [_numbers(line.x, 4), _numbers(line.y, 4)] if known else [[], []],
            "open": [_numbers(bound.x, 4), _numbers(bound.y, 4)] if bound else [[], []],
            "theory": [_numbers(theory.x, 4), _numbers(theory.y, 4)] if theory else None,
        }
        delay, entries = self.result.estimates["delay_samples"].value, list(self._responses(share))
        return {
            "name": self.name,
            "trials": len(self.verdict),
            "shown": len(entries),
            "period": self.stages.sampling_period_s,
            "delay": None if delay is None else int(delay),
            "columns": pack(columns),
            "responses": pack(entries),
        }

    def places(self) -> dict[str, str]:
        """Return the references of the trials that tables name."""
        named = {str(best.trial_id) for best in self.result.optimum.values()}
        named |= {self.result.use.point.trial_id} if self.result.use else set()
        return {trial: reference(self.number, row) for row, trial in enumerate(self.ids) if trial in named}

    def boundary(self) -> dict[tuple[float, float], int]:
        """Return the rows of the trials at the boundary, by damping and stiffness."""
        rows = zip(self.damping.tolist(), self.stiffness.tolist(), self.verdict.tolist(), strict=True)
        first: dict[tuple[float, float, str], int] = {}
        for row, key in enumerate(rows):
            first.setdefault(key, row)
        ends = (
            (point.damping, stiffness, verdict)
            for point in self.result.boundary
            for stiffness, verdict in ((point.stable, "stable"), (point.unstable, "unstable"))
            if stiffness is not None
        )
        return {key[:2]: first[key] for key in ends if key in first}

    def _responses(self, share: int | None) -> Iterator[JsonObject]:
        order, taken = self._order(), 0
        for first in range(0, len(order), PORTION):
            for entry in self._entries(order[first : first + PORTION].tolist()):
                taken += len(entry["x"]["r"]) if entry["x"] else 0
                if share is not None and taken > share:
                    return
                yield entry

    def _order(self) -> Integers:
        """Return all rows, the most relevant ones first."""
        place = {trial: row for row, trial in enumerate(self.ids)}
        use = [self.result.use.point.trial_id] if self.result.use else []
        best = [place[str(name)] for name in [*use, *(o.trial_id for o in self.result.optimum.values())]]
        edge = np.array(list(self.boundary().values()), dtype=np.int64)
        edge = edge[_spread(len(edge))]
        grid = _coarse_to_fine(self.stiffness, self.damping)
        turn = np.concatenate([np.arange(len(edge)) // EDGE_TURNS, np.arange(len(grid)) + 0.5])
        both = np.concatenate([edge, grid])[np.argsort(turn, kind="stable")]
        return _each_once(np.concatenate([np.array(best, dtype=np.int64), both]))

    def _entries(self, rows: Sequence[int]) -> list[JsonObject]:
        """Return the responses of the given trials."""
        measured = [MeasuredTrial(self.stages.samples[row]) for row in rows]
        device, alone = self.stages.once(identified_device) if self.modelled else None, {}
        if device is not None:
            usual = replace(usual_trial(self.result, self.stages), quantum=0.0, jitter=0.0)
            alone = _alone(device.loop, measured, usual)
        return [self._entry(row, measured[place], alone.get(place)) for place, row in enumerate(rows)]

    def _entry(self, row: int, of: MeasuredTrial, alone: Floats | None) -> JsonObject:
        """Return the response of a trial, with the response of the device without a wall from the command edge
        onward."""
        trial, response, ghost = of.logged, of.response, np.full(of.logged.rows, np.nan)
        edge = max(response.edge_row, 0)
        if alone is not None:
            ghost[:edge] = 0.0
            ghost[edge : edge + len(alone)] = alone
        final = response.position_final_expected - response.position_start
        model = {name: float(values[row]) for name, values in self.model.items()}
        return {
            "i": row,
            **_signals(trial.displacement, ghost, edge, response.sensor_quantum),
            **({} if np.isnan(final) else {"f": few_digits(final, 6)}),
            **self._texts(row, model),
        }

    def _texts(self, row: int, model: Mapping[str, float]) -> JsonObject:
        """Return the texts of a trial.

        These are its id, verdict, evidence and model, and its costs with intervals or reasons for missing costs.
        """
        units = UNITS[self.stages.motion]
        names = (("m", "mass", units.mass), ("b", "damping", units.damping), ("d", "delay", "samples"))
        fitted = (f"{symbol} = {significant(model[name], 3)} {unit}" for symbol, name, unit in names)
        texts = {
            "id": self.ids[row],
            "why": self.stages.text("response", "reason", row),
            "evidence": self.stages.text("outcome", "evidence", row).replace("+-", "±"),
            "model": ", ".join(fitted) if np.isfinite(model["mass"]) else "",
            "costs": [self._cost_text(criterion, row) for criterion in self.criteria],
        }
        return {name: text for name, text in texts.items() if text}

    def _cost_text(self, criterion: str, row: int) -> str:
        cost = float(self.costs[criterion][row])
        if np.isnan(cost):
            reasons = self.stages.cost_reasons(criterion)[row]
            return f"none: {reason_of(criterion, reasons) or 'only stable trials have one'}"
        text, ends = cost_text(criterion, cost), [float(end[row]) for end in self.stages.cost_interval(criterion)]
        interval = "" if np.isnan(ends).any() else " to ".join(cost_text(criterion, end) for end in ends)
        return f"{text} ({interval})" if interval not in ("", f"{text} to {text}") else text


def _alone(loop: Loop, measured: Sequence[MeasuredTrial], usual: StepTrial) -> dict[int, Floats]:
    """Return the motion [m, rad] of the device without a wall from the command edge onward, by index of the trial.

    Trials without a step are omitted. The motion of a linear device is proportional to the step, but not with friction
    or a constant force.
    """
    linear = not (loop.friction or loop.constant_force)
    places = [i for i, of in enumerate(measured) if of.response.edge_row >= 0 and of.logged.step != 0]
    trials: list[Trial] = [measured[i].logged for i in places]
    steps = np.array([usual.step if linear else trial.step for trial in trials])
    moved = {}
    for step in np.unique(steps).tolist():
        some = np.flatnonzero(steps == step).tolist()
        K, B = np.array([(trials[i].stiffness, trials[i].damping) for i in some]).T
        for i, alone in zip(some, simulate_behind(loop, K, B, replace(usual, step=step)), strict=True):
            rows = trials[i].rows - measured[places[i]].response.edge_row
            moved[places[i]] = alone.displacement[1 : min(rows, alone.rows - 1) + 1] * (trials[i].step / step)
    return moved


def reason_of(criterion: str, reasons: str) -> str:
    """Return why a trial has no cost. The text consists of the family's reasons for this criterion, each of them once.

    >>> reason_of("settle_1pct", "settle_1pct: too short; settle_1pct: too short; settle_2pct: coarse sensor")
    'too short'
    """
    parts = [clause.partition(": ") for clause in reasons.split("; ")]
    others = CRITERIA.keys() - {criterion}
    own = [text if name == criterion else f"{name}{colon}{text}" for name, colon, text in parts if name not in others]
    return "; ".join(dict.fromkeys(own))


def _signals(position: Floats, ghost: Floats, edge: int, quantum: float) -> JsonObject:
    """Return the coded log and model of a trial, and the index of the command edge among the kept rows."""
    rows = len(position)
    kept = visible_rows((position, ghost), edge, rows)
    shown = {} if kept is None else {"rows": np.diff(kept, prepend=0).tolist()}
    kept = np.arange(rows) if kept is None else kept
    step, model_step = step_size(position[kept], quantum), step_size(ghost[kept], 0.0)
    result = {"edge": edge, **shown, "q": few_digits(step, 6), "x": code(position[kept], step)}
    model = code(ghost[kept], model_step)
    return {**result, "gq": few_digits(model_step, 6), "g": model} if model else result


def visible_rows(signals: tuple[Floats, ...], edge: int, rows: int) -> Integers | None:
    """Return the rows that a plot of signals needs, or None if it needs all rows.

    In each column of pixels, the rows with the lowest and highest value of each signal are kept. The first and last row
    are also kept, so that the drawing covers the same pixels. Two methods were rejected: every n-th row loses peaks,
    and largest triangles (Steinarsson 2013) lose the envelope of an oscillation that is faster than the pixels.

    Parameters
    ----------
    signals : tuple of float64, shape (N,) each
        Signals over the same rows. A missing value is NaN.
    edge, rows : int
        Row of the command edge, and number of rows.
    """
    if rows <= COLUMNS + WHOLE:
        return None
    inside = np.arange(rows)
    starts = np.flatnonzero(np.diff(inside * COLUMNS // rows, prepend=-1))
    kept = [np.array([0, rows - 1]), inside[edge : edge + WHOLE]]
    width = int(np.diff(starts, append=rows).max())
    place = np.minimum(starts[:, None] + np.arange(width), np.append(starts[1:], rows)[:, None] - 1)
    for signal in signals:
        values = signal[:rows][place]
        known = np.isfinite(values)
        for best in (np.where(known, values, np.inf).argmin(axis=1), np.where(known, values, -np.inf).argmax(axis=1)):
            kept.append(place[np.arange(len(place)), best][known.any(axis=1)])
    return np.unique(np.concatenate(kept))


def step_size(values: Floats, quantum: float) -> float:
    """Return the quantisation step of the written values.

    The step is the larger of the sensor resolution and a fixed share of the range of the values.
    """
    known = values[np.isfinite(values)]
    return (max(float(np.ptp(known)) / LEVELS, quantum) if len(known) else 0.0) or 1.0


def code(values: Floats, step: float) -> dict[str, list[int]] | None:
    """Return the one-step prediction errors of a quantised signal, or None for a signal without values.

    Parameters
    ----------
    values : float64, shape (N,)
        Signal. A non-finite value repeats the previous value.
    step : float

    Returns
    -------
    dict
        ``c``: coefficients of the four previous samples, the latest first, as multiples of 1/`PARTS`. ``r``: value
        minus prediction [steps]. All numbers are integers, so that a browser computes the same values.

    Notes
    -----
    A response of the loop is a sum of a few decaying oscillations, each of which two samples predict. Two methods were
    rejected: second differences need twice the bytes for an oscillation, and simulating the model in the page would
    need a second definition of the loop.
    """
    known = np.isfinite(values)
    if not known.any():
        return None
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), 0))
    counted = np.rint(np.nan_to_num(values[last]) / step).astype(np.int64)
    past = np.stack([np.concatenate([np.zeros(lag, np.int64), counted])[: len(counted)] for lag in LAGS], axis=1)
    # The first samples have no past and would bias the coefficients.
    fitted = np.linalg.lstsq(past[len(LAGS) :].astype(float), counted[len(LAGS) :].astype(float), rcond=None)[0]
    coefficients = np.rint(fitted * PARTS).astype(np.int64)
    missed = counted - (past @ coefficients + PARTS // 2) // PARTS
    return {"c": coefficients.tolist(), "r": missed.tolist()}


def _spread(count: int) -> Integers:
    """Return the indices 0 to count - 1 in an order whose beginning covers the range in halves, quarters, eighths
    ..."""
    bits = max(count - 1, 1).bit_length()
    index = np.arange(1 << bits)
    turned = sum((((index >> bit) & 1) << (bits - 1 - bit) for bit in range(bits)), np.zeros_like(index))
    return np.asarray(turned[turned < count])


def _coarse_to_fine(stiffness: Floats, damping: Floats) -> Integers:
    """Return trials in an order whose beginning covers the plane.

    The first are nearest to the centres of 1, 4, 16 ... cells.
    """
    if not len(stiffness):
        return np.zeros(0, dtype=np.int64)
    x, y = (
        (np.searchsorted(np.unique(values), values) + 0.5) / len(np.unique(values)) for values in (stiffness, damping)
    )
    chosen, cells = [], 1
    while cells <= FINEST_GRID:
        column, row = np.floor(x * cells), np.floor(y * cells)
        order = np.argsort(np.hypot(x * cells - column - 0.5, y * cells - row - 0.5), kind="stable")
        _, first = np.unique((row * cells + column)[order], return_index=True)
        chosen.append(order[first][_spread(len(first))])
        cells *= 2
    return _each_once(np.concatenate([*chosen, np.arange(len(x))]))


def _each_once(rows: Integers) -> Integers:
    _, first = np.unique(rows, return_index=True)
    return np.asarray(rows[np.sort(first)], dtype=np.int64)


def _numbers(values: Floats, digits: int) -> list[float | int | None]:
    return [few_digits(v, digits) for v in values.tolist()]

"""The trials of a comparison for the interactive part of its report: all as points, the most telling with response.

A page that held every response of 11,000 trials would have 8 MB. So all trials come with stiffness, damping, verdict,
outcome and costs, and responses as far as a budget goes: first the optima, then by turns the trials at the stability
boundary and a grid over the plane that gets finer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.comparison.figures.boundary_curves import measured_curve, theory_curve
from pipeline.comparison.scene.scene import SceneData, needed_stages
from pipeline.measured.fit.ghost import simulate_ghost
from pipeline.measured.signal.outcome import OUTCOMES
from pipeline.measured.stages.stage_groups import TrialGroup
from pipeline.measured.stages.stages import ExperimentStages, cost_column
from pipeline.records.batch import Floats, Integers, TrialBatch
from pipeline.records.criteria import CRITERIA, criterion_of
from pipeline.records.figure_records import Curve
from pipeline.records.models import Motion
from pipeline.records.results import ExperimentResult
from pipeline.records.trial_codec import TrialPage, code, pack, pack_within, reference, step_size, visible_rows
from pipeline.rendering.labels import (
    UNITS,
    cost_text,
    criterion_label,
    printed_scale,
    significant,
)
from pipeline.theory.predictions import Theory

BUDGET = 290_000
"""Characters that the trials of a report may take: with script and figures a thesis-size report stays below 2 MB."""

PORTION = 64
"""Responses that are prepared at once: the simulated loop takes about as long for one as for these."""

COST_DIGITS = 3
"""Digits of a cost in the plane; a trial with its response shows the cost as the tables print it."""

EDGE_TURNS = 3
"""Trials at the boundary for each one of the grid: the tables name all of the former."""

FINEST_GRID = 64
"""Cells along each axis of the finest grid over the plane: a course has fewer dampings."""

VERDICTS = ("stable", "unstable", "undecided")


def trial_page(
    data: SceneData,
    results: Sequence[ExperimentResult],
    theories: Mapping[str, Theory],
    *,
    full: bool = False,
    budget: int = BUDGET,
    responses: Sequence[int] | None = None,
) -> TrialPage:
    """Gather the trials of all experiments.

    Parameters
    ----------
    data : SceneData
    results : sequence of ExperimentResult
        Of the experiments of ``data``, in their order.
    theories : mapping
        Theory by experiment, where there is one.
    full : bool
        Whether every response goes into the page, whatever its size.
    budget : int
        Characters for all experiments together. The columns of all trials always go in, also beyond it.
    responses : sequence of int, optional
        How many responses of each experiment go in, whatever their size. How many a budget allows differs between
        builds of zlib; a report that is checked elsewhere is made with the numbers that it has.
    """
    criteria = data.scene.criteria
    gathered = [
        _Experiment(number, stages, result, theories.get(stages.experiment), criteria, "model" in needed_stages(data))
        for number, (stages, result) in enumerate(zip(data.experiments, results, strict=True))
    ]
    left = budget - sum(len(e.columns) for e in gathered)
    # experiments with few trials first: what they do not use is for the others
    for done, number in enumerate(sorted(range(len(gathered)), key=lambda n: len(gathered[n].verdict))):
        share = None if full or responses else max(left, 0) // (len(gathered) - done)
        left -= gathered[number].embed(share, responses[number] if responses else None)
    motion: Motion = "rotation" if data.experiments[0].rotation else "translation"
    first = next((c for c in criteria if CRITERIA[c].tabled), criteria[0])
    content = {
        "units": {"stiffness": UNITS[motion].stiffness, "damping": UNITS[motion].damping},
        "position": "rad" if motion == "rotation" else "m",
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
        "experiments": [e.content() for e in gathered],
    }
    return TrialPage(
        content=content,
        trials=sum(len(e.verdict) for e in gathered),
        responses=sum(e.embedded for e in gathered),
        places={(e.name, trial): place for e in gathered for trial, place in e.places().items()},
        limits={(e.name, *point): place for e in gathered for point, place in e.limits().items()},
    )


@dataclass
class _Experiment:
    """One experiment on its way into the page; rows are those of its stages."""

    number: int
    stages: ExperimentStages
    result: ExperimentResult
    theory: Theory | None
    criteria: tuple[str, ...]
    modelled: bool
    responses: str = ""
    embedded: int = 0

    def __post_init__(self) -> None:
        self.name = self.stages.experiment
        self.stiffness = self.stages.column("response", "stiffness")
        self.damping = self.stages.column("response", "damping")
        self.verdict = self.stages.verdicts.verdict
        self.costs = {c: self.stages.column(*cost_column(c)) for c in self.criteria}
        outcomes = self.stages.texts("outcome", "outcome")
        columns: dict[str, Any] = {
            "k": _numbers(self.stiffness, 6),
            "b": _numbers(self.damping, 6),
            "v": "".join(str(VERDICTS.index(v)) for v in self.verdict.tolist()),
            "o": "".join(str(OUTCOMES.index(o)) for o in outcomes),
            "c": [_numbers(self.costs[c] * printed_scale(c), COST_DIGITS) for c in self.criteria],
            **_limits(measured_curve(self.result)),
            "theory": _line(theory_curve(self.theory, "theory")) if self.theory else None,
        }
        self.columns = pack(columns)

    def content(self) -> dict[str, Any]:
        """What the page holds of the experiment."""
        delay = self.result.estimates["delay_samples"].value
        return {
            "name": self.name,
            "trials": len(self.verdict),
            "shown": self.embedded,
            "period": self.stages.sampling_period_s,
            "delay": None if delay is None else int(delay),
            "columns": self.columns,
            "responses": self.responses,
        }

    def places(self) -> dict[str, str]:
        """References of the trials that tables name."""
        named = {str(best.trial_id) for best in self.result.optimum.values()}
        named |= {self.result.use.point.trial_id} if self.result.use else set()
        ids = self.stages.texts("response", "trial_id")
        return {trial: reference(self.number, row) for row, trial in enumerate(ids) if trial in named}

    def limits(self) -> dict[tuple[float, float], str]:
        """References of the trials at the boundary by damping and stiffness."""
        return {point: reference(self.number, row) for point, row in self._boundary().items()}

    def _boundary(self) -> dict[tuple[float, float], int]:
        rows = zip(self.damping.tolist(), self.stiffness.tolist(), self.verdict.tolist(), strict=True)
        first: dict[tuple[float, float, str], int] = {}
        for row, key in enumerate(rows):
            first.setdefault(key, row)
        found = {}
        for point in self.result.boundary:
            for stiffness, verdict in ((point.stable, "stable"), (point.unstable, "unstable")):
                row_there = None if stiffness is None else first.get((point.damping, stiffness, verdict))
                if stiffness is not None and row_there is not None:
                    found[point.damping, stiffness] = row_there
        return found

    def embed(self, budget: int | None, most: int | None) -> int:
        """Pack as many responses as a budget allows, ``most`` at most; return how many characters they take."""
        self.responses, self.embedded = pack_within(self._all_entries(), budget, most)
        return len(self.responses)

    def _all_entries(self) -> Iterator[dict[str, Any]]:
        order = self._order()
        for first in range(0, len(order), PORTION):
            yield from self._entries(order[first : first + PORTION])

    def _order(self) -> Integers:
        """All rows, the most telling first."""
        ids = self.stages.texts("response", "trial_id")
        place = {trial: row for row, trial in enumerate(ids)}
        use = [self.result.use.point.trial_id] if self.result.use else []
        best = [place[str(name)] for name in [*use, *(o.trial_id for o in self.result.optimum.values())]]
        edge = np.array(list(self._boundary().values()), dtype=np.int64)
        edge = edge[_spread(len(edge))]
        grid = _coarse_to_fine(self.stiffness, self.damping)
        turn = np.concatenate([np.arange(len(edge)) // EDGE_TURNS, np.arange(len(grid)) + 0.5])
        both = np.concatenate([edge, grid])[np.argsort(turn, kind="stable")]
        rows = np.concatenate([np.array(best, dtype=np.int64), both])
        _, first = np.unique(rows, return_index=True)
        return np.asarray(rows[np.sort(first)], dtype=np.int64)

    def _entries(self, rows: Integers) -> list[dict[str, Any]]:
        """Responses of some trials."""
        entries = {
            int(place): entry
            for index, batch in self.stages.samples.pick(rows)
            for place, entry in zip(index, self._entries_of(rows[index], batch), strict=True)
        }
        return [entries[place] for place in range(len(rows))]

    def _entries_of(self, rows: Integers, batch: TrialBatch) -> list[dict[str, Any]]:
        stages, found = self.stages, TrialGroup(batch).found
        nothing = np.full(len(rows), np.nan)
        model = {
            name: stages.column("model", f"model_{name}")[rows] if self.modelled else nothing
            for name in ("mass", "damping", "delay")
        }
        beside = simulate_ghost(batch, found, model["mass"], model["damping"], model["delay"])
        texts = self._texts(rows, model)
        start = found.position_start[:, None]
        position, ghost = batch.position - start, beside.position - start
        final = found.position_final_expected - found.position_start
        return [
            {
                "i": int(rows[i]),
                **_signals(position[i], ghost[i], int(batch.rows[i]), max(int(found.edge_row[i]), 0), quantum),
                **({} if np.isnan(final[i]) else {"f": _number(final[i], 6)}),
                **{name: values[i] for name, values in texts.items() if values[i]},
            }
            for i, quantum in enumerate(found.sensor_quantum.tolist())
        ]

    def _texts(self, rows: Integers, model: Mapping[str, Floats]) -> dict[str, list[Any]]:
        """What is said of some trials: id, verdict, evidence, model, costs with intervals or the reason for none."""
        stages = self.stages

        def of(stage: str, column: str) -> list[str]:
            values = stages.texts(stage, column)
            return [values[row] for row in rows]

        units = UNITS["rotation" if stages.rotation else "translation"]
        names = (("m", "mass", units.mass), ("b", "damping", units.damping), ("d", "delay", "samples"))
        fitted = [
            ", ".join(f"{symbol} = {significant(float(model[name][i]), 3)} {unit}" for symbol, name, unit in names)
            if np.isfinite(model["mass"][i])
            else ""
            for i in range(len(rows))
        ]
        costs = [self._cost_texts(criterion, rows) for criterion in self.criteria]
        return {
            "id": of("response", "trial_id"),
            "why": of("response", "reason"),
            "evidence": [text.replace("+-", "\N{PLUS-MINUS SIGN}") for text in of("outcome", "evidence")],
            "model": fitted,
            "costs": [list(texts) for texts in zip(*costs, strict=True)],
        }

    def _cost_texts(self, criterion: str, rows: Integers) -> list[str]:
        cost = self.costs[criterion][rows]
        low, high = (ends[rows] for ends in self.stages.cost_interval(criterion))
        reasons = self.stages.texts(cost_column(criterion)[0], "reason")
        texts = []
        for i, row in enumerate(rows.tolist()):
            if np.isnan(cost[i]):
                texts.append(f"none: {_reason_of(criterion, reasons[row]) or 'only stable trials have one'}")
            elif np.isnan(low[i]) or np.isnan(high[i]):
                texts.append(cost_text(criterion, float(cost[i])))
            else:
                ends = " to ".join(cost_text(criterion, float(end)) for end in (low[i], high[i]))
                texts.append(f"{cost_text(criterion, float(cost[i]))} ({ends})")
        return texts


def _reason_of(criterion: str, reasons: str) -> str:
    """Return why a trial has no cost: of the reasons of a family those for this criterion, each once.

    >>> _reason_of("settle_1pct", "settle_1pct: too short; settle_1pct: too short; settle_2pct: coarse sensor")
    'too short'
    """
    parts = [clause.partition(": ") for clause in reasons.split("; ")]
    others = CRITERIA.keys() - {criterion}
    own = [text if name == criterion else f"{name}{colon}{text}" for name, colon, text in parts if name not in others]
    return "; ".join(dict.fromkeys(own))


def _signals(position: Floats, ghost: Floats, rows: int, edge: int, quantum: float) -> dict[str, Any]:
    """Log and model of one trial, coded; row of the command edge among the rows that are kept."""
    kept = visible_rows((position, ghost), edge, rows)
    if kept is None:
        kept, shown = np.arange(rows), {}
    else:
        shown = {"rows": np.diff(kept, prepend=0).tolist()}
    step, model_step = step_size(position[kept], quantum), step_size(ghost[kept], 0.0)
    result = {"edge": edge, **shown, "q": _number(step, 6), "x": code(position[kept], step)}
    model = code(ghost[kept], model_step)
    return {**result, "gq": _number(model_step, 6), "g": model} if model else result


def _spread(count: int) -> Integers:
    """Indices 0 to count - 1 in an order whose beginning is spread over all: halves, quarters, eighths ..."""
    bits = max(count - 1, 1).bit_length()
    index = np.arange(1 << bits)
    reversed_ = np.zeros_like(index)
    for bit in range(bits):
        reversed_ = (reversed_ << 1) | ((index >> bit) & 1)
    return reversed_[reversed_ < count]


def _coarse_to_fine(stiffness: Floats, damping: Floats) -> Integers:
    """Trials in an order whose beginning covers the plane: nearest to the centres of 1, 4, 16 ... cells."""
    if not len(stiffness):
        return np.zeros(0, dtype=np.int64)
    x, y = (
        (np.searchsorted(np.unique(values), values) + 0.5) / len(np.unique(values)) for values in (stiffness, damping)
    )
    chosen = []
    cells = 1
    while cells <= FINEST_GRID:
        column, row = np.floor(x * cells), np.floor(y * cells)
        distance = np.hypot(x * cells - column - 0.5, y * cells - row - 0.5)
        order = np.argsort(distance, kind="stable")
        _, first = np.unique((row * cells + column)[order], return_index=True)
        of_level = order[first]
        chosen.append(of_level[_spread(len(of_level))])
        cells *= 2
    chosen.append(np.arange(len(x)))
    rows = np.concatenate(chosen)
    _, first = np.unique(rows, return_index=True)
    return np.asarray(rows[np.sort(first)], dtype=np.int64)


def _limits(curve: Curve) -> dict[str, Any]:
    """Measured limits: a line, which those of which only a lower bound is known interrupt, and these alone."""
    bound = np.zeros(len(curve.damping), dtype=bool) if curve.censored is None else curve.censored > 0
    line = replace(curve, stiffness=np.where(bound, np.nan, curve.stiffness))
    return {
        "measured": _line(line) if not bound.all() else [[], []],
        "open": [_numbers(curve.stiffness[bound], 4), _numbers(curve.damping[bound], 4)],
    }


def _line(curve: Curve) -> list[list[float | int | None]]:
    """Stiffness and damping of a curve."""
    return [_numbers(curve.stiffness, 4), _numbers(curve.damping, 4)]


def _numbers(values: Floats, digits: int) -> list[float | int | None]:
    return [_number(v, digits) for v in values.tolist()]


def _number(value: float, digits: int) -> float | int | None:
    """A number with few digits, as an integer where it is one; None where there is none."""
    if not np.isfinite(value):
        return None
    rounded = float(f"{value:.{digits}g}")
    return int(rounded) if rounded == int(rounded) else rounded

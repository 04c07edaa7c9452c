"""Convert the tables of a comparison to pandas data frames with units in ``attrs``, for the page, files and Python.

Values are in SI units. Costs are as in the JSON document, with settling times in samples (and seconds) and overshoot as
a fraction. Missing numbers are NaN, with their reason in another column.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from pipeline.device.parameters import MOTIONS, unit_of
from pipeline.records.criteria import criterion_of
from pipeline.records.findings import DampingRange, NearOptimum, Optimum, Quantity, Record
from pipeline.records.models import ComparisonRow, Deviation, Motion
from pipeline.records.results import ComparisonResult, ExperimentNumbers
from pipeline.records.tables import COLUMNS, unit_of_column
from pipeline.rendering.table import Row

if TYPE_CHECKING:  # importing pandas takes half a second
    import pandas as pd

TEXTS = """
    table criterion condition note experiment trial_id quantity unit method reason warning basis score code sentence
    evidence source theory_source adequate key text tags log since kind what line theory name device title motion grip
    verdict
"""
"""Text columns. Their missing values are None instead of NaN."""

FORCED: tuple[Motion, ...] = ("translation", "rotation")
"""Kinds of motion whose commands are forces or torques."""

_ESTIMATES = """
    experiment quantity value low high unit method recommended reason trials spread within warning
"""
_BOUNDARY = """
    experiment damping stable unstable censored stiffness low high trials undecided stiffness_large_motion truth
"""
_NEAR = " ".join(f"near_{name}" for name in NearOptimum.model_fields)
_RANGE = " ".join(f"damping_range_{name}" for name in DampingRange.model_fields)
_OPTIMUM = " ".join(Optimum.model_fields).replace("near", _NEAR).replace("damping_range", _RANGE)
_OPTIMA = f"experiment criterion {_OPTIMUM} cost_s reason"
_SCORES = "experiment basis score quantity value low high reason"
_PARTS = tuple(Deviation.model_fields)
_TABLES = [n for name in ComparisonRow.model_fields for n in (_PARTS if name == "deviation" else (name,))] + ["cost_s"]
_WALL = ("stiffness", "damping", "stable", "unstable", "low", "high")


def frames(result: ComparisonResult) -> dict[str, pd.DataFrame]:
    """Return the tables of a comparison by name, including empty ones, in the order in which files are written."""
    e, motion = result.experiments, result.motion
    periods = {one.experiment: one.sampling_period_s for one in e}
    stiffness = units_of(_WALL, {motion})
    found = {
        "tables": frame_of(_TABLES, (_of_row(row, periods) for row in result.tables), units_of_tables(motion)),
        "estimates": estimates_frame(e, all_methods=True),
        "boundary": boundary_frame(e, motion),
        "optima": optima_frame(e, motion),
        "scores": frame_of(_SCORES, _scores(e), {}),
        "loop_boundary": _records(e, "loop_boundary", stiffness),
        **{name: _records(e, field, {}) for name, field in _PLAIN.items()},
        "use": _records(e, "use", {name: unit for name, unit in stiffness.items() if name in ("stiffness", "damping")}),
        "header": frame_of("experiment key text trials", _header(e), {}),
        "counts": frame_of("experiment kind what trials", _counts(e), {}),
        "missing": frame_of("experiment what reason", _missing(e), {}),
        "excluded": _frame_of_rows([flat(one) for one in result.excluded], {}),
        "notes": frame_of(
            "experiment trial_id tags text", ({**dict(n), "tags": ", ".join(n.tags)} for n in result.notes), {}
        ),
        "trend": frame_of("experiment line quantity unit value low high bound", _trend(e, motion), {}),
    }
    for name in ("tables", "optima", "use") if result.measuring.final == "measured" else ():
        found[name]["final_position"] = result.measuring.final
    return found


_PLAIN = {"loops": "loop", "replay": "replay", "causes": "causes", "model": "model_check", "passive": "passive"}
"""Frames made from fields of an experiment, with one row per record."""


def frame_of(names: str | Sequence[str], rows: Iterable[Mapping[str, Any]], units: Mapping[str, str]) -> pd.DataFrame:
    """Return records as rows, with fixed columns and types even if empty, and the units of columns that have one."""
    import numpy as np
    import pandas as pd

    columns = names.split() if isinstance(names, str) else list(names)
    frame = pd.DataFrame([[row.get(name) for name in columns] for row in rows], columns=columns, dtype=object)
    for name in columns:
        values = frame[name]
        if name in TEXTS.split():
            continue
        frame[name] = values.astype(np.float64) if values.isna().any() or not len(values) else values.infer_objects()
    frame.attrs["units"] = {name: unit for name, unit in units.items() if name in columns}
    return frame


def units_of(columns: Iterable[str], motions: Collection[str] = FORCED) -> dict[str, str]:
    """Return the units of stored columns that have one. If the motions differ, both units are given."""
    units = {}
    for name in (name for name in columns if name in COLUMNS):
        kinds = (motion for motion in MOTIONS if motion in motions)
        units[name] = " or ".join(dict.fromkeys(unit_of_column(COLUMNS[name], motion) for motion in kinds))
    return {name: unit for name, unit in units.items() if unit}


def units_of_tables(motion: Motion) -> dict[str, str]:
    """Return the units of Tables D.1 to D.6."""
    wall = units_of(("stiffness", "damping"), {motion})
    deviations = ("", "stiffness_", "damping_", "published_", "own_")
    percent = dict.fromkeys(
        (*(f"{name}deviation_percent" for name in deviations), "own_model_percent", *_PARTS[:-1]), "%"
    )
    return {
        **wall,
        **{f"published_{name}": u for name, u in wall.items()},
        "theory_mass": unit_of("mass", motion),
        "theory_damping": wall["damping"],
        **percent,
        "delay_samples": "samples",
        "cost_s": "s",
    }


def estimates_frame(results: Iterable[ExperimentNumbers], *, all_methods: bool = False) -> pd.DataFrame:
    """Return the ``recommended`` estimates. On request, the estimates of the other methods follow."""
    rows = []
    for result in results:
        for quantity, best in result.estimates.items():
            named = {"experiment": result.experiment, "quantity": quantity}
            rows.append({**dict(best), **named, "recommended": True})
            for method, other in best.by_method.items() if all_methods else ():
                rows.append({**dict(other), **named, "method": method, "recommended": False})
    return frame_of(_ESTIMATES, rows, {})


def boundary_frame(results: Iterable[ExperimentNumbers], motion: Motion) -> pd.DataFrame:
    """Return the measured limits.

    ``stiffness`` comes from the growth rates, and ``low`` and ``high`` are the ends of its 95 % interval.
    """
    rows = ({"experiment": e.experiment, **dict(p), "stiffness": p.estimate} for e in results for p in e.boundary)
    units = units_of(_WALL, {motion})
    more = dict.fromkeys(("stiffness_large_motion", "truth"), units["stiffness"])
    return frame_of(_BOUNDARY, rows, units | more)


def optima_frame(results: Iterable[ExperimentNumbers], motion: Motion) -> pd.DataFrame:
    """Return the best trials, and the reason if a criterion has none."""
    rows: list[Row] = []
    for e in results:
        for criterion, best in e.optimum.items():
            seconds = in_seconds(criterion, best.cost, e.sampling_period_s)
            rows.append({"experiment": e.experiment, "criterion": criterion, **flat(best), "cost_s": seconds})
        rows += [{"experiment": e.experiment, "criterion": name, "reason": why} for name, why in e.missing.items()]
    wall = units_of(("stiffness", "damping"), {motion})
    near = {f"near_{name}_{end}": unit for name, unit in wall.items() for end in ("low", "high")}
    near |= {f"damping_range_{end}": wall["damping"] for end in ("low", "high")}
    return frame_of(_OPTIMA, rows, wall | near | {"cost_s": "s", "scatter_percent": "%"})


def in_seconds(criterion: str, cost: float | None, period: float | None) -> float | None:
    """Return a cost given in samples in seconds, or None for other costs."""
    return cost * period if cost is not None and period and criterion_of(criterion).family.unit == "samples" else None


def flat(record: Record) -> Row:
    """Return the numbers and texts of a record.

    The ends of an interval follow the value they belong to. Lists are left out.
    """
    row: Row = {}
    for name, value in record:
        if isinstance(value, Record):
            # all numbers of a column have the same unit
            inner = flat(value) if type(value) is not Quantity else value.model_dump(include={"value", "low", "high"})
            row |= {name if key == "value" else f"{name}_{key}": each for key, each in inner.items()}
        elif not isinstance(value, (dict, tuple, list)):
            row[name] = value
    return row


def _records(results: Sequence[ExperimentNumbers], field: str, units: Mapping[str, str]) -> pd.DataFrame:
    """Return a field of all experiments, either one record or several."""
    rows = []
    for e in results:
        found = getattr(e, field) or ()
        for each in found if isinstance(found, tuple) else (found,):
            rows.append({"experiment": e.experiment, **flat(each)})
    return _frame_of_rows(rows, units)


def _frame_of_rows(rows: Sequence[Row], units: Mapping[str, str]) -> pd.DataFrame:
    return frame_of(list(dict.fromkeys(name for row in rows for name in row)), rows, units)


def _of_row(row: ComparisonRow, periods: Mapping[str, float | None]) -> Row:
    period = periods.get(row.experiment or "") or next((p for p in periods.values() if p), None)
    return {**dict(row), **dict(row.deviation or {}), "cost_s": in_seconds(row.criterion, row.cost, period)}


def _scores(results: Iterable[ExperimentNumbers]) -> Iterator[Row]:
    """Yield the numbers of all scores. ``x_low`` and ``x_high`` are the ends of the interval of ``x``."""
    for e, scores in ((each, scores) for each in results for scores in each.scores):
        about = {"experiment": e.experiment, "basis": scores.basis}
        for name, found in scores:
            values = flat(found) if isinstance(found, Record) and name != "parameters" else {}
            ends = {f"{key}_{end}" for key in values for end in ("low", "high")}
            for key in (key for key in values if key not in ends and values[key] is not None):
                interval = {end: values.get(f"{key}_{end}") for end in ("low", "high")}
                yield {**about, "score": name, "quantity": key, "value": float(values[key]), **interval}
        for name, reason in scores.missing.items():
            yield {**about, "score": name, "reason": reason}


def _header(results: Iterable[ExperimentNumbers]) -> Iterator[Row]:
    for e in results:
        for line in e.header:
            for value, trials in line.values.items():
                yield {"experiment": e.experiment, "key": line.key, "text": value, "trials": trials}


def _counts(results: Iterable[ExperimentNumbers]) -> Iterator[Row]:
    for e in results:
        for kind, counts in (("verdict", e.verdicts), ("outcome", e.outcomes)):
            for what, number in counts.items():
                yield {"experiment": e.experiment, "kind": kind, "what": what, "trials": number}


def _missing(results: Iterable[ExperimentNumbers]) -> Iterator[Row]:
    for e in results:
        for what, why in e.missing.items():
            yield {"experiment": e.experiment, "what": what, "reason": why}


def _trend(results: Sequence[ExperimentNumbers], motion: Motion) -> Iterator[Row]:
    """Yield limits and estimates by experiment, with the header lines that differ.

    Without such lines, nothing is yielded.
    """
    keys = differing_lines(results)
    for e in in_order(results, keys) if keys else ():
        about = {"experiment": e.experiment, "line": ", ".join(f"{key}: {line_text(e, key)}" for key in keys)}
        if (largest := e.largest_limit) is not None:
            high = None if largest.censored else largest.high
            limit = {"value": largest.stiffness, "low": largest.low, "high": high, "bound": largest.censored}
            unit = units_of(("stiffness",), {motion})["stiffness"]
            yield {**about, "quantity": "stiffest limit", "unit": unit, **limit}
        for name in ("delay_samples", "mass", "damping"):
            found = e.estimates.get(name)
            if found is not None and found.value is not None:
                yield {**about, **dict(found), "quantity": name, "bound": False}


def differing_lines(results: Sequence[ExperimentNumbers]) -> tuple[str, ...]:
    """Return the keys of the header lines whose values differ between at least two experiments. Dates come first."""
    values: dict[str, list[str]] = {}
    for e in results:
        for line in e.header:
            values.setdefault(line.key, []).append(line_text(e, line.key))
    keys = [key for key, texts in sorted(values.items()) if len(texts) > 1 and len(set(texts)) > 1]
    return tuple(sorted(keys, key=lambda key: not all(_date(line_text(e, key)) for e in results)))


def line_text(result: ExperimentNumbers, key: str) -> str:
    """Return the value of a header line in the logs of an experiment.

    If there are several values, the first is returned. If there is none, the text is empty.
    """
    line = next((line for line in result.header if line.key == key), None)
    return f"{next(iter(line.values))}{' …' if line.different > 1 else ''}" if line else ""


def in_order(results: Sequence[ExperimentNumbers], keys: Sequence[str]) -> list[ExperimentNumbers]:
    """Return experiments sorted by the date in the first of the header lines, or in their original order if it is no
    date."""
    dates = [_date(line_text(e, keys[0])) for e in results]
    return [results[n] for n in sorted(range(len(dates)), key=lambda n: (dates[n], n))] if all(dates) else list(results)


def _date(text: str) -> str:
    """Return a date in ISO 8601 format, which sorts correctly as text. For any other text, return an empty text."""
    try:
        return datetime.fromisoformat(text.removesuffix(" …")).isoformat()
    except ValueError:
        return ""

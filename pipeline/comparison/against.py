"""Comparison of two results (of experiments, devices or versions) by their documents."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from pipeline.base.errors import UsageError
from pipeline.base.progress import part_of_work
from pipeline.base.provenance import __version__, code_digest
from pipeline.base.wording import listed
from pipeline.comparison.experiment_result import experiment_numbers, nominal_theories
from pipeline.comparison.figures.responses import trials_of
from pipeline.comparison.scene.origin import excluded_trials
from pipeline.comparison.scene.scene import StoredData, open_scene
from pipeline.loop.normalised_loop import LoopUnits
from pipeline.measured.experiment.boundary import boundary_area
from pipeline.measured.experiment.identified_loop import identified_loop
from pipeline.measured.student import NORMAL_95
from pipeline.records.criteria import criterion_of
from pipeline.records.findings import BoundaryPoint, ExcludedTrial, Note, Quantity
from pipeline.records.models import Motion
from pipeline.records.results import (
    AgainstResult,
    BoundaryDifference,
    ComparisonResult,
    CostDifference,
    ExperimentNumbers,
    LimitDifference,
    PairDifference,
    Plane,
    Side,
    ValueDifference,
    pair_labels,
)
from pipeline.records.trials import Floats
from pipeline.rendering.figures.boundaries import limits_figure, limits_panel, measured, plane_figure
from pipeline.rendering.figures.drawing import Figure
from pipeline.rendering.labels import UNITS
from pipeline.rendering.report.report_against import AgainstPage, sentences_of
from pipeline.theory.predictions import Theory

FEWEST_POINTS = 6
"""Smallest number of points for a 95 % rank interval of a median. With five, the range of all values covers 94 %."""

Document = Mapping[str, Any]
"""An experiment in the format of `compare --json`."""

Trials = Mapping[str, tuple[Floats, Floats, Floats]]
"""Stiffness, damping and cost of the trials, by criterion. The cost is NaN if a trial has none."""

Scale = tuple[float, float]
"""Units of stiffness m/T^2 and damping m/T, by which walls are divided to obtain alpha and beta."""

AREA = "boundary_area"
"""Estimate that is an area over dampings. It is compared only over the dampings that both sides cover."""

SAME_DAMPING = 1e-9
"""Relative difference of dampings that counts as rounding."""

_SCORES = {"region": ("overlap", "covered", "area_ratio"), "distance": ("median",), "verdicts": ("agreement",)}
"""Names of the scores that are compared."""


def compare_pair(
    sides: tuple[Side, Side],
    documents: tuple[Document, Document],
    motion: Motion,
    scales: tuple[Scale, Scale] | None = None,
    trials: tuple[Trials, Trials] | None = None,
) -> PairDifference:
    """Return the differences between two experiments, as second minus first.

    Parameters
    ----------
    sides : (Side, Side)
    documents : (mapping, mapping)
        Documents of the experiments. Documents of other versions may lack new keys.
    motion : Motion
    scales : ((K, B), (K, B)), optional
        If given, walls are compared in the plane of alpha and beta (Table 3.1). Two devices require it.
    trials : (Trials, Trials), optional
        Costs of the single trials. They are unavailable if only finished documents are compared.
    """
    units = UNITS[motion]
    wall = ("1", "1") if scales else (units.stiffness, units.damping)
    one, other = ([_point(p) for p in each["boundary"]] for each in documents)
    units_of_sides = scales or ((1.0, 1.0), (1.0, 1.0))
    boundary, reason = compare_boundaries(one, other, *units_of_sides)
    values = [list(_values(*each)) for each in zip(documents, (wall, wall), scales or (None, None), strict=True)]
    scaled = [[_scaled(point, by) for point in points] for points, by in zip((one, other), units_of_sides, strict=True)]
    one_values, other_values = _with_common_areas(values, scaled, "1" if scales else None)
    joined = compare_values(one_values, other_values, two_devices=bool(scales))
    estimates, optima, scores = (
        tuple(v for v in joined if v.part == part) for part in ("estimates", "optima", "scores")
    )
    plane: Plane = "normalised" if scales else "physical"
    costs = () if trials is None or scales else compare_costs(*trials)
    return PairDifference(
        first=sides[0],
        second=sides[1],
        plane=plane,
        estimates=estimates,
        optima=optima,
        scores=scores,
        boundary=boundary,
        boundary_reason=reason,
        costs=costs,
        sentences=sentences_of(pair_labels(*sides), plane, boundary, reason, estimates, costs),
    )


def _with_common_areas(
    values: Sequence[Sequence[_Value]], boundaries: Sequence[Sequence[BoundaryPoint]], unit: str | None
) -> list[list[_Value]]:
    """Return the values of both sides with areas over the dampings that both boundaries cover."""
    first, last = ([end(point.damping for point in points) for points in boundaries if points] for end in (min, max))
    low, high = (max(first), min(last)) if len(first) == 2 else (0.0, 0.0)

    def area(value: _Value, points: Sequence[BoundaryPoint]) -> _Value:
        named = value.quantity.unit if unit is None else unit
        if low < high:
            return value._replace(quantity=boundary_area(_between(points, low, high), named))
        why = "the boundaries cover no common range of dampings"
        return value._replace(quantity=Quantity(value=None, unit=named, reason=why))

    both = zip(values, boundaries, strict=True)
    return [[area(value, points) if value.name == AREA else value for value in side] for side, points in both]


def _scaled(point: BoundaryPoint, scale: Scale) -> BoundaryPoint:
    """Return a point of a boundary in the units of a plane."""

    def stiffness(value: float | None) -> float | None:
        return None if value is None else value / scale[0]

    return BoundaryPoint(
        damping=point.damping / scale[1],
        stable=stiffness(point.stable),
        unstable=stiffness(point.unstable),
        censored=point.censored,
        estimate=stiffness(point.estimate),
        low=stiffness(point.low),
        high=stiffness(point.high),
        trials=point.trials,
        undecided=point.undecided,
        stiffness_large_motion=stiffness(point.stiffness_large_motion),
        truth=stiffness(point.truth),
    )


def _between(points: Sequence[BoundaryPoint], low: float, high: float) -> list[BoundaryPoint]:
    """Return the part of a boundary between two dampings. Its end points are interpolated linearly."""
    ordered = sorted(points, key=lambda point: point.damping)
    damping = [point.damping for point in ordered]
    ends = [_at(ordered, B) for B in (low, high) if not np.isclose(damping, B, rtol=SAME_DAMPING, atol=0.0).any()]
    reach = SAME_DAMPING * max(abs(low), abs(high))
    inside = [point for point in ordered if low - reach <= point.damping <= high + reach]
    return sorted([*inside, *ends], key=lambda point: point.damping)


def _at(ordered: Sequence[BoundaryPoint], damping: float) -> BoundaryPoint:
    """Return a boundary interpolated between two of its points. A value that one of them lacks is unknown."""
    place = int(np.searchsorted([point.damping for point in ordered], damping))
    before, behind = ordered[place - 1], ordered[place]
    share = (damping - before.damping) / (behind.damping - before.damping)
    values: dict[str, float | None] = {}
    for name in ("stable", "unstable", "estimate", "low", "high"):
        ends = getattr(before, name), getattr(behind, name)
        values[name] = None if None in ends else (1 - share) * ends[0] + share * ends[1]
    return BoundaryPoint(damping=damping, censored=before.censored or behind.censored, **values)


def _point(values: Mapping[str, Any]) -> BoundaryPoint:
    return BoundaryPoint(**{name: value for name, value in values.items() if name in BoundaryPoint.model_fields})


class _Value(NamedTuple):
    """Comparable value of a document, with the theory to which a score refers."""

    part: Literal["estimates", "optima", "scores"]
    name: str
    quantity: Quantity
    basis: str = ""


def _quantity(values: Document) -> Quantity:
    known = ("unit", "value", "low", "high", "reason")
    return Quantity.model_validate({key: values[key] for key in known if key in values})


def _values(of: Document, wall: tuple[str, str], scale: Scale | None) -> Iterator[_Value]:
    """Yield the comparable values of a document."""
    for name, e in of["estimates"].items():
        if name != "delay_samples":
            yield _Value("estimates", name, _quantity(e))
            continue
        why = "its interval is the range of the trials"  # not the error of the mean
        yield _Value("estimates", name, Quantity(value=e["value"], unit=e["unit"], reason=why))
        if (model := e.get("by_method", {}).get("model")) is not None:
            yield _Value("estimates", "delay_by_model", _quantity(model))
    for criterion, best in of["optimum"].items():
        for name, unit, by in zip(("stiffness", "damping"), wall, scale or (1.0, 1.0), strict=True):
            place = Quantity(value=best[name] / by, unit=unit, reason="the location of an optimum has no interval")
            yield _Value("optima", f"{criterion}/{name}", place)
        cost = Quantity(value=best["cost"], low=best.get("cost_low"), high=best.get("cost_high"))
        yield _Value("optima", f"{criterion}/cost", cost)
    for scores in of.get("scores", ())[:1]:
        basis = f"against theory by the {scores['basis']}"
        for part, names in _SCORES.items():
            found = scores.get(part)
            for name in names if found else ():
                low, high = found.get(f"{name}_low"), found.get(f"{name}_high")
                yield _Value("scores", f"{part}/{name}", Quantity(value=found[name], low=low, high=high), basis)


def compare_values(first: Sequence[_Value], second: Sequence[_Value], two_devices: bool) -> list[ValueDifference]:
    """Return the differences of all values that both documents have, with a 95 % interval if both values have one.

    The parameters of two devices are listed but not compared.
    """
    others = {(value.part, value.name): value for value in second}
    return [
        _difference(value, others[key], two_devices and value.part == "estimates" and value.name != AREA)
        for value in first
        if (key := (value.part, value.name)) in others
    ]


def _difference(one: _Value, other: _Value, devices_differ: bool) -> ValueDifference:
    a, b = one.quantity, other.quantity
    difference = low = high = significant = reason = None
    if devices_differ:
        reason = "devices differ"
    elif a.value is None or b.value is None:
        reason = a.reason if a.value is None else b.reason
    elif a.unit != b.unit or one.basis != other.basis:
        reason = f"one is {one.basis or a.unit}, the other {other.basis or b.unit}"
    else:
        difference = b.value - a.value
        if a.low is None or a.high is None or b.low is None or b.high is None:
            reason = a.reason or b.reason or "no interval on both sides"
        else:
            low, high = difference_interval((a.value, a.low, a.high), (b.value, b.low, b.high))
            significant = not low <= 0 <= high
    return ValueDifference(
        part=one.part,
        name=one.name,
        unit=a.unit if a.unit == b.unit else f"{a.unit} and {b.unit}",
        first=a.value,
        second=b.value,
        difference=difference,
        low=low,
        high=high,
        significant=significant,
        reason=reason,
    )


def difference_interval(a: Sequence[float], b: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % interval of b - a for two independent values (value, lower and upper end of their intervals).

    The half widths are added in quadrature. Because an interval may be asymmetric, the upper half width of b is
    combined with the lower one of a, and vice versa.
    """
    (x, x_low, x_high), (y, y_low, y_high) = a, b
    return y - x - hypot(y - y_low, x_high - x), y - x + hypot(y_high - y, x - x_low)


def compare_boundaries(
    first: Sequence[BoundaryPoint], second: Sequence[BoundaryPoint], first_scale: Scale, second_scale: Scale
) -> tuple[BoundaryDifference | None, str | None]:
    """Return the difference of two boundaries, or the reason why there is none.

    It is computed at the dampings of the first boundary that both boundaries cover. A limit comes from the growth rates
    if they determine it, otherwise from the middle between stable and unstable trials. Censored points, which are lower
    bounds, are left out. The second boundary is interpolated linearly.
    """
    a, b = (_limits(points, scale) for points, scale in ((first, first_scale), (second, second_scale)))
    for which, side, limits in (("first", first, a), ("second", second, b)):
        if not len(limits):
            return None, f"the {which} boundary has no limits: {_without_limits(side)}"
    if len(b) < 2:
        return None, "the second boundary has a limit at one damping only, but interpolation needs two"
    a = a[(a[:, 0] >= b[0, 0]) & (a[:, 0] <= b[-1, 0]) & (a[:, 1] > 0)]
    if not len(a):
        return None, "the boundaries cover no common damping"
    x, x_low, x_high = a[:, 1:].T
    y, y_low, y_high = (np.interp(a[:, 0], b[:, 0], b[:, k]) for k in (1, 2, 3))
    percent = 100 * (y - x) / x
    low, high = y - x - np.hypot(y - y_low, x_high - x), y - x + np.hypot(y_high - y, x - x_low)
    known = np.isfinite(low) & np.isfinite(high)
    differs = known & ((low > 0) | (high < 0))
    worst = int(np.argmax(np.abs(percent)))
    rows = zip(*(v.tolist() for v in (a[:, 0], x, y, percent, differs, known)), strict=True)
    points = tuple(
        LimitDifference(damping=d, first=one, second=other, percent=p, significant=s if k else None)
        for d, one, other, p, s, k in rows
    )
    return BoundaryDifference(
        median_percent=float(np.median(percent)),
        largest_percent=float(percent[worst]),
        largest_damping=float(a[worst, 0]),
        judged=int(known.sum()),
        significant=int(differs.sum()),
        interpolated=not bool(np.isin(a[:, 0], b[:, 0]).all()),
        points=points,
    ), None


def _without_limits(points: Sequence[BoundaryPoint]) -> str:
    """Return the reason why a boundary has no limits."""
    if not points:
        return "no wall was tried (K > 0)"
    if all(point.stable is None and point.unstable is None for point in points):
        return "all trials are undecided"
    if all(point.unstable is None for point in points):
        return "no trial was unstable up to the end of the tested ranges"
    return "no damping has both a certainly stable and a certainly unstable trial"


def _limits(points: Sequence[BoundaryPoint], scale: Scale) -> Floats:
    """Return damping, limit and both ends of its interval, sorted by damping, shape (n, 4).

    The ends are NaN if a limit has no interval.
    """
    rows = []
    for p in points:
        if p.estimate is not None and p.low is not None and p.high is not None:
            rows.append((p.damping, p.estimate, p.low, p.high))
        elif p.stable is not None and p.unstable is not None and not p.censored:
            rows.append((p.damping, (p.stable + p.unstable) / 2, np.nan, np.nan))
    found = np.array(sorted(rows), dtype=np.float64).reshape(-1, 4)
    return np.asarray(found / np.array([scale[1], *[scale[0]] * 3]), dtype=np.float64)


def compare_costs(first: Trials, second: Trials) -> tuple[CostDifference, ...]:
    """Return, for each criterion, the median ratio of second to first costs at equal (K, B).

    Several trials at one (K, B) are represented by their median. The interval of the median is a rank interval
    (binomial), which makes no assumption about the distribution of the ratios.
    """
    return tuple(_cost_difference(c, first[c], second[c]) for c in first if c in second)


def _cost_difference(
    criterion: str, first: tuple[Floats, Floats, Floats], second: tuple[Floats, Floats, Floats]
) -> CostDifference:
    import pandas as pd

    differs = bool(criterion_of(criterion).family.levels)
    a, b = (
        pd.DataFrame(dict(zip(("K", "B", "cost"), of, strict=True))).dropna().groupby(["K", "B"])["cost"].median()
        for of in (first, second)
    )
    both = pd.concat([a, b], axis=1, join="inner", keys=["x", "y"])
    both = both if differs else both[both["x"] > 0]
    values = np.sort((both["y"] - both["x"] if differs else both["y"] / both["x"]).to_numpy())
    median = low = high = significant = reason = None
    if len(values):
        median = float(np.median(values))
    if not len(values):
        reason = "the experiments have no trials with this cost at equal stiffness and damping"
    elif len(values) < FEWEST_POINTS:
        reason = f"an interval needs at least {FEWEST_POINTS} points"
    else:
        # The ranks of the interval's ends follow from the normal approximation of the binomial distribution, rounded
        # outwards.
        half = NORMAL_95 * np.sqrt(len(values)) / 2
        low = float(values[max(int(np.floor(len(values) / 2 - half)) - 1, 0)])
        high = float(values[min(int(np.ceil(len(values) / 2 + half)), len(values) - 1)])
        significant = not low <= (0.0 if differs else 1.0) <= high
    return CostDifference(
        criterion=criterion,
        kind="difference" if differs else "ratio",
        points=len(values),
        median=median,
        low=low,
        high=high,
        significant=significant,
        reason=reason,
    )


def against_experiments(
    processed: Path,
    first: tuple[str, str],
    second: tuple[str, str],
    criteria: Sequence[str] | None = None,
    notes: tuple[Sequence[Note], Sequence[Note]] = ((), ()),
) -> AgainstPage:
    """Compare two stored experiments of one device, or of two devices in the plane of alpha and beta.

    Parameters
    ----------
    processed : Path
    first, second : (device, experiment)
    criteria : sequence of str, optional
        Names of the criteria. The default is all.
    notes : (sequence of Note, sequence of Note)
        Notes of users on each side. The page repeats them.

    Raises
    ------
    UsageError
        If both experiments are the same, or the plane of alpha and beta lacks a mass.
    DeviceError
        If an experiment is not stored.
    """
    if first == second:
        raise UsageError(
            f"device {first[0]!r}, experiment {first[1]!r}: an experiment cannot be compared with itself. Give another "
            "experiment."
        )
    found = []
    for number, ((device, experiment), remarks) in enumerate(zip((first, second), notes, strict=True)):
        what = f"device {device}, experiment {experiment}: estimates and costs"
        with part_of_work(what, number / 2, (number + 1) / 2):
            found.append(_gathered(open_scene(device, processed, [experiment], criteria), remarks))
    one, other = found
    labels, results, motion = (one.side.label, other.side.label), (one.result, other.result), one.data.motion
    scales = None if first[0] == second[0] else (one.scale, other.scale)
    documents = one.result.model_dump(mode="json"), other.result.model_dump(mode="json")
    pair = compare_pair((one.side, other.side), documents, motion, scales, (one.trials, other.trials))
    if scales is None:
        figure = _overlay(labels, [result.boundary for result in results], motion)
    elif one.theory is None or other.theory is None:
        both = zip(results, scales, strict=True)
        limits = [[_scaled(point, scale) for point in result.boundary] for result, scale in both]
        figure = _overlay(labels, limits, motion, names=("α = K T²/m", "β = B T/m"))
    else:
        figure = plane_figure([(labels[0], results[0], one.theory, 0), (labels[1], results[1], other.theory, 1)])
    return AgainstPage(AgainstResult(title=" against ".join(labels), pairs=(pair,)), (figure,), motion)


def against_document(new: ComparisonResult, old: Document) -> AgainstPage:
    """Compare a result with the document of an earlier result of its device, for example by another code version."""
    now = new.model_dump(mode="json")
    before, after = ({e["experiment"]: e for e in of["experiments"]} for of in (old, now))
    common = [name for name in before if name in after]
    pairs: list[PairDifference] = []
    figures: list[Figure] = []
    for name in common:
        sides, documents = (_side(old, before[name]), _side(now, after[name])), (before[name], after[name])
        pairs.append(compare_pair(sides, documents, new.motion))
        limits = [[_point(p) for p in each["boundary"]] for each in documents]
        figures.append(_overlay([f"{name}, before", f"{name}, now"], limits, new.motion, f"-{len(figures)}"))
    versions = [f"version {of['provenance'].get('version', '?')} ({_code(of)})" for of in (old, now)]
    result = AgainstResult(
        title=f"{new.device}: {versions[0]} against {versions[1]}",
        pairs=tuple(pairs),
        only_first=tuple(name for name in before if name not in after),
        only_second=tuple(name for name in after if name not in before),
    )
    return AgainstPage(result, tuple(figures), new.motion)


def read_document(path: Path, device: str) -> Document:
    """Read the document of an earlier result of a device.

    Raises
    ------
    UsageError
        If the file is not a document of `compare`, or belongs to another device.
    """
    try:
        found = json.loads(path.read_bytes())
        for each in found["experiments"]:
            list(_values(each, ("", ""), None))
            [_point(p) for p in each["boundary"]]
        _side(found | {"provenance": found.setdefault("provenance", {})}, {"experiment": ""})
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error}). Give the JSON document of a report.") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{path}: is not a result of `pipeline compare` ({type(error).__name__}: {str(error)[:200]}). Give the "
            "JSON document of a report."
        ) from error
    if found["device"] != device:
        raise UsageError(f"{path}: the result belongs to device {found['device']!r}; expected device {device!r}.")
    return dict(found)


def names_of(words: str, device: str, experiments: Sequence[str]) -> tuple[str, str]:
    """Return the device and experiment that ``--against`` names, as ``EXPERIMENT`` or ``DEVICE:EXPERIMENT``.

    ``experiments`` are the stored experiments of the first device. Their names may contain a colon."""
    if words in experiments or ":" not in words:
        return device, words
    other, _, experiment = words.partition(":")
    return other, experiment


@dataclass(frozen=True)
class _Gathered:
    """A stored experiment with its name, scene, result and theory."""

    side: Side
    data: StoredData
    result: ExperimentNumbers
    theory: Theory | None

    @property
    def trials(self) -> Trials:
        """Costs of its trials, by criterion."""
        stages = self.data.experiments[0]
        K, B, _ = trials_of(stages)
        return {criterion: (K, B, stages.cost(criterion)[0]) for criterion in self.data.scene.criteria}

    @property
    def scale(self) -> Scale:
        """Stiffness and damping that correspond to alpha = 1 and beta = 1.

        They only need mass and sampling period, from the device file or otherwise from the estimate. The loop need not
        have a theory (for example, because of friction).
        """
        if self.theory is not None:
            return self.theory.units.stiffness, self.theory.units.damping
        stages = self.data.experiments[0]
        fitted = stages.once(identified_loop)
        mass = fitted.estimate("mass", "kg").value if fitted is not None else None
        if mass is None or not mass > 0:
            why = self.result.estimates["mass"].reason or "the mass is not identifiable from its logs"
            raise UsageError(
                f"device {self.side.device!r}, experiment {self.side.experiment!r}: two devices are compared in the "
                "plane of alpha and beta, which needs a mass. There is no device file with this experiment, and the "
                f"mass cannot be estimated: {why.rstrip('.')}."
            )
        units = LoopUnits(mass, stages.sampling_period_s)
        return units.stiffness, units.damping


def _gathered(data: StoredData, notes: Sequence[Note]) -> _Gathered:
    name = data.experiments[0].experiment
    result = experiment_numbers(data, data.experiments[0], nominal_theories(data).get(name))
    side = Side(
        device=data.scene.device,
        experiment=name,
        version=__version__,
        code=code_digest("report"),
        excluded=excluded_trials(data),
        notes=tuple(notes),
        simulated=data.simulated,
    )
    return _Gathered(side, data, result, Theory(result.theory) if result.theory else None)


def _code(of: Document) -> str:
    return str(of["provenance"].get("code", of["provenance"].get("key", "?")))


def _side(of: Document, experiment: Document) -> Side:
    name, known = experiment["experiment"], ExcludedTrial.model_fields
    excluded = ({key: value for key, value in one.items() if key in known} for one in of.get("excluded", ()))
    return Side(
        device=str(of["device"]),
        experiment=name,
        version=of["provenance"].get("version", "?"),
        code=_code(of),
        excluded=tuple(ExcludedTrial(**one) for one in excluded if one["experiment"] == name),
        simulated=experiment.get("simulated", False),
    )


def _overlay(
    labels: Sequence[str],
    limits: Sequence[Sequence[BoundaryPoint]],
    motion: Motion,
    suffix: str = "",
    names: tuple[str, str] | None = None,
) -> Figure:
    both = enumerate(zip(limits, labels, strict=True))
    series = [s for number, (points, label) in both for s in measured(points, label, number, intervals=True)]
    panel = limits_panel("", series, motion, names)
    if names is not None:
        panel = replace(panel, words=f"Stability limits in the normalised plane: {listed(labels)}.")
    title, caption = (
        f"Boundaries of {labels[0]} and {labels[1]}",
        "Measured limit at each damping with its 95 % interval. Open marks are lower bounds.",
    )
    return limits_figure(title, caption, [panel], f"boundaries-against{suffix}")

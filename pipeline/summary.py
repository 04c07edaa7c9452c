"""A comparison in a few sentences with numbers, and the warnings that belong before them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isclose

from pipeline.labels import CRITERION_NAMES, UNITS, estimate_texts
from pipeline.models import ComparisonRow, Device
from pipeline.predictions import Theory
from pipeline.results import ExperimentResult
from pipeline.scene import SceneData

FEW_TRIALS = 30
"""Trials below which an optimum or a boundary says little."""

PERIOD_TOLERANCE = 0.01
"""Relative difference of sampling periods that no result shows: K scales with 1/T^2, B with 1/T."""

SHOWN = 3
"""Experiments and criteria that get a sentence of their own; the tables hold all."""


def summarise(
    data: SceneData,
    results: Sequence[ExperimentResult],
    rows: Sequence[ComparisonRow],
    theories: Mapping[str, Theory],
) -> tuple[str, ...]:
    """Return the key results: parameters, largest stable stiffness, optimal costs against theory."""
    rotation = data.experiments[0].rotation
    units = UNITS["rotation" if rotation else "translation"]
    sentences = []
    for result in results[:SHOWN]:
        text = _estimates(result)
        if text:
            sentences.append(f"Experiment {result.experiment}: {text}.")
    for result in results[:SHOWN]:
        stable = [(p.stable, p.damping) for p in result.boundary if p.stable is not None]
        if not stable:
            continue
        stiffness, damping = max(stable)
        text = (
            f"Experiment {result.experiment}: the largest stable stiffness measured is {stiffness:.0f} "
            f"{units.stiffness} "
            f"(at B = {damping:g} {units.damping})"
        )
        theory = theories.get(result.experiment)
        if theory:
            predicted = theory.boundary.alpha_max * theory.units.stiffness
            where = theory.boundary.beta_at_alpha_max * theory.units.damping
            text += f", theory says {predicted:.0f} {units.stiffness} at {where:.3g} {units.damping}"
            text += f" ({_percent(stiffness / predicted - 1)})"
        sentences.append(text + ".")
    deviations = [r for r in rows if r.deviation_percent is not None]
    if deviations:
        smallest = min(deviations, key=_size)
        largest = max(deviations, key=_size)
        median = sorted(_size(r) for r in deviations)[len(deviations) // 2]
        sentences.append(
            f"Optimal costs differ from the discrete theory by {median:.0f} % in the median of {len(deviations)} "
            f"comparisons: least for {_named(smallest)} ({_tenths(smallest.deviation_percent)} %), most for "
            f"{_named(largest)} ({_tenths(largest.deviation_percent)} %)."
        )
    if not sentences:
        trials = sum(r.trials for r in results)
        sentences.append(
            f"{trials} {'trial is' if trials == 1 else 'trials are'} stored, from which neither parameters nor costs "
            "follow; the reasons are below."
        )
    return tuple(sentences)


def _percent(share: float) -> str:
    """Signed whole percent, without a sign for zero."""
    rounded = round(100 * share)
    return f"{rounded:+d} %" if rounded else "0 %"


def _tenths(percent: float | None) -> str:
    """Signed percent with one decimal, without a sign for zero."""
    rounded = round(percent or 0.0, 1)
    return f"{rounded:+.1f}" if rounded else "0.0"


def _size(row: ComparisonRow) -> float:
    return abs(row.deviation_percent or 0.0)


def _named(row: ComparisonRow) -> str:
    name = CRITERION_NAMES.get(row.criterion, row.criterion)
    where = f"d = {row.delay_samples:g}" if row.condition == "experiment" else row.condition.replace("_", " ")
    return f"{name}, {where}"


def _estimates(result: ExperimentResult) -> str:
    names = {"delay_samples": "delay d", "mass": "mass", "damping": "viscous damping"}
    parts = []
    for key, name in names.items():
        estimate = result.estimates[key]
        if estimate.value is None:
            continue
        value, low, high = estimate_texts(estimate)
        text = f"{name} {value} {estimate.unit.replace('^2', '²')}"
        if low and high:
            text += f" (95 %: {low} to {high})"
        parts.append(text)
    return ", ".join(parts)


def warnings_of(data: SceneData, results: Sequence[ExperimentResult], rows: Sequence[ComparisonRow]) -> tuple[str, ...]:
    """Return what a reader must know before trusting the numbers."""
    warnings = []
    mixed = [r.experiment for r in results if r.simulated]
    if mixed and len(mixed) < len(results):
        warnings.append(f"Simulated logs stand beside recorded ones: experiments {', '.join(mixed)} are simulated.")
    few = [r.experiment for r in results if r.trials < FEW_TRIALS]
    if few:
        warnings.append(
            f"Fewer than {FEW_TRIALS} trials in experiment {', '.join(few)}: boundary and optima say little."
        )
    edge = sorted({f"{r.experiment}" for r in results for o in r.optimum.values() if o.censored})
    if edge:
        warnings.append(
            f"Optima at the edge of the tested range in experiment {', '.join(edge)}: the true optimum may lie beyond "
            "it; such rows are marked."
        )
    open_end = [r.experiment for r in results if any(p.censored for p in r.boundary)]
    if open_end:
        warnings.append(
            f"The tested stiffness range ended before a trial was unstable in experiment {', '.join(open_end)}: the "
            "boundary there is a lower bound."
        )
    for result in results:
        for name, estimate in result.estimates.items():
            if estimate.value is None and "left out" not in (estimate.reason or ""):
                quantity = name.removesuffix("_samples").replace("_", " ")
                warnings.append(f"Experiment {result.experiment}: no {quantity} estimate ({estimate.reason}).")
            elif estimate.warning:
                quantity = name.removesuffix("_samples").replace("_", " ")
                warnings.append(f"Experiment {result.experiment}, {quantity}: {estimate.warning}.")
    if data.device is not None:
        warnings += _conflicts(data, data.device)
    else:
        warnings.append(
            f"The device {data.scene.device!r} has no device file: theory uses the parameters estimated from its logs."
        )
    return tuple(warnings)


def _conflicts(data: SceneData, device: Device) -> list[str]:
    """Where the logs of a known device do not fit its device file, so that theory speaks of something else."""
    texts = []
    known = {e.name for e in device.experiments}
    foreign = [name for name in data.scene.experiments if name not in known]
    if foreign:
        texts.append(
            f"The device file of {device.name!r} has no experiment {', '.join(foreign)}: its tables have no theory, "
            "only the curves from its estimates."
        )
    for stages in data.experiments:
        periods = set(stages.trials.column("sampling_period_s").to_pylist())
        other = sorted(p for p in periods if not isclose(p, device.sampling_period_s, rel_tol=PERIOD_TOLERANCE))
        if other:
            texts.append(
                f"Experiment {stages.experiment} was sampled every {other[0]:g} s, but theory takes "
                f"{device.sampling_period_s:g} s from the device file."
            )
    return texts

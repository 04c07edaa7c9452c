"""What a reader must know before trusting the numbers of a comparison, gravest first."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from math import isclose

import numpy as np

from pipeline.base.wording import counted, listed, percent, true_minus
from pipeline.comparison.figures.boundary_curves import too_late
from pipeline.comparison.scene.scene import SceneData
from pipeline.loop.loop import LARGEST_DELAY
from pipeline.records.criteria import ENERGY, members
from pipeline.records.findings import DRIFTS, Estimate, Trend
from pipeline.records.models import Device
from pipeline.records.results import ExperimentResult
from pipeline.rendering.labels import percent_text
from pipeline.store.storage import natural_key

Drift = tuple[str, Estimate, Trend]
"""Experiment, its estimate, and a trend of that which is worth a warning."""

QUANTITIES = {
    "damping": "viscous damping",
    "jitter": "jitter of the delay",
    "implied delay": "delay implied by the boundary",
}
"""Names of estimates that could be taken for something else."""

NEEDED = ("mass", "damping", "delay")
"""Estimates that theory needs: what else is missing stands with its reason in the table of methods."""

_ASIDE, _NUMBER = re.compile(r" \([^()]*\)"), re.compile(r"\d[\d.e+−-]*")
"""What tells equal warnings of several experiments apart."""

FEW_TRIALS = 30
"""Trials below which an optimum or a boundary says little."""

PERIOD_TOLERANCE = 0.01
"""Relative difference of sampling periods that no result shows: K scales with 1/T^2, B with 1/T."""

BAD_FITS = 0.2
"""Share of trials that the model does not explain from which on it is named: chance leaves 5 % of them unexplained."""

EXTRAPOLATED = 0.05
"""Share of an optimal energy cost beyond the horizon of the log from which on it is named."""


def warnings_of(data: SceneData, results: Sequence[ExperimentResult]) -> tuple[str, ...]:
    """Return what a reader must know before trusting the numbers; nothing where there is nothing to say."""
    warnings = []
    mixed = [r.experiment for r in results if r.simulated]
    if mixed and len(mixed) < len(results):
        warnings.append(f"Simulated logs stand beside recorded ones: those of {_named(mixed)} are simulated.")
    if data.excluded:
        where = _named(sorted({one.experiment for one in data.excluded}, key=natural_key))
        verb = "was" if len(data.excluded) == 1 else "were"
        warnings.append(
            f"{counted(len(data.excluded), 'trial')} of {where} {verb} excluded by hand and {verb} used for no number: "
            "the table of excluded trials has the reasons."
        )
    few = [r.experiment for r in results if r.trials < FEW_TRIALS]
    if few:
        where = _named(few, len(results))
        warnings.append(f"Fewer than {FEW_TRIALS} trials in {where}: boundary and optima say little.")
    warnings += [w for w in map(_bad_fits, results) if w]
    warnings += _extrapolated(data, results)
    edge = sorted({f"{r.experiment}" for r in results for o in r.optimum.values() if o.censored})
    if edge:
        warnings.append(
            f"Optima at the edge of the tested range in {_named(edge, len(results))}: the true optimum may lie beyond "
            "it; such rows are marked."
        )
    open_end = [r.experiment for r in results if any(p.censored for p in r.boundary)]
    if open_end:
        warnings.append(
            f"The tested stiffness range ended before a trial was unstable in {_named(open_end, len(results))}: the "
            "boundary there is a lower bound."
        )
    if data.device is not None:
        warnings += _conflicts(data, data.device, results)
    else:
        by = "theory uses the parameters estimated from its logs" if any(map(_has_theory, results)) else "no theory"
        warnings.append(f"The device {data.scene.device!r} has no device file: {by}.")
    warnings += _estimates(results)
    return tuple(warnings)


def _estimates(results: Sequence[ExperimentResult]) -> list[str]:
    """What is missing or doubtful among the estimates, one sentence each for all drifts and for each quantity.

    Single numbers stand as remarks in the table of methods.
    """
    missing: dict[tuple[str, str], list[str]] = {}
    doubtful: dict[str, dict[str, list[tuple[str, str]]]] = {}
    drifts: dict[tuple[str, str], list[Drift]] = {}
    for result in results:
        for name, estimate in result.estimates.items():
            quantity = name.removesuffix("_samples").replace("_", " ")
            if estimate.value is None and quantity in NEEDED and "left out" not in (estimate.reason or ""):
                missing.setdefault((quantity, estimate.reason or ""), []).append(result.experiment)
            elif estimate.value is not None and estimate.warning:
                # a warning is made of clauses, those about drifts as their trends tell them
                clauses = estimate.warning.split("; ")
                others = "; ".join(clause for clause in clauses if not clause.startswith(DRIFTS))
                if others:
                    cases = doubtful.setdefault(_NUMBER.sub("", _ASIDE.sub("", others)), {})
                    cases.setdefault(QUANTITIES.get(quantity, quantity), []).append((result.experiment, others))
                told = [clause for clause in clauses if clause.startswith(DRIFTS)]
                for trend in estimate.trend:
                    if any(f"the tested {trend.over} " in clause for clause in told):
                        drifts.setdefault((quantity, trend.over), []).append((result.experiment, estimate, trend))
    total = len(results)
    late = [result.experiment for result in results if too_late(result.estimates["delay_samples"])]
    beyond = f"the delay is longer than the {LARGEST_DELAY} samples that theory is computed for"
    found = [f"{_of(late, total)}: {beyond}; there is none from its estimates."] if late else []
    found += [f"{_of(names, total)}: no {quantity} estimate ({why})." for (quantity, why), names in missing.items()]
    found += _drifts(drifts, total)
    return found + [text for cases in doubtful.values() for text in _doubts(cases, total)]


def _doubts(cases: Mapping[str, Sequence[tuple[str, str]]], experiments: int) -> Iterator[str]:
    """Yield what makes estimates doubtful: a sentence for all quantities of the same experiments.

    Of several experiments the numbers of the first are told; the others stand in the table of methods.
    """
    together: dict[tuple[str, ...], list[str]] = {}
    for quantity, found in cases.items():
        together.setdefault(tuple(name for name, _ in found), []).append(quantity)
    for names, quantities in together.items():
        told = [warning for quantity in quantities for _, warning in cases[quantity]]
        same = len({_ASIDE.sub("", warning) for warning in told}) == 1
        first = told[0] if len(told) == 1 else _ASIDE.sub("", told[0])
        text = f"{listed(quantities)} of {_named(names, experiments)}: {first}{'' if same else ', or similar'}."
        yield text[0].upper() + text[1:]


def _drifts(found: Mapping[tuple[str, str], Sequence[Drift]], experiments: int) -> list[str]:
    """One sentence: which estimates drift over what, in which experiments, and how much at most."""
    parts = []
    for (quantity, over), cases in found.items():
        name, estimate, trend = max(cases, key=lambda case: abs(_change(case)))
        where = _named([case[0] for case in cases], experiments)
        most = f"most in {name}: " if len(cases) > 1 else ""
        parts.append(f"{QUANTITIES.get(quantity, quantity)} over {over} in {where} ({most}{_amount(estimate, trend)})")
    if not parts:
        return []
    return [
        f"Estimates drift with the setting of the wall, so that the model does not hold for all trials: "
        f"{'; '.join(parts)}."
    ]


def _change(case: Drift) -> float:
    """Change over the tested range, relative to the value where that is not zero."""
    _, estimate, trend = case
    return trend.slope * (trend.span or 0.0) / (estimate.value or 1.0)


def _amount(estimate: Estimate, trend: Trend) -> str:
    """Change over the tested range: in percent where the value is surely not zero."""
    change = trend.slope * (trend.span or 0.0)
    if estimate.value and estimate.low and estimate.high and estimate.low * estimate.high > 0:
        return f"{percent_text(100 * change / estimate.value)} %"
    return true_minus(f"{change:+.3g} {estimate.unit}")


def _of(names: Sequence[str], experiments: int) -> str:
    text = _named(names, experiments)
    return text[0].upper() + text[1:]


def _named(names: Sequence[str], experiments: int = 0) -> str:
    """Name experiments, with the number of all where these are meant."""
    if len(names) == experiments > 2:
        return f"all {experiments} experiments"
    return f"experiment{'s' if len(names) > 1 else ''} {listed(names)}"


def _bad_fits(result: ExperimentResult) -> str:
    check = result.model_check
    if check is None or not check.trials or check.trials - check.explained < BAD_FITS * check.trials:
        return ""
    left_out = result.theory.loop.left_out if result.theory else []
    what = f"theory leaves out its {listed(left_out)}" if left_out else "theory may be that of another device"
    other = f"; {what}" if _has_theory(result) else ""
    return (
        f"Experiment {result.experiment}: mass, damping and delay do not explain {check.trials - check.explained} of "
        f"{counted(check.trials, 'log')}{other}."
    )


def _has_theory(result: ExperimentResult) -> bool:
    return result.theory is not None


def _extrapolated(data: SceneData, results: Sequence[ExperimentResult]) -> list[str]:
    """Optimal energy costs of which much lies beyond the end of what was recorded."""
    found = []
    for result, stages in zip(results, data.experiments, strict=False):
        for criterion in members(ENERGY):
            best = result.optimum.get(criterion.name)
            if best is None or best.trial_id is None:
                continue
            row = stages.texts(ENERGY.name, "trial_id").index(best.trial_id)
            tail = stages.column(ENERGY.name, f"{criterion.column}_tail")[row]
            if np.isfinite(tail) and abs(tail) > EXTRAPOLATED * best.cost:
                found.append(
                    f"experiment {result.experiment}, w = {criterion.weight} ({percent(abs(tail) / best.cost)})"
                )
    if not found:
        return []
    return [f"Optimal energy costs that are partly extrapolated beyond the logs: {'; '.join(found)}."]


def _conflicts(data: SceneData, device: Device, results: Sequence[ExperimentResult]) -> list[str]:
    """Where the logs of a known device do not fit its device file, so that theory speaks of something else."""
    texts = []
    known = {e.name for e in device.experiments}
    foreign = [name for name in data.scene.experiments if name not in known]
    if foreign:
        texts.append(
            f"The device file of {device.name!r} has no experiment {', '.join(foreign)}: its tables have no theory, "
            "only the curves from its estimates."
        )
    shown = [e for e in device.experiments if e.name in data.scene.experiments]
    late = [e.name for e in shown if e.delay_samples > LARGEST_DELAY]
    if late:
        texts.append(
            f"The device file of {device.name!r} has a delay of more than the {LARGEST_DELAY} samples that theory is "
            f"computed for in {_named(late)}: there is no theory by it."
        )
    idle = [r.experiment for r in results if r.theory is None and r.experiment in known and r.experiment not in late]
    if idle:
        texts.append(
            f"No stiffness and damping stabilise the loop that the device file of {device.name!r} describes in "
            f"{_named(idle)}: there is no theory by it. Check its delay, lag and velocity filter."
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

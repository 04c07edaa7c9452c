"""Warnings about the results of a comparison, as codes and numbers. A template converts them to sentences."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from math import isclose
from pathlib import PurePath
from typing import Any

import numpy as np

from pipeline.comparison.loops.departures import OtherGains, other_gains
from pipeline.comparison.scene.scene import StoredData
from pipeline.loop.normalised_loop import LARGEST_DELAY
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.criteria import ENERGY, members
from pipeline.records.models import Device
from pipeline.records.results import ExperimentNumbers
from pipeline.rendering.labels import quantity_name
from pipeline.rendering.report.page_template import fill_template
from pipeline.store.storage import natural_key

NEEDED = ("mass", "damping", "delay_samples")
"""Estimates that theory needs. The table of methods lists other missing estimates with their reasons."""

FEW_TRIALS = 30
"""Smallest number of trials for a meaningful optimum or boundary."""

PERIOD_TOLERANCE = 0.01
"""Relative difference of sampling periods without visible effect. K is proportional to 1/T^2, B to 1/T."""

BAD_FITS = 0.2
"""Threshold for the share of unexplained trials. Above it, the share is reported. By chance, the model does not explain
5 % of the trials."""

EXTRAPOLATED = 0.05
"""Threshold for the share of an optimal energy cost beyond the end of the log. Above it, the share is reported."""

_ASIDE, _NUMBER = re.compile(r" \([^()]*\)"), re.compile(r"\d[\d.e+−-]*")
"""Parts in which equal warnings of several experiments may differ."""


def warnings_of(data: StoredData, results: Sequence[ExperimentNumbers]) -> tuple[str, ...]:
    """Return the warnings about the results, the most serious ones first, or () if there are none."""
    found = [*_of_trials(data, results), *_of_device(data, results), *_of_estimates(results)]
    text = fill_template("warnings.txt.j2", found=found, all=len(results), device=data.scene.device)
    return tuple(" ".join(line.split()) for line in text.splitlines() if line.strip())


def _of_trials(data: StoredData, results: Sequence[ExperimentNumbers]) -> Iterator[dict[str, Any]]:
    simulated = [r.experiment for r in results if r.simulated]
    if 0 < len(simulated) < len(results):
        yield {"code": "mixed", "experiments": simulated}
    if data.excluded:
        names = sorted({one.experiment for one in data.excluded}, key=natural_key)
        yield {"code": "excluded", "trials": len(data.excluded), "experiments": names}
    for r, stages in zip(results, data.experiments, strict=False):
        gains = stages.once(other_gains)
        if gains is not None and gains.few:
            yield {"code": "other_gains", "experiments": [r.experiment], "gains": gains, "cure": _cure(stages, gains)}
    for r in results:
        for fault in r.recording:
            if fault.severity != "note":
                yield {"code": "recording", "experiments": [r.experiment], "fault": fault}
        check = r.model_check if not any(fault.is_unsafe for fault in r.recording) else None
        if check is not None and check.trials and check.trials - check.explained >= BAD_FITS * check.trials:
            left_out = list(r.theory.loop.left_out) if r.theory else []
            unexplained = check.trials - check.explained
            about = {"experiments": [r.experiment], "unexplained": unexplained, "logs": check.trials}
            yield {"code": "bad_fits", **about, "theory": r.theory is not None, "left_out": left_out}
    kinds = {
        "few_trials": [r.experiment for r in results if r.trials < FEW_TRIALS],
        "edge": [r.experiment for r in results if any(o.censored for o in r.optimum.values())],
        "open_end": [r.experiment for r in results if any(p.censored and p.stable is not None for p in r.boundary)],
        "undecided": [r.experiment for r in results if any(p.censored and p.stable is None for p in r.boundary)],
    }
    counts = {r.experiment: r.trials for r in results}
    for code, names in kinds.items():
        if names:
            yield {"code": code, "experiments": names, "few": FEW_TRIALS, "trials": [counts[name] for name in names]}
    for result, stages in zip(results, data.experiments, strict=False):
        if walls := contradictory_walls(stages):
            yield {"code": "contradictory", "experiments": [result.experiment], "walls": walls}
    if parts := list(_extrapolated(data, results)):
        yield {"code": "extrapolated", "parts": parts}


def _cure(stages: ExperimentStages, gains: OtherGains) -> str:
    """Return the warning about the first log that follows another wall."""
    for text, path in zip(*(stages.trials.column(name).to_pylist() for name in ("extra", "source_path")), strict=True):
        if PurePath(path).name == gains.logs[0]:
            return str(json.loads(text or "{}").get("other_gains", ""))
    return ""


def contradictory_walls(stages: ExperimentStages) -> list[tuple[float, list[float]]]:
    """Return the dampings at which a wall was both stable and unstable, with the stiffnesses [N/m, Nm/rad]."""
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    verdict = stages.verdicts.verdict
    stable, unstable = (
        set(zip(B[chosen].tolist(), K[chosen].tolist(), strict=True))
        for chosen in ((K > 0) & (verdict == said) for said in ("stable", "unstable"))
    )
    found: dict[float, list[float]] = {}
    for damping, stiffness in sorted(stable & unstable):
        found.setdefault(damping, []).append(stiffness)
    return list(found.items())


def _extrapolated(data: StoredData, results: Sequence[ExperimentNumbers]) -> Iterator[tuple[str, float, float]]:
    """Yield experiment, weight, and share of the optimal energy costs beyond the end of the recording."""
    for result, stages in zip(results, data.experiments, strict=False):
        for criterion in members(ENERGY):
            best = result.optimum.get(criterion.name)
            if best is not None and best.trial_id is not None:
                row = stages.texts(ENERGY.name, "trial_id").index(best.trial_id)
                tail = stages.column(ENERGY.name, f"{criterion.column}_tail")[row]
                if np.isfinite(tail) and abs(tail) > EXTRAPOLATED * best.cost:
                    yield result.experiment, criterion.weight, 100 * abs(tail) / best.cost


def _of_device(data: StoredData, results: Sequence[ExperimentNumbers]) -> Iterator[dict[str, Any]]:
    """Yield warnings if the logs of a known device contradict its device file, so that theory does not apply."""
    device = data.device
    if device is None:
        yield {"code": "no_file", "theory": any(r.theory is not None for r in results)}
        return
    known = {e.name: e for e in device.experiments}
    late = {n: most for n in data.scene.experiments if n in known and (most := _too_late(device, n))}
    idle = [r.experiment for r in results if r.theory is None and r.experiment in known and r.experiment not in late]
    kinds = {"foreign": [n for n in data.scene.experiments if n not in known], "late": list(late), "idle": idle}
    most = min(late.values(), default=0)
    yield from ({"code": code, "experiments": names, "most": most} for code, names in kinds.items() if names)
    for stages in data.experiments:
        periods = sorted(set(stages.trials.column("sampling_period_s").to_pylist()))
        other = [p for p in periods if not isclose(p, device.sampling_period_s, rel_tol=PERIOD_TOLERANCE)]
        if other:
            about = {"experiments": [stages.experiment], "period": other[0], "file": device.sampling_period_s}
            yield {"code": "period", **about}


def _too_late(device: Device, name: str) -> float:
    """Return the longest delay that the theory covers if the delay of an experiment exceeds it, otherwise 0."""
    entry = next(e for e in device.experiments if e.name == name)
    return LARGEST_DELAY if entry.delay_samples > LARGEST_DELAY else 0.0


def _of_estimates(results: Sequence[ExperimentNumbers]) -> Iterator[dict[str, Any]]:
    """Yield warnings about missing or doubtful estimates. Equal warnings of several experiments are merged.

    Remarks on single values are in the table of methods.
    """
    late = [r.experiment for r in results if too_late(r)]
    if late:
        yield {"code": "delay_too_long", "experiments": late, "most": LARGEST_DELAY}
    missing: dict[tuple[str, str], list[str]] = {}
    drifts: dict[str, list[str]] = {}
    doubts: dict[str, dict[str, Any]] = {}
    for result in results:
        if any(fault.is_unsafe for fault in result.recording) and all(
            each.value is None for each in result.estimates.values()
        ):
            continue  # a separate warning reports the fault
        for name, estimate in result.estimates.items():
            quantity, reason = quantity_name(name), estimate.reason or ""
            if estimate.value is None and name in NEEDED and estimate.missing_code != "left_out":
                missing.setdefault((quantity, reason), []).append(result.experiment)
            found = estimate.doubts if estimate.value is not None else ()
            if any(doubt.code == "drift" for doubt in found):
                drifts.setdefault(quantity, []).append(result.experiment)
            others = "; ".join(doubt.text for doubt in found if doubt.code != "drift")
            if others:
                doubt = doubts.setdefault(
                    _NUMBER.sub("", _ASIDE.sub("", others)), {"quantities": [], "experiments": [], "texts": []}
                )
                for key, value in (("quantities", quantity), ("experiments", result.experiment), ("texts", others)):
                    doubt[key] += [value] if value not in doubt[key] else []
    for (quantity, reason), names in missing.items():
        yield {"code": "missing", "quantity": quantity, "reason": reason.rstrip("."), "experiments": names}
    if drifts:
        yield {"code": "drifts", "drifts": drifts}
    for doubt in doubts.values():
        texts = list(dict.fromkeys(_ASIDE.sub("", text) for text in doubt["texts"]))
        yield {"code": "doubt", **doubt, "texts": doubt["texts"] if len(doubt["texts"]) == 1 else texts}


def too_late(result: ExperimentNumbers) -> bool:
    """Return whether a delay, or the upper end of its interval, exceeds the longest delay that the theory covers."""
    delay = result.estimates["delay_samples"]
    return max(value for value in (delay.value, delay.high, 0.0) if value is not None) > LARGEST_DELAY

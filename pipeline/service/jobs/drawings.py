"""Drawings of pages, by the functions that draw reports: an experiment, limits of several, trials over each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.base.errors import DeviceError
from pipeline.comparison.figures.responses import overlaid_figure, response_figures, trial_figure, trials_of
from pipeline.comparison.scene.scene import open_scene
from pipeline.device_data.devices import declared_spring, known_devices
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.results import ComparisonResult
from pipeline.rendering.figures.boundaries import (
    answer_figure,
    by_theory,
    limits_figure,
    limits_panel,
    measured,
    plane_figure,
)
from pipeline.rendering.figures.drawing import Figure, draw
from pipeline.rendering.labels import significant
from pipeline.theory.predictions import Theory

Drawn = dict[str, Any]
"""Panels as SVG, what they show in numbers, and the words below."""


def of_experiment(processed: Path, result: ComparisonResult) -> dict[str, Drawn]:
    """Return the first figures of the report of an experiment by name: limits with theory, and a response."""
    (found,) = result.experiments
    data = open_scene(result.device, processed, [found.experiment], None)
    theory = Theory(found.theory) if found.theory else None
    figures = {f"response{n or ''}": figure for n, figure in enumerate(response_figures(data, result.motion))}
    if found.boundary:
        figures["limits"] = answer_figure(found, theory, result.motion, 0, trials_of(data.experiments[0]))
    return {name: _drawn(replace(figure, simulated=result.simulated)) for name, figure in figures.items()}


def _drawn(figure: Figure) -> Drawn:
    drawn = draw(figure)
    words = f"{figure.title}. {figure.caption}".strip()
    return {"panels": list(drawn.panels), "shown": list(drawn.shown), "caption": words}


def limits(_processed: Path, asked: dict[str, Any], results: Sequence[ComparisonResult]) -> Drawn:
    """Draw the limits of experiments over each other, with theory, in K and B or (`plane`) in alpha and beta."""
    runs = [(f"{r.device}, {r.experiments[0].experiment}", r.experiments[0]) for r in results]
    theories = [Theory(found.theory) if found.theory else None for _, found in runs]
    if asked["plane"] == "normalised":
        known = [(*run, t, n) for n, (run, t) in enumerate(zip(runs, theories, strict=True)) if t is not None]
        return _drawn(plane_figure(known))
    series = [s for n, (label, found) in enumerate(runs) for s in measured(found, label, n)]
    series += [by_theory(t, "_theory", n) for n, t in enumerate(theories) if t is not None]
    text = "The largest stable stiffness at each damping; dashed, in the same colour: theory."
    return _drawn(limits_figure("Stability limits", text, [limits_panel("", series, results[0].motion)], "limits"))


def trials(processed: Path, asked: dict[str, Any], results: Sequence[ComparisonResult]) -> Drawn:
    """Draw a trial beside theory and fitted loops, or several over each other, each with theory."""
    of = {(result.device, result.experiments[0].experiment): result for result in results}
    figures, labels = [], []
    for device, experiment, trial in asked["places"]:
        result = of[device, experiment]
        spring = declared_spring(known_devices().get(device), experiment)
        stages = ExperimentStages.stored(processed, device, experiment, spring)
        figures.append(trial_figure(stages, result.experiments[0], trial, result.motion))
        row = next((row for row in stages.trials.to_pylist() if row["trial_id"] == trial), None)
        if row is None and len(asked["places"]) > 1:
            raise DeviceError(f"trial {trial} is excluded by hand. Use it again, or leave it out.")
        walls = f"K {significant(row['stiffness'], 4)}, B {significant(row['damping'], 3)}" if row else ""
        labels.append(f"{walls} ({device}, {experiment})")
    if len(figures) == 1:
        return _drawn(figures[0]) | {"caption": figures[0].caption}
    return _drawn(overlaid_figure(figures, labels)) | {"caption": ""}


DRAWINGS: dict[str, Callable[[Path, dict[str, Any], Sequence[ComparisonResult]], Drawn]] = {
    "limits": limits,
    "trials": trials,
}
"""Function of each kind of drawing."""

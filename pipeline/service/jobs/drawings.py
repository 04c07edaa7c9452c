"""Drawings of pages, by the functions that draw reports: an experiment, limits of several, trials over each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.base.errors import DeviceError
from pipeline.comparison.figures.boundary_curves import measured_curve, theory_curve
from pipeline.comparison.figures.figure_boundaries import answer_figure, plane_figure
from pipeline.comparison.figures.figure_response import response_figures
from pipeline.comparison.figures.figure_trial import trial_figure
from pipeline.comparison.scene.scene import open_scene
from pipeline.device_data.devices import declared_spring, known_devices
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records.figure_records import Figure
from pipeline.records.models import Motion
from pipeline.records.results import ComparisonResult
from pipeline.rendering.labels import significant
from pipeline.theory.predictions import Theory

Drawn = dict[str, Any]
"""Panels as SVG, what they show (`rendering.figures.shown.Panel`), and the words below."""


def of_experiment(processed: Path, result: ComparisonResult) -> dict[str, Drawn]:
    """Return the first figures of the report of an experiment by name: limits with theory, and a response."""
    (found,) = result.experiments
    data = open_scene(result.device, processed, [found.experiment], None)
    theory = Theory(found.theory) if found.theory else None
    figures = {"limits": answer_figure(data, theory, found)} if found.boundary else {}
    drawn = {name: _drawn(replace(each, simulated=result.simulated), result.motion) for name, each in figures.items()}
    for response in response_figures(data, result.motion):
        drawn["response"] = _drawn(replace(response, simulated=result.simulated), result.motion)
    return drawn


def _drawn(figure: Figure[Any], motion: Motion) -> Drawn:
    # matplotlib takes half a second, which jobs that draw nothing need not wait for
    from pipeline.rendering.report.report_figures import draw

    drawing = draw(figure, motion)
    words = f"{drawing.title}. {drawing.caption} {drawing.key}".strip()
    return {"panels": [str(panel) for panel in drawing.panels], "shown": drawing.shown, "caption": words}


def limits(_processed: Path, asked: dict[str, Any], results: Sequence[ComparisonResult]) -> Drawn:
    """Draw the limits of experiments over each other, with theory, in K and B or (`plane`) in alpha and beta."""
    runs = [(f"{r.device}, {r.experiments[0].experiment}", r.experiments[0]) for r in results]
    theories = [Theory(found.theory) if found.theory else None for _, found in runs]
    if asked["plane"] == "normalised":
        known = [(label, found, t) for (label, found), t in zip(runs, theories, strict=True) if t is not None]
        return _drawn(plane_figure(known), results[0].motion)
    curves = [replace(measured_curve(found, label), number=n) for n, (label, found) in enumerate(runs)]
    curves += [replace(theory_curve(t, "_theory"), number=n) for n, t in enumerate(theories) if t is not None]
    text = "The largest stable stiffness at each damping; bars: 95 % intervals"
    panel = ("", tuple(curves))
    return _drawn(
        Figure("boundaries", "limits", "Stability limits", f"{text}.", (panel,), theory_label="theory (same colour)"),
        results[0].motion,
    )


def trials(processed: Path, asked: dict[str, Any], results: Sequence[ComparisonResult]) -> Drawn:
    """Draw a trial beside theory and fitted loops, or several over each other, each with theory."""
    from pipeline.rendering.figures.trial_drawing import courses, overlaid

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
        return {"panels": [*map(str, courses(figures[0], results[0].motion))], "caption": figures[0].caption}
    return {"panels": [*map(str, overlaid(figures, labels, results[0].motion))], "caption": ""}


DRAWINGS: dict[str, Callable[[Path, dict[str, Any], Sequence[ComparisonResult]], Drawn]] = {
    "limits": limits,
    "trials": trials,
}
"""Function of each kind of drawing."""

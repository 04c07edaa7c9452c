"""Draw the figure of the README: theory beside a simulated course of measurements; run by ``make docs``."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.comparison.figures.maps import CostMap, map_figure
from pipeline.device_data.devices import load_device
from pipeline.measured.cost.energy import WEIGHTS, energy_terms
from pipeline.measured.experiment.best_trial import choose_optimum
from pipeline.measured.experiment.boundary import measured_boundary
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.measured.thesis import estimate_delay, first_change
from pipeline.records.findings import Optimum
from pipeline.records.results import SourcedLoop
from pipeline.rendering.figures.boundaries import by_theory
from pipeline.rendering.figures.drawing import Series, draw
from pipeline.rendering.labels import UNITS
from pipeline.simulation.sweep import SimulatedSweep, run_sweep
from pipeline.theory.costs import cost_maps
from pipeline.theory.optimum import optimal_point
from pipeline.theory.predictions import Theory

FILE = Path(__file__).parent / "img" / "cost-map.svg"
DEVICE, EXPERIMENT, WEIGHT, SEED = "falcon", "1", 1, 1
"""Weight w = 1: with w = 2 the noise leaves many a trial without a cost, with w = 0 the map is flat."""

CRITERION = f"energy_step_w{WEIGHT}"
GRID = 161
"""Points of the theoretical map along each axis: finer is not seen at this size."""

STYLE = (
    "<style>svg{color:#1f2328;background:#fff;--fig-faint:#ddd;font-family:sans-serif}"
    "@media(prefers-color-scheme:dark){svg{color:#e6edf3;background:#0d1117;--paper:#0d1117;--fig-faint:#30363d;"
    "--fig-blue:#58a6ff;--fig-green:#3fb950}}</style>"
)
"""Colours of the page, which a report's style sheet would bring."""


def theory_map(course: SimulatedSweep) -> CostMap:
    """Return the theoretical cost map for the published parameters of the experiment."""
    plant = course.experiment
    theory = Theory(SourcedLoop(loop=course.setup.loop, source=course.device.source))
    alpha = np.linspace(0, theory.boundary.alpha_max, GRID)
    beta = np.linspace(0, theory.boundary.beta_max, GRID)
    best = theory.physical(optimal_point(theory.normalised, f"{CRITERION}_discrete"))
    return CostMap(
        f"theory, m = {plant.mass:g} kg, b = {plant.damping:g} Ns/m, d = {plant.delay_samples:g}",
        alpha * theory.units.stiffness,
        beta * theory.units.damping,
        cost_maps(theory.normalised, alpha, beta, [CRITERION])[CRITERION],
        (replace(by_theory(theory, "_boundary"), kind="edge"),),
        Optimum(stiffness=best.stiffness, damping=best.damping, cost=best.cost),
        np.empty((3, 0)),
    )


def measured_map(course: SimulatedSweep) -> CostMap:
    """Return the cost map that the measured branch makes of the simulated logs."""
    trials = course.trials
    responses = [find_response(trial) for trial in trials]
    verdicts = list(map(judge, trials, responses))
    delay = estimate_delay(np.array([first_change(*log).delay_samples for log in zip(trials, responses, strict=True)]))
    assert delay.value is not None, delay.reason
    terms = [energy_terms(*log, int(delay.value)) for log in zip(trials, responses, verdicts, strict=True)]
    cost = np.array([energy.summed(course.experiment.mass)[WEIGHTS.index(WEIGHT)] for energy in terms])
    verdict = np.array([judged.verdict for judged in verdicts])
    unstable = verdict == "unstable"
    points = measured_boundary(trials.stiffness, trials.damping, verdict)
    limit, damping = np.array([p.stable or 0.0 for p in points]), np.array([p.damping for p in points])
    # trials of the fine steps lie near the boundary only; the front view would take them for all of a stiffness
    known = np.isfinite(cost) & ~unstable & (course.passes == 1)
    K, B = trials.stiffness[known], trials.damping[known]
    return CostMap(
        f"simulated experiment {course.experiment.name}, {len(trials):,} trials",
        K,
        B,
        cost[known],
        (Series("_boundary", "edge", limit, damping),),
        choose_optimum(cost, trials.stiffness, trials.damping, trials.trial_id, unstable=unstable),
        np.stack([K, B, cost[known]]),
    )


def side_by_side(panels: tuple[str, ...], title: str) -> str:
    """Return one SVG file with panels of equal size beside each other."""
    boxes = [re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', panel) for panel in panels]
    sizes = [(float(box[1]), float(box[2])) for box in boxes if box]
    width, height = sum(w for w, _ in sizes), max(h for _, h in sizes)
    parts = []
    left = 0.0
    for panel, (w, h) in zip(panels, sizes, strict=True):
        parts.append(panel.replace("<svg ", f'<svg x="{left:g}" width="{w:g}" height="{h:g}" ', 1))
        left += w
    head = (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}"><title>{title}</title>'
    )
    return head + STYLE + "".join(parts) + "</svg>\n"


def main() -> None:
    """Simulate a course without jitter (theory knows constant delays only), evaluate it and draw it."""
    course = run_sweep(load_device(DEVICE), EXPERIMENT, seed=SEED, jitter_samples=())
    title = f"Energy cost (w = {WEIGHT}) over stiffness and damping: theory and a simulated experiment"
    maps = theory_map(course), measured_map(course)
    figure = map_figure("readme", CRITERION, maps, UNITS[course.device.motion])
    FILE.parent.mkdir(parents=True, exist_ok=True)
    FILE.write_text(side_by_side(draw(figure).panels, title), encoding="utf-8")


if __name__ == "__main__":
    main()

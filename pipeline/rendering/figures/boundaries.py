"""Draw stability limits of all trials of one experiment, of several experiments in one plot, and of identified loops.

Source: Hulin 2017, Figs. 6.3, 6.4 and 6.9.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.records.findings import BoundaryPoint
from pipeline.records.models import FigureKind, Motion, Overlay, PublishedBound, Shown
from pipeline.records.results import REACHED, ExperimentNumbers, NextWall, SourcedLoop
from pipeline.records.trials import Floats
from pipeline.rendering.figures.drawing import Figure, Panel, Series, reach
from pipeline.rendering.labels import UNITS, damping_text, stiffness_text
from pipeline.theory.boundary import robust_outline
from pipeline.theory.predictions import Theory

SEEN = 0.01
"""Smallest width of a passive region, relative to the stable region, for which it is visible. This is three pixels."""

OVERLAYS: dict[str, Overlay] = {
    "theory": "theory",
    "identified": "estimates",
    "envelope": "band",
    "linear": "linear",
    "passive": "passive",
    "friction": "friction",
    "robust": "robust",
}
"""Overlay to which each kind of series belongs. Measured series are always drawn."""

NOT_DRAWN: dict[Overlay, str] = {
    "estimates": "no loop was identified",
    "band": "no loop was identified",
    "linear": "no theoretical prediction",
    "passive": "not proven by these logs, or too small to be seen; the table of identified loops states the reason",
    "friction": "no friction was found",
    "robust": "known only for a damped mass with a delay, but the loop has other parts or no damping",
}
"""Reason why a requested overlay is missing from the figure of a single experiment."""

TESTED = ("measured", "bound", "stable", "unstable")
"""Kinds of series with tested walls."""

ANSWER = "boundaries-answer"
"""Identifier of the figure on the first screen."""

MEASURED = (
    "Measured: limit of stability at each damping, estimated from the growth rates of the trials. If these do not "
    "determine it, the middle between the stiffest stable and the softest unstable trial is shown."
)

AT_LEAST = "Open marks: stiffest stable trial at dampings without an unstable trial; the limit is higher."


def measured(
    limits: Sequence[BoundaryPoint], label: str, number: int | None, *, intervals: bool = False
) -> Iterator[Series]:
    """Yield the measured limit at each damping, and lower bounds as a separate series.

    A limit comes from the growth rates, otherwise it is the middle between the last stable and the first unstable
    trial. The line has a gap where no limit is known. At a damping without a stable trial, the line ends at K = 0 if
    the unstable trial is as close to 0 as the two trials around another limit are to each other.

    With ``intervals``, limits are drawn with their 95 % intervals, or with these two trials as ends.
    """
    stable = [p.stable is not None for p in limits]
    # Dampings without a stable trial close the curve where they are next to dampings with a stable trial. Others are
    # not needed.
    points = [p for i, p in enumerate(limits) if any(stable[max(i - 1, 0) : i + 2])]
    steps = [p.unstable - p.stable for p in limits if p.stable is not None and p.unstable is not None]
    ends = [(p.low, p.high) if None not in (p.low, p.high) else (p.stable, p.unstable) for p in points]
    low, high = (np.array([pair[side] for pair in ends], dtype=np.float64) for side in (0, 1))
    near = [p.unstable is not None and p.unstable <= max(steps, default=0.0) for p in points]
    K = np.array(
        [p.limit.stiffness if p.limit else 0.0 if close else np.nan for p, close in zip(points, near, strict=True)]
    )
    B = np.array([p.damping for p in points])
    bound = np.array([p.censored for p in points], dtype=np.bool_)
    line = np.where(bound, np.nan, K)  # A lower bound is not a limit, but a line through it would suggest a limit.
    yield Series(label, "measured", line, B, low if intervals else None, high if intervals else None, number)
    bound &= np.isfinite(K)
    if bound.any():
        yield Series(f"_{label}: at least", "bound", K[bound], B[bound], number=number)


def by_theory(theory: Theory, label: str, number: int | None = None) -> Series:
    """Return the theoretical boundary in physical units, with gaps between separate regions."""
    border, units = theory.boundary, theory.units
    return Series(label, "theory", border.alpha * units.stiffness, border.beta * units.damping, number=number)


def _identified(result: ExperimentNumbers, label: str) -> Series:
    """Return the limits that the identified loop predicts at the tested dampings."""
    limits = result.loop_boundary or ()
    return Series(label, "identified", *np.array([(limit.stiffness, limit.damping) for limit in limits]).T)


def limits_figure(title: str, caption: str, panels: Sequence[Panel], identifier: str) -> Figure:
    """Return a figure of limits whose panels have equal axis ranges. Wide intervals extend beyond these ranges."""
    series = [s for panel in panels for s in panel.series]
    B = [s.y for s in series if s.kind not in ("linear", "others")]
    limits = (0.0, reach(*(s.x for s in series if s.kind not in ("envelope", "others")))[1]), reach(*B)
    width = 350.0 if len(panels) > 2 else 440.0
    corner = limits[0][1], limits[1][1]
    even = tuple(
        replace(panel, limits=limits, series=(*untested(*_tested_part(panel.series), corner), *panel.series))
        for panel in panels
    )
    kind: FigureKind = "plane" if identifier == "boundaries-normalised" else "boundaries"
    return Figure(kind, identifier, title, caption, even, size=(width, 0.78 * width))


def _tested_part(series: Sequence[Series]) -> tuple[float, float]:
    """Return the largest tested damping of a panel, and the largest damping of theory's region."""
    tested = [float(s.y.max()) for s in series if s.kind in TESTED and len(s.y)]
    region = [float(np.nanmax(s.y)) for s in series if s.kind == "theory" and s.variant is None]
    return max(tested, default=np.inf), max(region, default=0.0)


def untested(tested: float, region: float, corner: tuple[float, float]) -> list[Series]:
    """Return the dampings between the largest tested damping and the corner of the axes as an area.

    The list is empty if theory's region does not extend far into them.
    """
    if tested >= REACHED * region:
        return []
    K, B = corner
    return [Series("not tested", "untested", np.array([0.0, K, K, 0.0]), np.array([tested, tested, B, B]))]


def limits_panel(title: str, series: Sequence[Series], motion: Motion, names: tuple[str, str] | None = None) -> Panel:
    """Return axes of stiffness and damping, with a description of their content."""
    units = UNITS[motion]
    extents = [
        f"{s.label.lstrip('_')}: up to {stiffness_text(float(np.nanmax(s.x)))} {units.stiffness} and "
        f"{damping_text(float(np.nanmax(s.y)))} {units.damping}"
        for s in series
        if np.isfinite(s.x).any()
    ]
    own = (f"stiffness K [{units.stiffness}]", f"damping B [{units.damping}]")
    return Panel(title, names or own, tuple(series), f"Stability limits. {'; '.join(extents)}.")


def answer_figure(
    result: ExperimentNumbers,
    theory: Theory | None,
    motion: Motion,
    number: int,
    trials: tuple[Floats, Floats, Floats],
    others: Sequence[ExperimentNumbers] = (),
    step: NextWall | None = None,
) -> Figure:
    """Return the figure of the first screen.

    It shows measured and theoretical limits, limits with friction, walls to use, all trials, the next wall to measure,
    and the limits of other experiments with their names.

    Parameters
    ----------
    result : ExperimentNumbers
    theory : Theory, optional
    motion : Motion
    number : int
        Index of the experiment in its report.
    trials : (float64, float64, array of str), shape (n,) each
        Stiffness, damping and verdict.
    others : sequence of ExperimentNumbers
        Other experiments of the report. Their limits do not change the range of the axes.
    step : NextWall, optional
        Next wall to measure.
    """
    K, B, verdict = trials
    series = list(measured(result.boundary, "measured limit", number, intervals=True))
    rubs = result.loop_boundary and _rubs(result)
    series += (
        [by_theory(theory, "theory without friction" if rubs else "limit by theory")] if theory is not None else []
    )
    series += [_identified(result, "theory with friction")] if rubs else []
    if result.use is not None:
        u = result.use
        corners = [(u.stiffness_low, u.damping_low), (u.stiffness_high, u.damping_low)]
        corners += [(u.stiffness_high, u.damping_high), (u.stiffness_low, u.damping_high), corners[0]]
        series += [Series("box: walls to use", "use", *np.array(corners).T)] if u.trials > 1 else []
        series.append(Series("recommended wall", "mark", np.array([u.point.stiffness]), np.array([u.point.damping])))
    for kind in ("stable", "unstable"):
        at = (K > 0) & (verdict == kind)
        series += [Series(f"{kind} trial", kind, K[at], B[at])] if at.any() else []
    for place, other in enumerate(others):
        label = f"_experiment {other.experiment}" if place else "other experiments"
        line = next(measured(other.boundary, label, None, intervals=True))
        series.append(Series(label, "others", line.x, line.y, tag=other.experiment))
    if step is not None:
        series.append(Series("next wall", "next", np.array([step.stiffness]), np.array([step.damping])))
    title = f"Where experiment {result.experiment} is stable"
    caption = [
        "Every trial, and the limit of stability at each damping, estimated from the growth rates of the trials."
    ]
    if any(point.low for point in result.boundary):
        caption.append("Within the interval of a limit, a single trial may be stable or unstable.")
    if result.use is not None and result.use.trials > 1:
        caption.append("Box: walls of low cost around the recommended one, all stable and far from the limit.")
    caption += _at_least(series)
    return limits_figure(title, " ".join(caption), [limits_panel("", series, motion)], ANSWER)


def _at_least(series: Iterable[Series]) -> list[str]:
    """Return the sentence about open marks, if there are any."""
    return [AT_LEAST] if any(s.kind == "bound" for s in series) else []


def plane_figure(entries: Sequence[tuple[str, ExperimentNumbers, Theory, int]], *, predicted: bool = True) -> Figure:
    """Return measured limits of experiments, possibly of several devices, in the plane of alpha and beta.

    Parameters
    ----------
    entries : sequence of (str, ExperimentNumbers, Theory, int)
        Label, result, the theory whose mass and sampling period normalise the result, and the number of the colour.
    predicted : bool
        Whether the boundaries of these theories are drawn, too.

    Source: Hulin 2017, Table 3.1 (alpha = K T^2/m, beta = B T/m).
    """
    series = []
    for label, result, theory, number in entries:
        full = f"{label} (d = {theory.normalised.delay:.3g}, δ = {theory.normalised.delta:.2g})"
        both = [
            *measured(result.boundary, full, number),
            *([by_theory(theory, "_theory", number)] if predicted else []),
        ]
        k, b = theory.units.stiffness, theory.units.damping
        series += [replace(s, x=s.x / k, y=s.y / b) for s in both]
    panel = limits_panel("", series, "translation", ("α = K T²/m", "β = B T/m"))
    caption = (
        f"Measured limits{' and theory (dashed, same colour)' if predicted else ''}. Experiments that differ only in "
        "mass or sampling period coincide here. The remaining differences are due to the delay, the relative damping "
        "δ = b T/m, or parts missing from the model."
    )
    words = f"Stability limits in the normalised plane: {', '.join(label for label, *_ in entries)}."
    return limits_figure(
        "Limits in the normalised plane", caption, [replace(panel, words=words)], "boundaries-normalised"
    )


def boundary_figures(
    results: Sequence[ExperimentNumbers],
    theories: Mapping[str, Theory],
    motion: Motion,
    shown: Shown,
    *,
    sweep: bool,
    printed: PublishedBound | None = None,
) -> list[Figure]:
    """Return the requested figures of stability limits.

    One figure shows all experiments, one compares each experiment with its loop, and one shows normalised limits.

    ``printed`` is the published straight bound of the device. If the delay in the device file has jitter, theory is
    also drawn for both ends of its range, because the limits lie between these curves (6.1.3).
    """
    figures = []
    # There is one panel without an operator (Fig. 6.3) or over delay (Fig. 6.9). Otherwise, there is one per
    # configuration (Fig. 6.4).
    numbered = list(enumerate(results))
    held = [] if sweep else [r.configuration for r in results if r.grip != "none"]
    groups = {"no operator" if held else "": [(n, r) for n, r in numbered if not held or r.grip == "none"]}
    groups |= {name: [(n, r) for n, r in numbered if r.configuration == name] for name in dict.fromkeys(held)}
    groups = {title: group for title, group in groups.items() if group}
    panels = [
        limits_panel(title if len(groups) > 1 else "", _over_each_other(group, theories, shown), motion)
        for title, group in groups.items()
    ]
    if printed is not None:
        panels = [replace(panel, series=(*panel.series, _straight(printed, panel.series))) for panel in panels]
    dashed = " Dashed, in the same colour: theory." if theories and shown.has_overlay("theory") else ""
    if any(s.variant is not None for panel in panels for s in panel.series):
        dashed += " Grey: theory for other delays."
    if len(results) > 1 or shown.delays or printed is not None:
        title = "Stability limits of all experiments"
        words = " ".join([f"{MEASURED}{dashed}", *_at_least(s for each in panels for s in each.series)])
        figures.append(limits_figure(title, words, panels, "boundaries-all"))
    if any(shown.has_overlay(overlay) for overlay in NOT_DRAWN):
        drawn = [_with_loop(r, theories.get(r.experiment), number, shown) for number, r in enumerate(results)]
        each = [
            limits_panel(f"experiment {r.experiment}", series, motion)
            for r, series in zip(results, drawn, strict=True)
            if len(series) > 2
        ]
        caption = "Pale bars: 95 % intervals of the measured limits."
        if shown.has_overlay("estimates"):
            caption += (
                " Identified loop, with its 95 % interval shaded: limit at each damping that is predicted by the loop "
                "found in the logs, including friction."
            )
        there = {OVERLAYS[s.kind] for series in drawn for s in series if s.kind in OVERLAYS}
        missing = [f"{name} ({NOT_DRAWN[name]})" for name in shown.overlays or () if name in NOT_DRAWN.keys() - there]
        caption += f" Not drawn: {'; '.join(missing)}." if missing else ""
        figures += [limits_figure("Limits by the identified loop", caption, each, "boundaries-loop")] if each else []
    known = [
        (f"experiment {r.experiment}", r, theories[r.experiment], n)
        for n, r in enumerate(results)
        if r.experiment in theories
    ]
    if len(known) > 1 and shown.has_figure("plane"):
        figures.append(plane_figure(known, predicted=shown.has_overlay("theory")))
    return [figure for figure in figures if shown.has_figure(figure.kind)]


def _straight(bound: PublishedBound, beside: Sequence[Series]) -> Series:
    """Return a published straight bound as a line from the stiffest limit to the largest damping, or to K = 0."""
    stiffest = max((float(np.nanmax(s.x)) for s in beside if np.isfinite(s.x).any()), default=bound.stiffness)
    last = max((float(np.nanmax(s.y)) for s in beside if np.isfinite(s.y).any()), default=0.0)
    damping = np.array(
        [max((stiffest - bound.stiffness) / bound.slope, 0.0), min(last, -bound.stiffness / bound.slope)]
    )
    label = f"K \u2264 {bound.stiffness:g} \N{MINUS SIGN} {-bound.slope:g} B ({bound.equation})"
    return Series(label, "linear", bound.stiffness + bound.slope * damping, damping)


def _over_each_other(
    group: Sequence[tuple[int, ExperimentNumbers]], theories: Mapping[str, Theory], shown: Shown
) -> list[Series]:
    """Return limits of experiments with theory. Curves for other delays are grey, with different dashes."""
    series: list[Series] = []
    for number, result in group:
        grip = "" if result.grip == "none" else f", {result.grip} grip"
        series += measured(result.boundary, f"experiment {result.experiment}{grip}", number)
        theory = theories.get(result.experiment)
        if theory is not None and shown.has_overlay("theory") and not shown.delays:
            series.append(by_theory(theory, f"_theory, experiment {result.experiment}", number))
    leader = next((r.experiment for _, r in group if r.experiment in theories), None)
    if leader is None or not (shown.delays or shown.has_overlay("theory")):
        return series
    first = theories[leader]
    low, high = first.loop.delay_range
    for variant, delay in enumerate(shown.delays or ((low, high) if low < high else ())):
        loop = replace(first.loop, jitter_samples=(), delay_samples=float(delay))
        curve = by_theory(
            Theory(SourcedLoop(loop=loop, source=first.source)), f"theory of experiment {leader}, d = {delay:g}"
        )
        series.append(replace(curve, variant=variant))
    return series


def _with_loop(result: ExperimentNumbers, theory: Theory | None, number: int, shown: Shown) -> list[Series]:
    """Return the measured limits of one experiment with its theory, its identified loop, and analytical conditions.

    Theory's passive region is left out if the logs do not show that any wall is passive, for example because the delay
    jitters or a hand damps the device.
    """
    series = list(measured(result.boundary, "measured limit", number, intervals=True))
    if result.loop_boundary:
        B, low, high = (
            np.array([getattr(limit, name) for limit in result.loop_boundary]) for name in ("damping", "low", "high")
        )
        harder = np.array([limit.stiffness_large_motion for limit in result.loop_boundary], dtype=np.float64)
        series.append(_identified(result, "identified loop"))
        series.append(Series("loop, 95 % interval", "envelope", high, B, low, high))
        if (line := result.straight_bound) is not None:
            ends = np.array([line.damping_first, line.damping_last])
            series.append(
                Series("straight line fitted to the limits", "straight", line.stiffness + line.slope * ends, ends)
            )
        series += [Series("for a harder push", "friction", harder, B)] if _rubs(result) else []
    if theory is not None:
        proven = result.passive is not None
        drawn = [s for s in conditions(theory, shown.has_overlay("robust")) if proven or s.kind != "passive"]
        series += [by_theory(theory, "theory"), *drawn]
    return [s for s in series if s.kind not in OVERLAYS or shown.has_overlay(OVERLAYS[s.kind])]


def _rubs(result: ExperimentNumbers) -> bool:
    """Return whether the logs show friction, with which a limit depends on the size of the push."""
    return any(cause.code == "coulomb_friction" for cause in result.causes)


def conditions(theory: Theory, robust: bool = True) -> Iterator[Series]:
    """Yield the linear condition (3.25), the passive region, and on request the region that is stable with every spring
    (4.3.3).

    The region that is stable with every spring takes a third of the time of a report.

    Source: Hulin 2017, eqs. 3.25, 4.12 and sec. 4.3.3.
    """
    loop, units = theory.loop, theory.units
    effective_delay = (loop.delay_samples + 0.5) * loop.sampling_period_s + loop.actuator_lag_s
    stiffness = np.array([0.0, 0.6 * theory.boundary.alpha_max * units.stiffness])
    damping = stiffness * effective_delay - loop.apparent().damping
    yield Series("linear condition (3.25)", "linear", stiffness, damping)
    passive = theory.passive_outline
    if passive is not None and passive[0].max() >= SEEN * theory.boundary.alpha_max:
        alpha, beta = (np.append(values, values[0]) for values in passive)
        yield Series("passive region (4.12)", "passive", alpha * units.stiffness, beta * units.damping)
    if robust and loop.damping > 0 and not loop.parts_in_words():
        alpha, beta, _ = robust_outline(theory.normalised.delta, loop.delay_samples)
        outline = np.pad(alpha, 1) * units.stiffness, np.pad(beta, 1, mode="edge") * units.damping
        yield Series("stable with every spring (4.3.3)", "robust", *outline)

"""Figures of stability boundaries: without and with operator, over delay, from estimates, and normalised.

Source: Hulin 2017, secs. 6.1.3 and 6.2.3.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.wording import counted
from pipeline.comparison.figures.boundary_curves import (
    FrictionFacts,
    bound_curve,
    envelope_curve,
    friction_curves,
    friction_facts,
    linear_curve,
    measured_curve,
    normalised,
    passive_curve,
    robust_curve,
    theory_curve,
    use_curve,
)
from pipeline.comparison.loops.told_loop import adequate_theory
from pipeline.comparison.scene.scene import SceneData
from pipeline.comparison.scores.agreement import NEAR_ZERO
from pipeline.comparison.scores.overlap import measured_limits
from pipeline.records.figure_records import Curve, Figure, Limits
from pipeline.records.models import Experiment
from pipeline.records.results import ExperimentResult, TheoryParameters
from pipeline.rendering.labels import UNITS, Units, percent_text, stiffness_text
from pipeline.theory.limits import stiffness_limit
from pipeline.theory.predictions import Theory

ANSWER = "boundaries-answer"
"""Identifier of the figure beside the answer."""


def boundary_figures(
    data: SceneData, theories: Mapping[str, Theory], results: Sequence[ExperimentResult]
) -> tuple[Figure[Limits], ...]:
    """Return the boundary figures of a scene.

    Without and with operator (Figs. 6.3, 6.4) or over delay (Fig. 6.9), then from the estimates, then all experiments
    in the normalised plane.
    """
    builder = _Builder(data, theories, results)
    figures: list[Figure[Limits] | None] = []
    figures += [builder.delay()] if data.scene.delay_sweep else [builder.free(), builder.operator()]
    figures.append(builder.estimates())
    shown = [(f"experiment {r.experiment}", r, theories[r.experiment]) for r in results if r.experiment in theories]
    if len(shown) > 1:
        figures.append(plane_figure(shown, data.scene.experiments, predicted=data.scene.shown.has_overlay("theory")))
    return tuple(figure for figure in figures if figure is not None)


def answer_figure(data: SceneData, theory: Theory | None, result: ExperimentResult) -> Figure[Limits]:
    """Return the picture beside the answer: measured limits with intervals, theory, walls to use, and all trials."""
    stages = next(each for each in data.experiments if each.experiment == result.experiment)
    K, B = stages.column("response", "stiffness"), stages.column("response", "damping")
    wall, verdict = K > 0, stages.verdicts.verdict
    trials = [
        Curve(f"{kind} trial", kind, K[at], B[at])
        for kind in ("stable", "unstable")
        if (at := wall & (verdict == kind)).any()
    ]
    number = data.scene.experiments.index(result.experiment)
    curves = [replace(measured_curve(result, "measured limit", open_ends=True), number=number)]
    if theory is not None and data.scene.shown.has_overlay("theory"):
        curves.append(theory_curve(theory, "limit by theory"))
    if result.use is not None:
        curves.append(use_curve(result.use))
    shaded = "; pale bars: their 95 % intervals" if any(point.low is not None for point in result.boundary) else ""
    shaded += ", none where nothing bounds them from below" if any(point.low == 0 for point in result.boundary) else ""
    return Figure(
        "boundaries",
        ANSWER,
        f"Where experiment {result.experiment} is stable",
        f"Every trial, and the largest stable stiffness at each damping{shaded}.",
        (("", (*curves, *trials)),),
    )


def plane_figure(
    entries: Sequence[tuple[str, ExperimentResult, Theory]], order: Sequence[str] = (), *, predicted: bool = True
) -> Figure[Limits]:
    """Return measured boundaries of experiments, also of several devices, in the plane of alpha and beta.

    Parameters
    ----------
    entries : sequence of (str, ExperimentResult, Theory)
        Label, result, and the theory whose mass and sampling period normalise it.
    order : sequence of str
        Experiments of the report, whose places choose the colours; of entries that are not of one report none.
    predicted : bool
        Whether the boundaries of these theories stand beside.

    Source: Hulin 2017, Table 3.1 (alpha = K T^2/m, beta = B T/m).
    """
    measured = []
    for label, result, theory in entries:
        full = f"{label} (d = {theory.loop.delay:.3g}, δ = {theory.loop.delta:.2g})"
        measured.append(normalised(measured_curve(result, full), theory))
    theories = [normalised(theory_curve(theory, "_theory"), theory) for _, _, theory in entries if predicted]
    if order:
        numbers = [order.index(result.experiment) for _, result, _ in entries]
        measured, theories = (
            [replace(curve, number=n) for curve, n in zip(curves, numbers, strict=bool(curves))]
            for curves in (measured, theories)
        )
    return Figure(
        "plane",
        "boundaries-normalised",
        "Boundaries in the normalised plane",
        f"Measured boundaries{' and theory' if predicted else ''} in α = K T²/m and β = B T/m. Curves that differ in "
        "mass or sampling period alone coincide here; what still differs is due to delay, to the relative damping "
        "δ = b T/m, or to what the model does not hold.",
        (("", (*measured, *theories)),),
        theory_label="theory (same colour)",
    )


@dataclass(frozen=True)
class _Builder:
    """What all boundary figures of a scene are made of."""

    data: SceneData
    theories: Mapping[str, Theory]
    results: Sequence[ExperimentResult]

    @property
    def predicted(self) -> bool:
        """Whether the scene asks for theory beside the measured curves."""
        return self.data.scene.shown.has_overlay("theory")

    def free(self) -> Figure[Limits] | None:
        """Experiments without operator, with theory for each delay that the device file names (Fig. 6.3)."""
        free = [r for r in self.results if r.grip == "none" and r.experiment in self.theories]
        if not free or self.data.device is None:
            return None
        values = list(dict.fromkeys((p.mass, p.damping, p.stiffness) for p in (self._own(r) for r in free)))
        first = self.theories[free[0].experiment]
        shown = self.data.scene.shown
        robust = robust_curve(first) if shown.has_overlay("robust") else None
        conditions = (linear_curve(first), passive_curve(first), robust, _first(bound_curve(r) for r in free))
        facts = friction_facts(self.data.device, free)
        held = friction_curves(first, facts) if facts and shown.has_overlay("friction") else []
        drawn = (*filter(None, conditions), *held)
        curves = (*(self._measured(r) for r in free), *self._over_delays(free, values), *drawn)
        m, b, k = values[0]
        units = UNITS["rotation" if self.data.experiments[0].rotation else "translation"]
        others = ", ".join(f"{other[1]:g}" for other in values[1:])
        words = first.parameters.loop.words()
        parts = f", {words}" if words else ""
        beside = (
            f" Theory for m = {m:g} {units.mass}, b = {b:g} {units.damping}, k = {k:g} {units.stiffness}{parts} "
            "and the delay factors at the curves"
            f"{f'; thin dots: the same with b = {others} {units.damping}' if others else ''}."
        )
        told = f"{_plainly(held[0], first, free[0])}{_told(facts, first, units)}" if held and facts else ""
        return Figure(
            "boundaries",
            "boundaries-free",
            "Stability boundaries without operator",
            f"Measured: last stable stiffness at each damping.{beside if self.predicted else ''}"
            f"{told} In the manner of Fig. 6.3.",
            (("", curves),),
            theory_label=f"theory, b = {b:g}",
        )

    def _measured(self, result: ExperimentResult, label: str = "", *, open_ends: bool = False) -> Curve:
        """Measured boundary in the colour of its experiment."""
        return self._coloured(measured_curve(result, label, open_ends=open_ends), result)

    def _theory(self, result: ExperimentResult, label: str) -> Curve:
        """Boundary by the theory of an experiment, in its colour."""
        return self._coloured(theory_curve(self.theories[result.experiment], label), result)

    def _coloured(self, curve: Curve, result: ExperimentResult) -> Curve:
        return replace(curve, number=self.data.scene.experiments.index(result.experiment))

    def _own(self, result: ExperimentResult) -> TheoryParameters:
        return self.theories[result.experiment].parameters

    def _over_delays(
        self, free: Sequence[ExperimentResult], values: Sequence[tuple[float, float, float]]
    ) -> Iterator[Curve]:
        """Theory for each delay that is asked for or named in the device file, thin with further parameters."""
        experiments = {e.name: e for e in self.data.device.experiments} if self.data.device else {}
        named = {d for r in free if r.experiment in experiments for d in _delays(experiments[r.experiment])}
        template = self._own(free[0])
        for index, (m, b, k) in enumerate(values):
            for number, d in enumerate(sorted(self.data.scene.shown.delays or named) or [template.delay_samples]):
                changed = {"mass": m, "damping": b, "stiffness": k, "delay_samples": float(d)}
                label = f"d = {d:g}" if index == 0 else f"theory, b = {b:g}" if number == 0 else "_"
                theory = Theory(template.model_copy(update=changed))
                yield theory_curve(theory, label, "band" if index else "theory")

    def operator(self) -> Figure[Limits] | None:
        """One panel a configuration, one curve a grip (Fig. 6.4)."""
        held = [r for r in self.results if r.grip != "none" and r.experiment in self.theories]
        if not held:
            return None
        panels = []
        for configuration in dict.fromkeys(r.configuration for r in held):
            shown = [r for r in self.results if r.configuration == configuration and r.experiment in self.theories]
            curves = [self._measured(r, f"experiment {r.experiment}, {_grip(r.grip)}") for r in shown]
            curves += [self._theory(r, f"theory, {_grip(r.grip)}") for r in shown]
            panels.append((configuration, tuple(curves)))
        return Figure(
            "boundaries",
            "boundaries-operator",
            "Influence of the operator on the stability boundary",
            f"Measured{' and theoretical' if self.predicted else ''} boundaries for each grip"
            f"{', theory with the parameters of each experiment' if self.predicted else ''}. "
            "In the manner of Fig. 6.4.",
            tuple(panels),
        )

    def delay(self) -> Figure[Limits]:
        """Theory beside measurement for each delay (Fig. 6.9)."""
        theory = [
            self._theory(r, f"d = {self.theories[r.experiment].parameters.delay_samples:g}")
            for r in self.results
            if r.experiment in self.theories
        ]
        measured = [self._measured(r, r.experiment) for r in self.results]
        panels = [("theory", tuple(theory))] if theory else []
        return Figure(
            "boundaries",
            "boundaries-delay",
            "Influence of delay on the stability boundary",
            f"{'Theory left, measured right,' if theory and self.predicted else 'Measured,'} for each total delay. "
            "In the manner of Fig. 6.9.",
            (*panels, ("measured", tuple(measured))),
        )

    def estimates(self) -> Figure[Limits] | None:
        """Theory by the estimates of each experiment, with all that belongs to its boundary."""
        if not self.data.overlay:
            return None
        stages = {e.experiment: e for e in self.data.experiments}
        panels = []
        for result in self.results:
            name = result.experiment
            theory = adequate_theory(result, stages[name])
            if theory is None:
                continue
            more = (envelope_curve(result), bound_curve(result), linear_curve(theory), passive_curve(theory))
            curves = (self._measured(result, open_ends=True), theory_curve(theory, "theory from estimates"))
            panels.append((f"experiment {name}", (*curves, *(c for c in more if c is not None))))
        if not panels:
            return None
        shown = self.data.scene.shown
        kinds = {curve.kind for _, curves in panels for curve in curves}
        told = []
        if "envelope" in kinds and shown.has_overlay("band"):
            told.append(
                " Shaded: what the 95 % intervals of these estimates leave open in theory; pale bars: the intervals of "
                "the measured limits."
            )
        if "passive" in kinds and shown.has_overlay("passive"):  # without damping there is no passive wall
            told.append(" Thin outline: passive region (4.12), far inside the stable one.")
        return Figure(
            "boundaries",
            "boundaries-estimates",
            "Boundaries predicted from what the logs say",
            "Theory with the estimated mass, damping and delay of each experiment." + "".join(told),
            tuple(panels),
        )


def _told(facts: FrictionFacts, theory: Theory, units: Units) -> str:
    """Return what the curves with friction are, and where they hold."""
    force = "N" if units == UNITS["translation"] else "Nm"
    text = (
        f" Limit with Coulomb friction: f_c = {facts.coulomb:.3g} {force} ({facts.source}), for oscillations as large "
        f"as the step's way F_0/(K + k), F_0 = {facts.step:g} {force}, by the describing function (Slotine and Li "
        "1991); drawn where the motion slides all through, f_c ≤ m ω² A/2. Larger oscillations have the limit without "
        "friction."
    )
    quiet = facts.limit(theory.parameters.loop.force_gain)
    if quiet is None:
        return text
    return (
        f"{text} Up to K = 2 f_c/Δ = {stiffness_text(quiet)} {units.stiffness} the sensor's quantum Δ causes no limit "
        "cycle (Diolaiti et al. 2006; sufficient, not necessary: nothing is said of stiffer walls)."
    )


def _plainly(curve: Curve, theory: Theory, result: ExperimentResult) -> str:
    """Return by how much friction moves the limit at the tested dampings, and what is left of the measured ones."""
    limits = measured_limits(result.boundary)
    bounded = limits.known & (limits.low > 0) & ~limits.censored
    B, measured = limits.damping[bounded], limits.limit[bounded]
    held = np.interp(B, curve.damping, curve.stiffness)
    free = stiffness_limit(theory.loop, B / theory.units.damping) * theory.units.stiffness
    told = np.isfinite(held) & (free > NEAR_ZERO * free.max(initial=0.0))
    if not told.any():
        return ""
    lifts, left = (100 * float(np.median((a / b)[told] - 1)) for a, b in ((held, free), (measured, held)))
    return (
        f" Coulomb friction moves theory's limit by {percent_text(lifts, 0)} % in the median of "
        f"{counted(int(told.sum()), 'damping')}; experiment {result.experiment} lies another "
        f"{percent_text(left, 0)} % off, which it does not explain."
    )


def _first(curves: Iterable[Curve | None]) -> Curve | None:
    return next((curve for curve in curves if curve is not None), None)


def _delays(experiment: Experiment) -> list[float]:
    jitter = experiment.jitter_samples
    return [float(d) for d in range(min(jitter), max(jitter) + 2)] if jitter else [experiment.delay_samples]


def _grip(grip: str) -> str:
    return "no operator" if grip == "none" else f"{grip} grip"

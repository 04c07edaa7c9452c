"""The accuracy page: one self-contained HTML file from a finished measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.records import tables
from pipeline.records.accuracy import OURS, WRONG, AccuracyReport, Rung, Sweep, duration, error_text
from pipeline.records.accuracy_advice import compared, fails, longest, name_of, place_of
from pipeline.rendering.page_template import fill_template

MEANING = {
    "plant": "numerator of the sampled plant, over 20 plants",
    "boundary": "largest stable α at 51 values of β",
    "spectral radius": "largest pole modulus at 40 points",
    "settling time": "last entry into ±2 % between samples, 40 points",
    "overshoot": "largest excess between samples, 40 points",
    "energy, w = 0": "step response, 40 points with spectral radii up to 0.992; time for all three weights together",
    "energy, w = 1": "step response, 40 points; time for all three weights together",
    "energy, w = 2": "step response, 40 points; time for all three weights together",
    "optimum of energy": "place (α, β) of the least energy, w = 0, d = 1",
    "optimum of settling time": "place (α, β) of the shortest settling time, ±2 %, d = 1: the corner of a jump",
    "map": "settling time, overshoot and three energies of the samples, 61 × 61 points; "
    "largest error of the five at 40 of them, spectral radii up to 0.992",
}
"""What is computed for each quantity."""


@dataclass(frozen=True)
class _Path:
    """How a sweep is shown: heading, abscissa, what happens along it, and whether x grows towards the trouble."""

    title: str
    abscissa: str
    what: str
    rising: bool = False


PATHS = {
    "gamma": _Path("Plant, γ → 0", "γ (δ = 0)", "device without its own stiffness"),
    "gamma_damped": _Path("Plant, γ → 0, strongly damped", "γ (δ = 50)", "little stiffness, much damping"),
    "critical": _Path("Plant, critical damping", "|c₁| (δ = 1)", "the two poles of the device meet, δ² → 4γ"),
    "delta": _Path("Plant, strong damping", "δ (γ = 0.001)", "poles of the device far apart", rising=True),
    "delay": _Path("Spectral radius over delay", "delay d", "up to 259 poles", rising=True),
    "margin": _Path(
        "Verdict next to the boundary", "distance in α, relative (d = 4)", "error: share of wrong verdicts, 102 points"
    ),
    "resonant": _Path(
        "Spectral radius, γ → π²", "1 − γ/π² (α = β = 10⁻¹¹, d = 1)", "device that swings with half the sampling rate"
    ),
    "delay_energy": _Path("Energy over delay", "delay d", "largest error of the three weights", rising=True),
    "limit_w0": _Path("Energy w = 0, limit of stability", "1 − spectral radius (d = 1)", "response that hardly decays"),
    "limit_w1": _Path("Energy w = 1, limit of stability", "1 − spectral radius (d = 1)", "response that hardly decays"),
    "limit_w2": _Path("Energy w = 2, limit of stability", "1 − spectral radius (d = 1)", "response that hardly decays"),
}
"""The sweeps, in order."""


def render(report: AccuracyReport) -> str:
    """Return the page as one HTML document."""

    from pipeline.rendering import accuracy_figures, accuracy_measured_report

    quantities = list(dict.fromkeys(r.quantity for r in report.rungs))
    ladders = []
    for index, name in enumerate(quantities):
        rungs = [r for r in report.rungs if r.quantity == name]
        ladders.append(
            {
                "name": name,
                "meaning": MEANING.get(name, ""),
                "svg": accuracy_figures.ladder(name, rungs, f"ladder-{index}"),
                "advice": next((a.text for a in report.advice if a.quantity == name), ""),
                "rows": [_ladder_row(r) for r in rungs],
            }
        )
    paths = []
    for index, (name, path) in enumerate(PATHS.items()):
        found = [s for s in report.sweeps if s.sweep == name]
        if found:
            svg = accuracy_figures.sweep(path.title, path.abscissa, found, f"sweep-{index}", rising=path.rising)
            paths.append({"path": path, "svg": svg, "rows": [_sweep_row(s) for s in found], "longest": longest(found)})
    measured = report.measured_branch
    return fill_template(
        "accuracy.html.j2",
        report=report,
        ladders=ladders,
        paths=paths,
        ours=OURS,
        wrong=error_text(WRONG),
        summary=summary_rows(report),
        measured_groups=accuracy_measured_report.groups_of(measured) if measured else [],
    )


def write(report: AccuracyReport, path: Path) -> None:
    """Render the page and write it so that a reader sees all of it or nothing."""
    tables.write_text(path, render(report))


def summary_rows(report: AccuracyReport) -> tuple[dict[str, str], ...]:
    """Return one row a quantity: error and time of this package, and the quickest other within `WRONG`."""
    rows = []
    for quantity in dict.fromkeys(r.quantity for r in report.rungs):
        here = [r for r in report.rungs if r.quantity == quantity]
        ours = [r for r in here if r.method == OURS]
        good = [r for r in here if r.method != OURS and r.error is not None and r.error <= WRONG]
        other = min(good, key=lambda r: r.seconds, default=None)
        rows.append(
            {
                "quantity": quantity,
                "error": error_text(ours[0].error) if ours else "–",
                "time": duration(ours[0].seconds) if ours else "–",
                "other": name_of(other) if other else "none measured",
                "compared": _compared(other, ours[0], report.sweeps) if other and ours else "–",
            }
        )
    return tuple(rows)


def _compared(other: Rung, ours: Rung, sweeps: Sequence[Sweep]) -> str:
    warning = ", but fails in hard cases" if fails(other.method, sweeps) else ""
    return compared(other.seconds, ours.seconds) + warning


def _ladder_row(rung: Rung) -> tuple[str, str, str, str]:
    return rung.method, rung.setting, error_text(rung.error), duration(rung.seconds)


def _sweep_row(s: Sweep) -> dict[str, str | bool]:
    verdicts = "" if s.wrong_verdicts is None else f"{s.wrong_verdicts} of {len(s.x)}"
    return {
        "method": s.method,
        "starts": place_of(s) or "nowhere",
        "fine": s.starts is None,
        "worst": error_text(s.worst),
        "verdicts": verdicts,
    }

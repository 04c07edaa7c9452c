"""Figures of pages: trials in the plane of stiffness and damping, and limits over each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.rendering.labels import UNITS
from pipeline.service.pages.plots import Layer, figure


def units_of(trials: Sequence[Mapping[str, Any]]) -> Any:
    """Return the units of trials, which move alike."""
    return UNITS[trials[0]["motion"] if trials else "translation"]


def _floats(rows: Sequence[Mapping[str, Any]], name: str, scale: float = 1.0) -> np.ndarray:
    return np.array([np.nan if row[name] is None else row[name] * scale for row in rows], dtype=np.float64)


def plane(trials: Sequence[Mapping[str, Any]], found: Mapping[str, Any] | None) -> Markup:
    """Return the trials of an experiment by verdict, with the measured limits."""
    layers = []
    for kind in ("stable", "unstable", "undecided", None):
        own = [t for t in trials if t["verdict"] == kind]
        if own:
            links = [f"/trials/{t['id']}" for t in own]
            place = _floats(own, "damping"), _floats(own, "stiffness")
            layers.append(Layer(kind or "none", *place, kind or "no verdict yet", links=links))
    if found:
        layers.append(_boundary(found["boundary"], "limit", "measured limit, 95 %"))
    unit = units_of(trials)
    return figure(
        layers, f"damping B [{unit.damping}]", f"stiffness K [{unit.stiffness}]", "Trials by verdict, and limits"
    )


def _boundary(points: Sequence[Mapping[str, Any]], kind: str, label: str, scale: tuple[float, float] = (1, 1)) -> Layer:
    ordered = sorted((p for p in points if p["estimate"] is not None), key=lambda p: p["damping"])
    x, y, low, high = (
        _floats(ordered, name, factor)
        for name, factor in (("damping", scale[1]), ("estimate", scale[0]), ("low", scale[0]), ("high", scale[0]))
    )
    return Layer(kind, x, y, label, low, high)


def limits(runs: Sequence[tuple[str, str, Mapping[str, Any]]]) -> list[tuple[str, Markup]]:
    """Return limits over each other: as measured where all move alike, and normalised where masses are known."""
    if not runs:
        return []
    motions = {document["motion"] for *_, document in runs}
    named = [(f"run-{i}", f"{d}, experiment {e}", doc["experiments"][0]) for i, (d, e, doc) in enumerate(runs)]
    plots = []
    if len(motions) == 1:
        unit = UNITS[motions.pop()]
        layers = [_boundary(found["boundary"], kind, label) for kind, label, found in named]
        plots.append(("Stability limits with their 95 % intervals", figure(
            layers, f"damping B [{unit.damping}]", f"stiffness K [{unit.stiffness}]", "Stability limits")))  # fmt: skip
    if all(found["theory"] for *_, found in named):
        layers = []
        for kind, label, found in named:
            period, mass = found["theory"]["sampling_period_s"], found["theory"]["mass"]
            layers.append(_boundary(found["boundary"], kind, label, (period**2 / mass, period / mass)))
        plots.append(("The same, normalised by mass and sampling period", figure(layers, "β = B T/m", "α = K T²/m",
                      "Normalised stability limits")))  # fmt: skip
    return plots

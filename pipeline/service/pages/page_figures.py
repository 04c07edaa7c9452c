"""What pages show of documents: trials in the plane of K and B, limits over each other, differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from pipeline.comparison.against import compare_pair
from pipeline.records.against_records import PairDifference, Side
from pipeline.records.results import ExperimentResult
from pipeline.records.score_records import TheoryParameters
from pipeline.rendering.labels import UNITS
from pipeline.service.catalogue import EXCLUDED
from pipeline.service.pages.plots import Layer, figure
from pipeline.theory.predictions import Theory

Run = tuple[str, str, Mapping[str, Any]]
"""Device, experiment, and the document of its comparison with theory."""


def units_of(trials: Sequence[Mapping[str, Any]]) -> Any:
    """Return the units of trials, which move alike."""
    return UNITS[trials[0]["motion"] if trials else "translation"]


def _floats(rows: Sequence[Mapping[str, Any]], name: str, scale: float = 1.0) -> np.ndarray:
    return np.array([np.nan if row[name] is None else row[name] * scale for row in rows], dtype=np.float64)


def plane(trials: Sequence[Mapping[str, Any]], found: Mapping[str, Any] | None) -> Markup:
    """Return the trials of an experiment by verdict, with the measured limits."""
    layers = []
    for kind in ("stable", "unstable", "undecided", EXCLUDED, None):
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


def planes(runs: Sequence[Run]) -> dict[str, str]:
    """Return the planes in which limits can be drawn over each other, by name, and what they are called.

    Those in K and B where all move alike, in alpha and beta where the mass of each is known.
    """
    found = {}
    if runs and len({document["motion"] for *_, document in runs}) == 1:
        found["physical"] = "stiffness K and damping B"
    if runs and all(_units(document) for *_, document in runs):
        found["normalised"] = "α and β, normalised by mass and sampling period"
    return found


def limits(runs: Sequence[Run], plane: str) -> Markup:
    """Return the measured limits of experiments over each other, in one of `planes`."""
    layers = []
    for i, (device, experiment, document) in enumerate(runs):
        units = _units(document) if plane == "normalised" else None
        scale = (1 / units[0], 1 / units[1]) if units else (1.0, 1.0)
        (found,) = document["experiments"]
        layers.append(_boundary(found["boundary"], f"run-{i}", f"{device}, experiment {experiment}", scale))
    if plane == "normalised":
        return figure(layers, "β = B T/m", "α = K T²/m", "Normalised stability limits")
    unit = UNITS[runs[0][2]["motion"]]
    return figure(
        layers, f"damping B [{unit.damping}]", f"stiffness K [{unit.stiffness}]", "Stability limits of experiments"
    )


def differences(first: Run, second: Run) -> tuple[PairDifference | None, str]:
    """Return what two experiments differ in, second minus first; None, and why, where devices cannot be compared."""
    scales = None
    if first[0] != second[0]:
        own, others = _units(first[2]), _units(second[2])
        if own is None or others is None:
            return None, (
                "two devices are compared in the plane of α and β, which needs the mass of each: there is no device "
                "file, and the logs of one give no estimate"
            )
        scales = own, others
    one, other = (
        Side(
            device=device,
            experiment=experiment,
            version=document["provenance"].get("version", "?"),
            code=document["provenance"].get("code", "?"),
            simulated=document["simulated"],
        )
        for device, experiment, document in (first, second)
    )
    a, b = (ExperimentResult.model_validate(document["experiments"][0]) for *_, document in (first, second))
    return compare_pair(one, other, (a, b), None, (first[2]["motion"], second[2]["motion"]), scales), ""


def _units(document: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the units of stiffness and damping that alpha and beta of 1 stand for; None without a theory."""
    theory = document["experiments"][0]["theory"]
    if theory is None:
        return None
    units = Theory(TheoryParameters.model_validate(theory)).units
    return units.stiffness, units.damping

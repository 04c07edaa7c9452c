"""Names of the stages of the measured branch and their dependencies. The functions are in `stages`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pipeline.records.criteria import FAMILIES, criterion_of

NEEDS: Mapping[str, tuple[str, ...]] = {
    "response": (),
    "wall_law": ("response",),
    "outcome": ("response",),
    "boundary": ("response", "wall_law"),
    "parts": ("response", "wall_law"),
    "device": ("response", "wall_law", "parts"),
    "model": ("response", "wall_law", "parts", "device"),
    "delay": ("response",),
    "mass": ("response", "delay"),
    **{name: family.needs for name, family in FAMILIES.items()},
}
"""Dependencies of each stage. The stages are in an order in which they can be computed."""

SPRUNG = frozenset(FAMILIES)
"""Stages that use the spring of the experiment."""


def required(stages: Iterable[str]) -> set[str]:
    """Return the given stages and all their dependencies.

    >>> sorted(required(["mass"]))
    ['delay', 'mass', 'response']
    """
    result: set[str] = set()
    for stage in stages:
        result |= {stage} | required(NEEDS[stage])
    return result


def cost_column(criterion: str) -> tuple[str, str]:
    """Return the stage and the column that contain the cost of a criterion."""
    known = criterion_of(criterion)
    return known.family.name, known.column

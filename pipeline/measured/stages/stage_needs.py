"""Stages of the measured branch by name, with those whose results each takes; what computes them is in `stages`."""

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
"""Stages in the order in which they can be computed; the plan is made backwards along what they need."""

SPRUNG = frozenset(FAMILIES)
"""Stages that take the declared spring of the experiment."""


def required(stages: Iterable[str]) -> set[str]:
    """Return the stages and all that they need.

    >>> sorted(required(["mass"]))
    ['delay', 'mass', 'response']
    """
    result: set[str] = set()
    for stage in stages:
        result |= {stage} | required(NEEDS[stage])
    return result


def cost_column(criterion: str) -> tuple[str, str]:
    """Return stage and column of the cost by a criterion."""
    known = criterion_of(criterion)
    return known.family.name, known.column

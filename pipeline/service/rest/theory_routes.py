"""REST of theory: ``/api/v1/theory/...``, in a process of its own (`theory`)."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query

from pipeline.service.problems import Problem
from pipeline.service.rest import answers, theory
from pipeline.service.rest.api import FiniteNumber
from pipeline.service.shared import Shared

theories = APIRouter(prefix="/api/v1/theory", responses={**answers.EVERYWHERE, **answers.problems(504)})

Coefficient = Annotated[float, Query(allow_inf_nan=False)]
Coordinates = Annotated[list[FiniteNumber], Query(max_length=theory.MOST_POINTS)]
Delay = Annotated[float, Query(ge=0, le=theory.LONGEST_DELAY, description="Delay in samples.")]


@theories.get("/boundary", response_model=answers.Boundary)
def boundary(service: Shared, delay: Delay, gamma: Coefficient = 0.0, delta: Coefficient = 0.0) -> Any:
    """Return the stability boundary of the ideal loop, normalised."""
    return service.theory.compute(theory.boundary, gamma, delta, delay)


@theories.get("/optimum", response_model=answers.BestPoint, response_model_exclude_unset=True)
def optimum(
    service: Shared,
    criterion: Literal[theory.OPTIMA],  # type: ignore[valid-type]
    delay: Delay,
    gamma: Coefficient = 0.0,
    delta: Coefficient = 0.0,
    signal: Literal["continuous", "discrete"] | None = None,
) -> Any:
    """Return the point of least cost by a criterion, normalised."""
    return service.theory.compute(theory.optimum, gamma, delta, delay, criterion, signal)


@theories.get("/points", response_model=list[answers.Point])
def points(
    service: Shared,
    alpha: Coordinates,
    beta: Coordinates,
    delay: Delay,
    gamma: Coefficient = 0.0,
    delta: Coefficient = 0.0,
) -> Any:
    """Return stability and costs of points, normalised."""
    if len(alpha) != len(beta):
        raise Problem(422, "Each point needs an alpha and a beta.", where="alpha, beta")
    rows = [(a, b, gamma, delta, delay) for a, b in zip(alpha, beta, strict=True)]
    return service.theory.compute(theory.points, rows)

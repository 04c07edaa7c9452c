"""REST of theory: ``/api/v1/theory/...``; with a device in SI, else normalised."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Query

from pipeline.records.criteria import CRITERIA, with_discrete
from pipeline.service.problems import Problem
from pipeline.service.rest import answers
from pipeline.service.rest.api import FiniteNumber, Name
from pipeline.service.shared import Shared
from pipeline.theory.optimum import POINT_CRITERIA

theories = APIRouter(prefix="/api/v1/theory", responses={**answers.EVERYWHERE, **answers.problems(404, 504)})

LONGEST_DELAY, MOST_POINTS = 64.0, 500
"""Samples, and walls; more is for the command line."""

OPTIMA = (*POINT_CRITERIA, *with_discrete(CRITERIA))
"""Criteria that have an optimum."""

Coefficient = Annotated[float, Query(allow_inf_nan=False)]
Coordinates = Annotated[list[FiniteNumber], Query(max_length=MOST_POINTS)]
Delay = Annotated[float | None, Query(ge=0, le=LONGEST_DELAY, description="Delay in samples, without a device.")]
Device = Annotated[Name | None, Query(description="Name of a device; all is then in SI, for its experiment.")]


def loop_of(
    delay: Delay = None,
    gamma: Coefficient = 0.0,
    delta: Coefficient = 0.0,
    device: Device = None,
    experiment: Name | None = None,
) -> tuple[Any, ...]:
    """Return which loop is asked for, as `theory.document` takes it."""
    if device is None:
        if delay is None:
            raise Problem(422, "Give the delay in samples, or a device.", where="delay")
        return gamma, delta, delay
    if delay is not None or gamma or delta:
        raise Problem(422, "A device has a delay, gamma and delta of its own. Leave these out.", where="device")
    return device, experiment


Of = Annotated[tuple[Any, ...], Depends(loop_of)]


@theories.get("/boundary", response_model=dict[str, Any])
def boundary(service: Shared, of: Of) -> Any:
    """Return the stability boundary, as `pipeline theory boundary --json`."""
    return service.theory.compute("boundary", of)


@theories.get("/optimum", response_model=dict[str, Any])
def optimum(
    service: Shared,
    of: Of,
    criterion: Literal[OPTIMA],  # type: ignore[valid-type]
    signal: Literal["continuous", "discrete"] | None = None,
) -> Any:
    """Return the point of least cost by a criterion, as `pipeline theory optimum --json`."""
    return service.theory.compute("optimum", of, criterion, signal)


@theories.get("/points", response_model=list[dict[str, Any]])
def points(
    service: Shared,
    of: Of,
    alpha: Coordinates = [],  # noqa: B006
    beta: Coordinates = [],  # noqa: B006
    stiffness: Coordinates = [],  # noqa: B006
    damping: Coordinates = [],  # noqa: B006
) -> Any:
    """Return stability and costs of points: alpha and beta, or with a device stiffness and damping."""
    names = "stiffness, damping" if len(of) == 2 else "alpha, beta"
    first, second = (stiffness, damping) if len(of) == 2 else (alpha, beta)
    if len(first) != len(second) or not first:
        raise Problem(422, f"Each point needs {names.replace(',', ' and')}.", where=names)
    return service.theory.compute("points", of, list(zip(first, second, strict=True)))

"""REST of theory: ``/api/v1/theory/...``, in a process of its own (`theory`); with a device in SI, else normalised."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query

from pipeline.loop.loop import Loop
from pipeline.service.problems import Problem
from pipeline.service.rest import answers, theory
from pipeline.service.rest.api import FiniteNumber, Name
from pipeline.service.shared import Shared
from pipeline.theory.cases import Case

theories = APIRouter(prefix="/api/v1/theory", responses={**answers.EVERYWHERE, **answers.problems(404, 504)})

Coefficient = Annotated[float, Query(allow_inf_nan=False)]
Coordinates = Annotated[list[FiniteNumber], Query(max_length=theory.MOST_POINTS)]
Delay = Annotated[float | None, Query(ge=0, le=theory.LONGEST_DELAY, description="Delay in samples, without a device.")]
Device = Annotated[Name | None, Query(description="Name of a device; all is then in SI, for its experiment.")]


def _case(device: str | None, experiment: str | None, *numbers: float | None) -> Case | tuple[str, str | None]:
    """Return the loop of gamma, delta and delay, or the names of a device and its experiment."""
    gamma, delta, delay = numbers
    if device is not None and (delay is not None or gamma or delta):
        raise Problem(422, "A device has a delay, gamma and delta of its own. Leave these out.", where="device")
    if device is not None:
        return device, experiment
    if delay is None:
        raise Problem(422, "Give the delay in samples, or a device.", where="delay")
    return Case(Loop(gamma or 0.0, delta or 0.0, delay))


@theories.get("/boundary", response_model=answers.Boundary | dict[str, Any])
def boundary(
    service: Shared,
    delay: Delay = None,
    gamma: Coefficient = 0.0,
    delta: Coefficient = 0.0,
    device: Device = None,
    experiment: Name | None = None,
) -> Any:
    """Return the stability boundary."""
    return service.theory.compute(theory.document, "boundary", _case(device, experiment, gamma, delta, delay))


@theories.get("/optimum", response_model=answers.BestPoint | dict[str, Any], response_model_exclude_unset=True)
def optimum(
    service: Shared,
    criterion: Literal[theory.OPTIMA],  # type: ignore[valid-type]
    delay: Delay = None,
    gamma: Coefficient = 0.0,
    delta: Coefficient = 0.0,
    signal: Literal["continuous", "discrete"] | None = None,
    device: Device = None,
    experiment: Name | None = None,
) -> Any:
    """Return the point of least cost by a criterion."""
    case = _case(device, experiment, gamma, delta, delay)
    return service.theory.compute(theory.document, "optimum", case, criterion, signal)


@theories.get("/points", response_model=list[answers.Point | dict[str, Any]])
def points(
    service: Shared,
    alpha: Coordinates = [],  # noqa: B006
    beta: Coordinates = [],  # noqa: B006
    stiffness: Coordinates = [],  # noqa: B006
    damping: Coordinates = [],  # noqa: B006
    delay: Delay = None,
    gamma: Coefficient = 0.0,
    delta: Coefficient = 0.0,
    device: Device = None,
    experiment: Name | None = None,
) -> Any:
    """Return stability and costs of points: alpha and beta, or with a device stiffness and damping."""
    case = _case(device, experiment, gamma, delta, delay)
    (name, first), (other, second) = (
        (("stiffness", stiffness), ("damping", damping)) if device is not None else (("alpha", alpha), ("beta", beta))
    )
    if len(first) != len(second) or not first:
        raise Problem(422, f"Each point needs {name} and {other}.", where=f"{name}, {other}")
    return service.theory.compute(theory.document, "points", case, list(zip(first, second, strict=True)))

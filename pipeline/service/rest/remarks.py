"""REST for what people say of trials and experiments: notes, tags, and exclusions."""

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends
from pydantic import BaseModel, ConfigDict, Field

from pipeline.service.rest import answers
from pipeline.service.rest.api import Segment
from pipeline.service.shared import Shared

remarks = APIRouter(prefix="/api/v1", responses=answers.EVERYWHERE)


class Notes(BaseModel):
    """A text on a trial or experiment."""

    model_config = ConfigDict(extra="forbid")
    text: Annotated[str, Field(max_length=100_000)]


class Tags(BaseModel):
    """Short words on a trial or experiment."""

    model_config = ConfigDict(extra="forbid")
    tags: Annotated[list[Annotated[str, Field(min_length=1, max_length=100)]], Field(max_length=100)]


class Exclusion(BaseModel):
    """Why a trial, or all of an experiment, is to be used for no number; null: it is used again."""

    model_config = ConfigDict(extra="forbid")
    reason: Annotated[str, Field(min_length=1, max_length=1000)] | None


def of_trial(service: Shared, trial: str) -> list[str]:
    """Return what notes of a trial belong to."""
    service.found(trial)
    return ["trial", trial]


def of_experiment(service: Shared, device: Segment, experiment: Segment) -> list[str]:
    """Return what notes of an experiment belong to."""
    service.experiments(device, [experiment])
    return ["experiment", device, experiment]


def _add_words(owner: str, of: Callable[..., list[str]]) -> None:
    """Add the routes of notes and tags of trials or experiments."""
    owned = Annotated[list[str], Depends(of)]

    @remarks.get(f"{owner}/notes", response_model=Notes, responses=answers.NAMED)
    def notes(service: Shared, of: owned) -> dict[str, Any]:
        return {"text": service.database.words("notes", of)}

    @remarks.put(f"{owner}/notes", response_model=Notes, responses=answers.NAMED)
    def put_notes(service: Shared, of: owned, notes: Notes) -> dict[str, Any]:
        service.database.set_words("notes", of, notes.text)
        return notes.model_dump()

    @remarks.get(f"{owner}/tags", response_model=Tags, responses=answers.NAMED)
    def tags(service: Shared, of: owned) -> dict[str, Any]:
        return {"tags": service.database.words("tags", of)}

    @remarks.put(f"{owner}/tags", response_model=Tags, responses=answers.NAMED)
    def put_tags(service: Shared, of: owned, tags: Tags) -> dict[str, Any]:
        service.database.set_words("tags", of, tags.tags)
        return tags.model_dump()


@remarks.get("/trials/{trial}/exclusion", response_model=answers.Excluded, responses=answers.NAMED)
def excluded(service: Shared, trial: str) -> dict[str, Any]:
    """Return why a trial is excluded by hand."""
    return {"excluded": service.excluded(trial)}


@remarks.put("/trials/{trial}/exclusion", response_model=answers.Excluded, responses=answers.NAMED)
def put_exclusion(service: Shared, trial: str, asked: Exclusion) -> dict[str, Any]:
    """Exclude a trial by hand, or use it again."""
    return {"excluded": service.exclude(trial, asked.reason)}


EXPERIMENT_EXCLUSION = "/experiments/{device}/{experiment}/exclusion"


@remarks.get(EXPERIMENT_EXCLUSION, response_model=answers.Excluded, responses=answers.NAMED)
def excluded_of(service: Shared, device: Segment, experiment: Segment) -> dict[str, Any]:
    """Return the trials of an experiment that are excluded by hand."""
    return {"excluded": service.excluded_of(device, experiment)}


@remarks.put(EXPERIMENT_EXCLUSION, response_model=answers.Excluded, responses=answers.NAMED)
def put_exclusions(service: Shared, device: Segment, experiment: Segment, asked: Exclusion) -> dict[str, Any]:
    """Exclude all trials of an experiment that are in use, or use all again."""
    return {"excluded": service.exclude_experiment(device, experiment, asked.reason)}


for owner, of in (("/trials/{trial}", of_trial), ("/experiments/{device}/{experiment}", of_experiment)):
    _add_words(owner, of)

"""REST interface for the data and requests of a lab: profiles, refused logs, next walls, figures, and theory (in SI if
a device is given)."""

import os
import secrets
import shutil
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query, Request
from fastapi.responses import JSONResponse, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from pipeline.base.json_object import JsonObject
from pipeline.base.paths import path_of_text
from pipeline.intake.quarantine import list_quarantine, record_id, remove_from_quarantine
from pipeline.records.criteria import CRITERIA, with_discrete
from pipeline.service import device_files, profiles
from pipeline.service.problems import Problem
from pipeline.service.rest import answers
from pipeline.service.rest.api import FiniteNumber, Name, Segment, awaited, files_of
from pipeline.service.shared import Form, Service, Shared, Who
from pipeline.service.uploads import Check, received
from pipeline.theory.optimum import POINT_CRITERIA

lab = APIRouter(prefix="/api/v1", responses=answers.EVERYWHERE)

ProfileName = Annotated[str, Path(pattern=profiles.NAME)]
Toml = Annotated[str, Field(max_length=profiles.LONGEST)]


class ProfileText(Form):
    """A profile as TOML."""

    profile: Toml


class Tried(ProfileText):
    """A profile, and the sample of a draft that it should read."""

    sample: Annotated[str, Field(pattern="^[0-9a-f]{16}$")]


class KeptProfile(ProfileText):
    """A profile, and the sample of a draft that it must agree with.

    The command of a sample may follow a different stiffness, damping or step than the profile states. The profile is
    then stored only with a confirmation that explains why the profile is right.
    """

    sample: Annotated[str, Field(pattern="^[0-9a-f]{16}$")] | None = None
    confirmation: Annotated[str, Field(max_length=1000)] = ""


class NamedProfile(Form):
    """The name of a profile of the lab."""

    name: Annotated[str, Field(pattern=profiles.NAME)]


class DeviceText(Form):
    """A device file as TOML."""

    file: Toml


class Retry(Form):
    """The profile for reading a refused log again. If empty, the profile that matches the file name is used."""

    profile: Annotated[str, Field(max_length=100)] = ""


@lab.get("/profiles", response_model=list[str])
def profile_names(service: Shared) -> list[str]:
    """List the profiles: first those of the lab, then the shipped profiles."""
    return profiles.names(service.settings)


@lab.get("/profiles/{name}", response_model=ProfileText, responses=answers.NAMED)
def profile(service: Shared, name: ProfileName) -> dict[str, str]:
    """Return the TOML of a profile."""
    return {"profile": profiles.text_of(service.settings, name)}


@lab.put("/profiles/{name}", response_model=ProfileText, responses=answers.problems(404, 409, 422, 504))
def put_profile(service: Shared, who: Who, name: ProfileName, asked: KeptProfile) -> dict[str, str]:
    """Store a profile of the lab, replacing an earlier profile with the same name. The profile must not contradict its
    sample."""
    text, version = profiles.checked_text(service.settings, name, asked.profile)
    action: JsonObject = {"name": name, "version": version}
    if asked.sample is not None:
        words, found = asked.confirmation.strip(), _contradictions(service, asked)
        if not words:
            profiles.refuse_contradictions(found)
        elif found:
            text = profiles.with_confirmation(text, words, who, found)
            action |= {"confirmed": words, "contradictions": [f"{one.where}: {one.found}" for one in found]}
    profiles.keep(service.settings, name, text)
    service.database.note(who, "kept a profile", action)
    return {"profile": asked.profile if "confirmed" not in action else text}


def _contradictions(service: Service, asked: KeptProfile) -> list[profiles.Contradiction]:
    """Return the contradictions between a profile and its sample. With a confirmation, an unsuccessful check is also
    returned."""
    try:
        return profiles.contradictions(preview(service, Tried(profile=asked.profile, sample=asked.sample or "")))
    except Problem as problem:
        if not asked.confirmation.strip():
            raise
        return [profiles.Contradiction("sample", "", f"The profile could not be checked: {problem}")]


@lab.get("/devices/{device}/file", response_model=DeviceText, responses=answers.NAMED)
def device_text(device: Segment) -> dict[str, str]:
    """Return the TOML of a device."""
    return {"file": device_files.text_of(device)}


@lab.put("/devices/{device}/file", response_model=DeviceText, responses=answers.problems(404, 409, 422))
def put_device(service: Shared, who: Who, device: Segment, asked: DeviceText) -> dict[str, str]:
    """Store the file of a device. It is used from the next comparison, theory or plan on."""
    device_files.keep(device, asked.file)
    service.database.note(who, "kept a device file", {"device": device})
    return {"file": asked.file}


@lab.delete("/devices/{device}/file", status_code=204, response_class=Response, responses=answers.NAMED)
def remove_device(service: Shared, who: Who, device: Segment) -> Response:
    """Remove the lab's file of a device. A shipped file of this device is used again."""
    device_files.remove(device)
    service.database.note(who, "removed a device file", {"device": device})
    return Response(status_code=204)


@lab.post("/profiles/draft", openapi_extra=files_of(), responses=answers.problems(504))
async def draft(service: Shared, request: Request) -> answers.Draft:
    """Draft a profile for sample logs. The samples are kept for a day, for previews."""
    return await drafted(service, request)


async def drafted(service: Service, request: Request, check: Check = lambda _: None) -> answers.Draft:
    """Return the draft of a profile for the files of a request."""
    sample = secrets.token_hex(8)
    folder = profiles.samples_folder(service.settings, sample)
    async with received(service.settings, request, check, folder) as upload:
        text = await run_in_threadpool(profiles.draft, upload.folder)
    return answers.Draft(sample=sample, profile=text, questions=profiles.questions(text))


@lab.post("/profiles/preview", response_model=list[Any], responses=answers.problems(404, 504))
def preview(service: Shared, asked: Tried) -> list[Any]:
    """Return a preview of the data that a profile would read from the sample of a draft, as `pipeline profile check
    --json`."""
    folder = profiles.samples_folder(service.settings, asked.sample)
    if not folder.is_dir():
        raise Problem(
            404, "The sample is no longer stored. Draft the profile again.", where="sample", found=asked.sample
        )
    return profiles.preview(folder, asked.profile)


@lab.get("/quarantine")
def quarantine(service: Shared) -> list[answers.Refused]:
    """List the logs that were refused, with the reason and the date."""
    processed, sent = service.settings.processed, service.database.uploaded()
    found = []
    for record in list_quarantine(processed, {}):
        name, author = sent.get(record.path, (str(path_of_text(record.path)), None))
        since = os.stat(processed / "quarantine" / record_id(record)).st_mtime
        shown = record.model_dump(include={"row", "reason", "code", "profile", "profile_line"})
        found.append(answers.Refused(**shown, id=record_id(record), since=since, name=name, author=author))
    return found


def _paths_of(service: Service, which: str) -> dict[str, str]:
    """Return the paths of refused logs, given by their ids (separated by commas), and the names under which they were
    uploaded."""
    known = {record_id(record): record.path for record in list_quarantine(service.settings.processed, {})}
    for one in which.split(","):
        if one not in known:
            raise Problem(404, "There is no such log in quarantine.", where="id", found=one)
    return {known[one]: service.database.uploaded_name(known[one]) for one in which.split(",")}


@lab.post("/quarantine/{which}/retry", status_code=202, response_model=answers.Queued, response_model_exclude_none=True,
          responses=answers.NAMED)  # fmt: skip
def retry(service: Shared, who: Who, which: str, asked: Retry) -> dict[str, str]:
    """Read refused logs (ids separated by commas) again, with a different profile if one is given."""
    paths = _paths_of(service, which)
    for path in paths:
        if not path_of_text(path).exists():
            raise Problem(
                409,
                "The log is no longer at the path where it was refused. Send it again.",
                where="id",
                found=path_of_text(path).name,
            )
    profiles.profile_path(service.settings, asked.profile)
    service.database.note(who, "tried again", {"logs": list(paths.values()), "profile": asked.profile})
    request = {"folder": "", "profile": asked.profile, "skipped": 0, "again": list(paths)}
    return {"job": service.job("upload", request, author=who)}


@lab.delete("/quarantine/{which}", status_code=204, response_class=Response, responses=answers.NAMED)
def dismiss(service: Shared, who: Who, which: str) -> Response:
    """Remove refused logs (ids separated by commas) from quarantine, and uploaded logs also from the uploads."""
    paths = _paths_of(service, which)
    for path in paths:
        log = path_of_text(path)
        if (service.settings.data / "logs").absolute() in log.absolute().parents:
            service.database.run("DELETE FROM uploads WHERE path = ?", path)
            shutil.rmtree(log) if log.is_dir() else log.unlink(missing_ok=True)
        remove_from_quarantine(service.settings.processed, path)
    service.database.note(who, "dismissed", {"logs": list(paths.values())})
    return Response(status_code=204)


@lab.get("/plan", response_model=JsonObject, responses=answers.LATER)
async def plan(
    service: Shared, device: Name, experiment: Name, goal: Literal["boundary", "optimum"] = "boundary"
) -> Response:
    """Return the recommended next walls, as `pipeline plan --json`."""
    return JSONResponse(await awaited(service, lambda: service.plan(device, experiment, goal)))


SVG: dict[int | str, JsonObject] = {200: {"content": {"image/svg+xml": {}}}}


@lab.get("/figures/{device}/{experiment}/{name}.svg", response_class=Response, responses={**SVG, **answers.LATER})
async def figure(service: Shared, device: Segment, experiment: Segment, name: str) -> Response:
    """Return a figure of an experiment: ``limits`` (with theory) or ``response``."""
    from pipeline.rendering.figures.drawing import standalone

    figures = (await awaited(service, lambda: service.experiment(device, experiment)))["figures"]
    if name not in figures:
        raise Problem(404, "There is no such figure.", where="name", expected=sorted(figures), found=name)
    return Response(standalone(figures[name]["panels"][0]), media_type="image/svg+xml")


SLOW = answers.problems(404, 504)
LONGEST_DELAY, MOST_POINTS = 64.0, 500
"""Largest delay [samples] and largest number of walls in a request. For larger numbers, use the command line."""

OPTIMA = (*POINT_CRITERIA, *with_discrete(CRITERIA))
"""Criteria that have an optimum."""

Coefficient = Annotated[float, Query(allow_inf_nan=False)]
Coordinates = Annotated[list[FiniteNumber], Query(max_length=MOST_POINTS)]
Delay = Annotated[float | None, Query(ge=0, le=LONGEST_DELAY, description="Delay in samples, without a device.")]
Device = Annotated[
    Name | None,
    Query(description="Name of a device. All values are then in SI, for the given experiment of the device."),
]


def requested_loop(
    delay: Delay = None,
    gamma: Coefficient = 0.0,
    delta: Coefficient = 0.0,
    device: Device = None,
    experiment: Name | None = None,
) -> tuple[Any, ...]:
    """Return the requested loop as the input of `theory.document`."""
    if device is None:
        if delay is None:
            raise Problem(422, "State the delay in samples, or name a device.", where="delay")
        return gamma, delta, delay
    if delay is not None or gamma or delta:
        raise Problem(422, "A device already determines delay, gamma and delta. Omit these parameters.", where="device")
    return device, experiment


Of = Annotated[tuple[Any, ...], Depends(requested_loop)]


@lab.get("/theory/boundary", response_model=JsonObject, responses=SLOW)
def boundary(service: Shared, of: Of) -> Any:
    """Return the stability boundary, as `pipeline theory boundary --json`."""
    return service.theory.compute("boundary", of)


@lab.get("/theory/optimum", response_model=JsonObject, responses={**answers.LATER, **SLOW})
async def optimum(
    service: Shared,
    of: Of,
    criterion: Literal[OPTIMA],  # type: ignore[valid-type]
    signal: Literal["continuous", "discrete"] | None = None,
) -> Any:
    """Return the point of least cost by a criterion, as `pipeline theory optimum --json`, or 202 if the computation
    takes longer."""
    return JSONResponse(await awaited(service, lambda: service.optimum(of, criterion, signal)))


@lab.get("/theory/points", response_model=list[JsonObject], responses=SLOW)
def points(
    service: Shared,
    of: Of,
    alpha: Coordinates = [],  # noqa: B006
    beta: Coordinates = [],  # noqa: B006
    stiffness: Coordinates = [],  # noqa: B006
    damping: Coordinates = [],  # noqa: B006
) -> Any:
    """Return the stability and the costs of points, given by alpha and beta, or by stiffness and damping for a
    device."""
    names = "stiffness, damping" if len(of) == 2 else "alpha, beta"
    first, second = (stiffness, damping) if len(of) == 2 else (alpha, beta)
    if len(first) != len(second) or not first:
        raise Problem(422, f"Each point needs {names.replace(',', ' and')}.", where=names)
    return service.theory.compute("points", of, list(zip(first, second, strict=True)))

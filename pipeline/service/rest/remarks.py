"""REST interface for remarks on stored data and for corrections: notes, tags, exclusions, moves, deletions, and the
audit."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header
from fastapi.responses import JSONResponse, Response
from pydantic import Field, create_model

from pipeline.base.provenance import digest
from pipeline.service.database import Deed, Words
from pipeline.service.problems import Problem
from pipeline.service.rest import answers
from pipeline.service.rest.api import Cursor, Limit, Segment, latest
from pipeline.service.shared import Form, Service, Shared, Who, run_of
from pipeline.store import corrections
from pipeline.store.storage import list_experiments

remarks = APIRouter(prefix="/api/v1", responses=answers.EVERYWHERE)

Name = Annotated[str, Field(min_length=1, max_length=200)]
CORRECT_S = 5.0
"""Longest wait for another writer before a correction is refused [s]."""

STALE = answers.problems(404, 412)
IfMatch = Annotated[str | None, Header(alias="If-Match", max_length=100)]


class Notes(Form):
    """A note on a trial or experiment."""

    text: Annotated[str, Field(max_length=100_000)]


class Tags(Form):
    """Tags of a trial or experiment."""

    tags: Annotated[list[Annotated[str, Field(min_length=1, max_length=100)]], Field(max_length=100)]


class Exclusion(Form):
    """Reason why a trial or a whole experiment is excluded from all results. With null, the trials are used again."""

    reason: Annotated[str, Field(min_length=1, max_length=1000)] | None


class DeviceChange(Form):
    """The new name of a device."""

    device: Name


class Change(Form):
    """New place of an experiment or a trial; omitted fields stay unchanged."""

    device: Name | None = None
    experiment: Name | None = None


class InBin(Form):
    """Selection of trials in the bin: all trials of a device or of one of its experiments, or a single trial."""

    device: Name | None = None
    experiment: Name | None = None
    trial: Name | None = None


def of_trial(service: Shared, trial: str) -> list[str]:
    """Return a trial as the owner of notes and tags."""
    service.found(trial)
    return ["trial", trial]


def of_experiment(service: Shared, device: Segment, experiment: Segment) -> list[str]:
    """Return an experiment as the owner of notes and tags."""
    service.experiments(device, [experiment])
    return ["experiment", device, experiment]


def of_device(service: Shared, device: Segment) -> list[str]:
    """Return a device as the object to rename or delete."""
    service.experiments(device, None)
    return ["device", device]


def tag_of(found: Words) -> str:
    """Return the ETag of notes or tags, which differs after each change."""
    return f'"{digest([found.value, found.changed])}"'


def keep_words(service: Service, kind: str, of: list[str], value: object, who: str, known: str | None) -> None:
    """Store notes or tags, unless they have changed since the ETag that the sender knew."""
    with service.database.transaction():
        found = service.database.words(kind, of)
        if known not in (None, "*", tag_of(found)):
            raise Problem(
                412,
                f"{found.author or 'Another user'} has changed this text in the meantime. Read the current version, "
                "and repeat your change.",
                where="If-Match",
            )
        if found.value != value:
            service.database.set_words(kind, of, value, who)
            service.database.note(who, f"wrote {kind}", {"of": of})


WRITTEN = {
    form: create_model(
        f"Written{form.__name__}", __base__=form, __doc__=form.__doc__, author=str | None, changed=float | None
    )
    for form in (Notes, Tags)
}
"""Models of the responses with notes or tags, with the author and the time of the last change."""


def _add_words(path: str, of: Callable[..., list[str]], form: type[Notes | Tags]) -> None:
    """Add the routes of notes or tags, whose path ends with the kind and whose form has one field."""
    owned = Annotated[list[str], Depends(of)]
    kind, (name,), answer = path.rpartition("/")[2], form.model_fields, WRITTEN[form]

    @remarks.get(path, response_model=answer, responses=answers.NAMED)
    def words(service: Shared, of: owned) -> Response:
        """Return notes or tags, with their author and time. Send the ETag of this answer as If-Match of a change."""
        found = service.database.words(kind, of)
        shown = {name: found.value, "author": found.author, "changed": found.changed}
        return JSONResponse(shown, headers={"ETag": tag_of(found)})

    def put_words(service: Shared, who: Who, of: owned, asked: Any, match: IfMatch = None) -> Response:
        """Replace notes or tags, unless they have changed since the version with the ETag in If-Match."""
        keep_words(service, kind, of, getattr(asked, name), who, match)
        return words(service, of)

    put_words.__annotations__["asked"] = form  # the framework determines the body from this annotation
    remarks.put(path, response_model=answer, responses=STALE)(put_words)


def _add_remarks(owner: str, of: Callable[..., list[str]]) -> None:
    """Add the routes for notes, tags and changes to trials or experiments."""
    _add_words(f"{owner}/notes", of, Notes)
    _add_words(f"{owner}/tags", of, Tags)
    owned = Annotated[list[str], Depends(of)]

    @remarks.get(f"{owner}/exclusion", responses=answers.NAMED)
    def excluded(service: Shared, of: owned) -> dict[str, dict[str, str]]:
        """Return the manually excluded trials, with the reasons."""
        return {"excluded": service.excluded(of)}

    @remarks.put(f"{owner}/exclusion", responses=answers.NAMED)
    def put_exclusion(service: Shared, who: Who, of: owned, asked: Exclusion) -> dict[str, dict[str, str]]:
        """Exclude a trial or an experiment manually with a reason, or use it again (null)."""
        known, words = service.excluded(of), (service.settings.processed, words_for(of))
        if asked.reason is not None:
            corrections.exclude(*words, asked.reason, CORRECT_S)
        elif known:
            corrections.use_again(*words, CORRECT_S)
        found = service.excluded(of)
        did = "used again" if asked.reason is None else "excluded"
        _corrected(service, who, did, of, len(found or known), reason=asked.reason)
        return {"excluded": found}


def _add_places(owner: str, of: Callable[..., list[str]], form: type[DeviceChange | Change]) -> None:
    """Add the routes that rename, move and delete."""
    owned = Annotated[list[str], Depends(of)]

    def move(service: Shared, who: Who, of: owned, asked: Any) -> dict[str, int]:
        """Rename, or move to another place. Notes and tags are moved as well. Return the number of trials."""
        processed, names = service.settings.processed, list[str]()
        if of[0] == "trial":
            found = service.found(of[1])
            device, experiment = found.device, [found.experiment]
        else:
            device, *experiment = of[1:]
            names = experiment or list_experiments(processed, device)
        name = getattr(asked, "experiment", None)
        to = [asked.device or device, *([name] if name else experiment)]
        count = corrections.move(processed, words_for(of), run_of(*to), CORRECT_S)
        for old in names:
            service.database.move_words(["experiment", device, old], ["experiment", to[0], (*to, old)[1]])
        return _corrected(service, who, "moved", of, count, to=to)

    move.__annotations__["asked"] = form
    remarks.patch(owner, response_model=dict[str, int], responses=answers.NAMED)(move)

    @remarks.delete(owner, response_model=dict[str, int], responses=answers.NAMED)
    def delete(service: Shared, who: Who, of: owned) -> dict[str, int]:
        """Move to the bin, from which trials can be restored. Return the number of trials."""
        count = corrections.delete(service.settings.processed, words_for(of), CORRECT_S)
        return _corrected(service, who, "deleted", of, count)


def words_for(of: Sequence[str]) -> str:
    """Return the name of a trial, an experiment or a device as used by `store.corrections`."""
    return of[1] if of[0] == "trial" else run_of(*of[1:])


def _corrected(service: Service, who: str, did: str, of: Sequence[str], trials: int, **more: object) -> dict[str, int]:
    """Record a correction in the audit, request new verdicts, and return the number of trials."""
    service.database.note(who, did, {"of": of, "trials": trials, **more})
    service.job("stages", {}, "stages")
    return {"trials": trials}


TRIAL, EXPERIMENT, DEVICE = "/trials/{trial}", "/experiments/{device}/{experiment}", "/devices/{device}"
_add_remarks(TRIAL, of_trial)
_add_remarks(EXPERIMENT, of_experiment)
_add_places(TRIAL, of_trial, Change)
_add_places(EXPERIMENT, of_experiment, Change)
_add_places(DEVICE, of_device, DeviceChange)


class Chosen(Form):
    """Ids of trials, and a change of all of them: a reason for their exclusion, or tags to add."""

    trials: Annotated[list[Name], Field(min_length=1, max_length=1000)]
    reason: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    tags: Annotated[tuple[Annotated[str, Field(min_length=1, max_length=100)], ...], Field(max_length=20)] = ()


@remarks.post("/marks", response_model=dict[str, int], responses=answers.problems(404, 422))
def mark(service: Shared, who: Who, asked: Chosen) -> dict[str, int]:
    """Exclude trials for a reason, or add tags to them. Return the number of trials. All must exist."""
    if (asked.reason is None) == (not asked.tags):
        raise Problem(
            422, "State either a reason for the exclusion of the trials, or tags to add to them.", where="reason"
        )
    owners = [of_trial(service, trial) for trial in dict.fromkeys(asked.trials)]
    for of in owners:
        if asked.reason is not None:
            corrections.exclude(service.settings.processed, of[1], asked.reason, CORRECT_S)
        else:
            known = service.database.words("tags", of).value
            keep_words(service, "tags", of, list(dict.fromkeys([*known, *asked.tags])), who, None)
    if asked.reason is None:
        return {"trials": len(owners)}
    return _corrected(service, who, "excluded", ["trials", *(of[1] for of in owners)], len(owners), reason=asked.reason)


@remarks.get("/bin")
def bin_(service: Shared) -> list[answers.Deleted]:
    """List the deleted trials that are still stored."""
    name_of = service.database.uploaded_name
    return [
        answers.Deleted(
            trial_id=one.trial_id, device=one.device, experiment=one.experiment, source=name_of(one.source_path)
        )
        for one in corrections.in_bin(service.settings.processed)
    ]


@remarks.post("/bin/restore", response_model=dict[str, int])
def restore(service: Shared, who: Who, asked: InBin) -> dict[str, int]:
    """Take trials out of the bin."""
    names = [name for name in (asked.device, asked.experiment) if name]
    of = ["trial", asked.trial] if asked.trial else ["experiment", *names]
    count = corrections.restore(service.settings.processed, words_for(of), CORRECT_S)
    return _corrected(service, who, "restored", of, count)


@remarks.delete("/bin", response_model=dict[str, int])
def empty_bin(service: Shared, who: Who) -> dict[str, int]:
    """Remove the trials in the bin from the store. Log files are never changed."""
    count = corrections.empty_bin(service.settings.processed, CORRECT_S)
    return _corrected(service, who, "emptied the bin", (), count)


@remarks.get("/audit")
def audit(service: Shared, limit: Limit = 100, cursor_: Cursor = None) -> answers.Page[Deed]:
    """List manual actions with their users, latest first."""
    return latest(service.database.audit, limit, cursor_)

"""Resources that all requests share. They are the store, its jobs, and queries of both."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
from fastapi import Depends, Request
from pydantic import BaseModel, ConfigDict, Field

from pipeline.base.errors import PipelineError
from pipeline.base.json_object import JsonObject
from pipeline.records.criteria import REPORTED
from pipeline.records.findings import Note
from pipeline.records.trials import Floats
from pipeline.service import documents
from pipeline.service.catalogue import Catalogue, Trial
from pipeline.service.database import Database
from pipeline.service.problems import Problem
from pipeline.service.settings import Settings
from pipeline.service.theory import Theory, case_of_loop
from pipeline.service.workers import Workers
from pipeline.store.names import folder_name
from pipeline.store.samples import load_trial, load_trials
from pipeline.store.storage import list_devices, list_experiments, read_exclusions, read_trials, split_trials

RETRY_S = 60.0
"""Time after which a failed computation is repeated if its result is requested again [s]."""

MOST_REPORTS = 1000
"""Largest number of reports that are listed and renewed."""

Kept = tuple[JsonObject | None, str | None]
"""A document, or the job that computes it."""


class Form(BaseModel):
    """Base of the models of requests. An unknown field is refused."""

    model_config = ConfigDict(extra="forbid")


class Against(Form):
    """Second experiment of a comparison."""

    device: Annotated[str, Field(max_length=500)]
    experiment: Annotated[str, Field(max_length=500)]


class ComparisonRequest(Form):
    """Request for a comparison."""

    device: Annotated[str, Field(max_length=500)]
    experiments: Annotated[list[str], Field(max_length=500)] | None = None
    criteria: Annotated[list[Literal[REPORTED]], Field(min_length=1)] | None = None  # type: ignore[valid-type]
    against: Against | None = None


@dataclass(frozen=True)
class Service:
    """Resources that all requests share."""

    settings: Settings
    database: Database
    catalogue: Catalogue
    workers: Workers
    theory: Theory

    def job(self, kind: str, request: JsonObject, key: str = "", author: str = "", late: int = 0) -> str:
        """Queue a job and wake a worker."""
        job = self.database.add_job(kind, request, key, None, author, late)
        self.workers.wake()
        return job

    def experiments(self, device: str, asked: list[str] | None) -> list[str]:
        """Return the stored experiments of a device that are named, or all stored experiments if none is named."""
        devices = list_devices(self.settings.processed)
        if device not in devices:
            raise Problem(404, "There are no trials of this device.", where="device", expected=devices, found=device)
        stored = list_experiments(self.settings.processed, device)
        for name in asked or ():
            if name not in stored:
                raise Problem(
                    404, "There are no trials of this experiment.", where="experiment", expected=stored, found=name
                )
        return [name for name in stored if not asked or name in asked]

    def used(self, device: str, asked: list[str] | None) -> list[str]:
        """Return the experiments of a device that have trials in use. If experiments are named, each of them must have
        such trials."""
        names = self.experiments(device, asked)
        excluded = read_exclusions(self.settings.processed)
        stored = ((name, read_trials(self.settings.processed, device, name)) for name in names if excluded)
        empty = [name for name, trials in stored if not split_trials(trials, excluded)[0].num_rows]
        if empty and (asked or empty == names):
            raise Problem(
                409, "All trials of this experiment are excluded manually. Include one of them again.",
                where=f"{device}, experiment {empty[0]}", expected="a trial in use", found="none",
            )  # fmt: skip
        return [name for name in names if name not in empty]

    def comparison(self, asked: ComparisonRequest, who: str = "", late: int = 0) -> tuple[str, str | None]:
        """Return the key of a comparison, and the job that computes it. There is no job if the comparison is stored."""
        names = self.used(asked.device, asked.experiments)
        request: JsonObject = {"device": asked.device, "experiments": names, "criteria": asked.criteria}
        if asked.against:
            self.used(asked.against.device, [asked.against.experiment])
            if len(names) != 1:
                raise Problem(422, "Exactly one experiment can be compared with another one.", where="experiments",
                              expected="one name", found=names)  # fmt: skip
            request["against"] = asked.against.model_dump()
            self._add_notes(request["against"], asked.against.device, [asked.against.experiment])
        self._add_notes(request, asked.device, names)
        key = documents.key_of(self.settings, request)
        if documents.document_file(self.settings, key, report=True).is_file():
            return key, None
        self._may_compute()
        wanted = {"key": key, "request": request, "asked": asked.model_dump()}
        return key, self.job("comparison", wanted, key, who, late)

    def renew(self) -> None:
        """Request all experiments and reports again whose logs were added or excluded."""
        for e in self.catalogue.experiments:
            with suppress(Problem, PipelineError):
                self.experiment(e.device, e.experiment, late=1)
        for job, earlier in self.database.reports(MOST_REPORTS):
            with suppress(Problem, PipelineError):  # its inputs no longer exist; the last report is kept
                if not earlier:
                    self.comparison(ComparisonRequest.model_validate(job.request["asked"]), late=1)

    def _add_notes(self, request: JsonObject, device: str, experiments: list[str]) -> None:
        """Add the notes on experiments and their trials to a request.

        Notes are part of a report, so that new notes cause a new report.
        """
        notes = [note for name in experiments for note in self.notes(device, name)]
        if notes:
            request["notes"] = [note.model_dump() for note in notes]

    def notes(self, device: str, experiment: str) -> list[Note]:
        """Return the notes on an experiment, followed by the notes on its trials."""
        texts, tags = dict[str | None, str](), dict[str | None, list[str]]()
        for kind, of, value in self.database.all_words():
            if of == ["experiment", device, experiment]:
                trial = None
            elif of[0] == "trial" and self._place(of[1]) == (device, experiment):
                trial = of[1]
            else:
                continue
            if kind == "notes":
                texts[trial] = value
            else:
                tags[trial] = value
        order = sorted(texts.keys() | tags.keys(), key=lambda trial: trial or "")
        words = ((trial, tuple(tags.get(trial, ())), texts.get(trial, "")) for trial in order)
        return [Note(experiment=experiment, trial_id=trial, tags=own, text=text) for trial, own, text in words]

    def excluded(self, of: Sequence[str]) -> dict[str, str]:
        """Return the manually excluded trials of an experiment, or a trial if it is excluded, with the reasons."""
        known = read_exclusions(self.settings.processed).values()
        own = [one for one in known if of[1:] in ([one.trial_id], [one.device, one.experiment])]
        return {one.trial_id: one.exclusion_reason for one in own}

    def experiment(self, device: str, experiment: str, late: int = 0) -> Kept:
        """Return the document of an experiment."""
        self.used(device, [experiment])
        return self._kept("experiment", documents.whole(device, experiment), late)

    def plan(self, device: str, experiment: str, goal: str) -> Kept:
        """Return the plan of an experiment."""
        self.used(device, [experiment])
        return self._kept("plan", {"device": device, "experiments": [experiment], "goal": goal})

    def drawn(self, what: str, places: Sequence[Sequence[str]], **more: Any) -> Kept:
        """Return a drawing of trials or experiments, given by device, experiment, and possibly the trial."""
        for device, experiment, *_ in places:
            self.used(device, [experiment])
        return self._kept("drawing", {"what": what, "places": [list(place) for place in places], **more})

    def optimum(self, of: Sequence[Any], *asked: Any) -> Kept:
        """Return the point with the lowest theoretical cost, for a loop as in `theory.document`."""
        case_of_loop(of)
        device = {"device": of[0], "experiments": []} if len(of) == 2 else {}
        return self._kept("optimum", {**device, "theory": ["optimum", of, *asked]})

    def peek(self, device: str, experiment: str) -> JsonObject | None:
        """Return the document of an experiment if it is stored."""
        key = documents.key_of(self.settings, documents.whole(device, experiment))
        return documents.read_document(self.settings, key)

    def _kept(self, kind: str, request: JsonObject, late: int = 0) -> Kept:
        """Return a stored document, or the job of the given kind that computes it."""
        key = documents.key_of(self.settings, request)
        if (document := documents.read_document(self.settings, key)) is not None:
            return document, None
        if self.settings.read_only and "theory" in request:  # needs no store
            return self.theory.compute(*request["theory"]), None
        self._may_compute()
        failed = self.database.failed_job(kind, key, RETRY_S)
        return None, failed or self.job(kind, {"key": key, "request": request}, key, late=late)

    def _may_compute(self) -> None:
        if self.settings.read_only:
            raise Problem(
                503,
                "This result has not been computed yet, and cannot be computed because the server is read-only.",
                where="server",
            )

    def samples(self, trial: str) -> tuple[Trial, pa.Table]:
        """Return the conditions and the samples of a trial."""
        shown = self.found(trial)
        samples = self._loaded(shown)
        columns = {"time_s": samples.pop("time"), **samples}
        return shown, pa.table({name: values for name, values in columns.items() if not np.isnan(values).all()})

    def _loaded(self, shown: Trial) -> dict[str, Floats]:
        """Return the samples of a trial from its last known file. If this file has been merged since, search for the
        trial."""
        processed = self.settings.processed
        if (found := load_trial(processed, shown.id, *self.catalogue.stored_at(shown.id))) is not None:
            return found[1].samples
        stored = read_trials(processed, shown.device, shown.experiment)
        own = stored.take(np.flatnonzero([name == shown.id for name in stored.column("trial_id").to_pylist()]))
        if not own.num_rows:
            raise Problem(404, "The trial was removed a moment ago.", found=shown.id, where="trial")
        return load_trials(processed, own.slice(0, 1))[0].samples

    def found(self, trial: str) -> Trial:
        """Return a trial as the API shows it."""
        found = self.catalogue.trial(trial)
        if found is None:
            raise Problem(404, "There is no such trial.", where="trial", found=trial)
        return found

    def _place(self, trial: str) -> tuple[str, str] | None:
        found = self.catalogue.trial(trial)
        return (found.device, found.experiment) if found else None


def run_of(*names: str) -> str:
    """Return the name of a device or experiment as one URL path segment, as in `store.corrections`."""
    return "/".join(map(folder_name, names))


def service_of(request: Request) -> Service:
    """Return the service that answers a request."""
    service: Service = request.app.state.service
    return service


def who_of(request: Request) -> str:
    """Return the name of the sender of a request."""
    who: str = request.state.who
    return who


Shared = Annotated[Service, Depends(service_of)]
Who = Annotated[str, Depends(who_of)]

"""Computations of jobs, by the functions of the command line. Results are stored under a key of their inputs."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow.compute as pc
from pydantic import Field

from pipeline.base.disk import write_text, writing
from pipeline.base.errors import DeviceError, PipelineError
from pipeline.base.json_object import JsonObject
from pipeline.base.paths import path_of_text
from pipeline.base.progress import Names, heard_by
from pipeline.comparison.against import against_experiments
from pipeline.comparison.compare import run, write_report
from pipeline.comparison.figures.responses import overlaid_figure, response_figures, trial_figure, trials_of
from pipeline.comparison.figures.trial_page import reason_of
from pipeline.comparison.plan import ComparisonSelection, ReportOptions, plan_comparison
from pipeline.comparison.scene.scene import needed_stages, open_scene
from pipeline.comparison.stage_pool import compute_stages
from pipeline.device_data.devices import declared_spring, known_devices
from pipeline.intake.ingest import ingest
from pipeline.intake.stored_sources import StoredSources
from pipeline.measured.stages.stage_needs import NEEDS
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.campaign import PlanOptions
from pipeline.planning.planner import plan
from pipeline.records.criteria import REPORTED, criterion_of
from pipeline.records.findings import Note, Record
from pipeline.records.results import ComparisonResult
from pipeline.rendering.figures.boundaries import (
    MEASURED,
    answer_figure,
    by_theory,
    limits_figure,
    limits_panel,
    measured,
    plane_figure,
)
from pipeline.rendering.figures.drawing import Figure, draw
from pipeline.rendering.labels import UNITS, significant
from pipeline.rendering.report.report_against import write
from pipeline.service.database import Database
from pipeline.service.documents import document_file, key_of, read_document, whole
from pipeline.service.profiles import profile_path
from pipeline.service.settings import Settings
from pipeline.service.theory import Theory as TheoryProcess
from pipeline.store.names import folder_name
from pipeline.store.storage import list_devices, list_experiments, trials_files
from pipeline.theory.predictions import Theory

Progress = Callable[[object], None]

Run = Callable[[Settings, Database, JsonObject, Progress], JsonObject]
"""Function that executes a job, given its request. Its return value is the result of the job."""


class UploadRequest(Record):
    """Request of a job that ingests logs, with the number of skipped files and the author.

    ``folder`` contains the new logs. ``again`` has the stored paths of logs that are read again, and ``versions`` has
    the hashes of the profiles that read these logs before.
    """

    folder: str
    profile: str
    skipped: int
    again: tuple[str, ...] = ()
    versions: dict[str, str] = Field(default_factory=dict)
    author: str = ""


class OtherExperiment(Record):
    """Second experiment of a comparison, with its notes."""

    device: str
    experiment: str
    notes: tuple[Note, ...] = ()


class DocumentRequest(Record):
    """Request of a job that makes a document.

    A comparison has a device, experiments, criteria, notes, and possibly a second experiment. A plan has a ``goal``. A
    drawing shows ``what`` for ``places`` (device, experiment, and possibly a trial) in a ``plane``. ``theory`` has the
    arguments of `theory.document`.
    """

    device: str = ""
    experiments: tuple[str, ...] = ()
    criteria: tuple[str, ...] | None = None
    notes: tuple[Note, ...] = ()
    against: OtherExperiment | None = None
    goal: Literal["boundary", "optimum"] = "boundary"
    what: str = ""
    places: tuple[tuple[str, ...], ...] = ()
    plane: str = ""
    theory: tuple[Any, ...] = ()


class Drawing(Record):
    """Panels as SVG, the plotted numbers, a title and a caption.

    A drawing of a single trial also has the ``evidence`` for its verdict and outcome, and the reason for each
    ``missing`` cost.
    """

    panels: tuple[str, ...]
    shown: tuple[JsonObject, ...]
    title: str
    caption: str
    evidence: dict[str, str] | None = None
    missing: dict[str, str] | None = None

    @property
    def document(self) -> JsonObject:
        """Drawing as JSON values."""
        return self.model_dump(mode="json", exclude_unset=True)


LONGEST_S = 3600.0
"""Longest wait for another process that writes or computes the same result [s]."""

OPTIMUM_S = 300.0
"""Time limit for the computation of an optimum [s]. With a delay of 64 samples, it takes 20 s of processor time."""


def run_upload(settings: Settings, database: Database, request: JsonObject, progress: Progress) -> JsonObject:
    """Ingest uploaded logs, and compute verdicts. Return the output of ``ingest --json`` with the uploaded names."""
    begun = time.time() - 1.0  # time stamps of files are coarse
    asked = UploadRequest.model_validate(request)
    result: JsonObject = {"found": 0, "ingested": 0, "skipped": 0, "quarantined": []}
    folder = settings.data / "logs" / (asked.folder or "none")
    places = [path for path in (folder, *map(path_of_text, asked.again)) if os.path.exists(path)]
    if places:
        report = ingest(
            places,
            settings.processed,
            profile_path(settings, asked.profile),
            rehash=bool(asked.again),
            progress=lambda done, found: progress({"done": done, "found": found}),
            wait_s=LONGEST_S,
        )
        result = _named(report.model_dump(mode="json", exclude={"plan"}), folder.parent, database)
        _note_versions(settings, database, asked)
    result["found"] += asked.skipped
    result["skipped"] += asked.skipped
    for place in _newest_first(settings.processed, begun):
        _computed(settings, place, {}, verdicts=True)
    database.add_job("stages", {}, "stages")
    return result


READ_AGAIN = "read logs again by a changed profile"
"""Words of the audit entry of an upload."""


def _note_versions(settings: Settings, database: Database, asked: UploadRequest) -> None:
    """Record in the audit the number of logs of an upload that were read before by a different version of their
    profile. This is recorded only once per job.
    """
    stored = StoredSources(settings.processed, "", {}) if asked.versions else None
    logs = Counter[tuple[str, str, str]]()
    for path, former in asked.versions.items():
        if stored is not None and (now := stored.get(path)) is not None and now.profile_sha256 != former:
            logs[now.profile, former, now.profile_sha256] += 1
    for (profile, former, present), count in sorted(logs.items()):
        what = {"profile": profile, "before": former, "now": present, "logs": count, "job": asked.folder}
        if not database.has_noted(READ_AGAIN, what):  # an interrupted job runs twice
            database.note(asked.author, READ_AGAIN, what)


def _named(value: Any, folder: Path, database: Database) -> Any:
    """Return a document with the paths below a folder replaced by the names under which they were uploaded."""
    if isinstance(value, dict):
        return {name: _named(part, folder, database) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_named(part, folder, database) for part in value]
    if not isinstance(value, str) or str(folder) not in value:
        return value
    rows = database.run("SELECT path, name FROM uploads WHERE instr(?, path) ORDER BY length(path) DESC", value)
    for row in rows:
        value = value.replace(row["path"], row["name"])
    return Path(value).name if value.startswith(str(folder)) else value


def run_stages(settings: Settings, database: Database, _request: JsonObject, progress: Progress) -> JsonObject:
    """Compute the missing verdicts and costs of all experiments. Experiments that cannot be computed are listed with
    the reason."""
    failed, computed = dict[str, str](), 0
    for place in _newest_first(settings.processed):
        progress(dict(zip(("device", "experiment"), place, strict=True)))
        computed += _computed(settings, place, failed)
        # If logs arrived, the queued job first computes their experiments, then the rest.
        if database.job_counts("kind = 'stages'").get("queued"):
            break
    return {"computed": computed, "failed": failed}


def _newest_first(processed: Path, since: float = 0.0) -> list[tuple[str, str]]:
    """Return the experiments with trials added since a time, newest first."""
    places = [(device, name) for device in list_devices(processed) for name in list_experiments(processed, device)]
    times = {of: [file.stat().st_mtime for file in trials_files(processed, *of)] for of in places}
    last = {of: max(each, default=since) for of, each in times.items()}
    return sorted((of for of in places if last[of] >= since), key=lambda of: -last[of])


def _computed(settings: Settings, place: tuple[str, str], failed: dict[str, str], verdicts: bool = False) -> bool:
    """Compute the missing stages of an experiment, or only its verdicts. Return True if any stages were missing.

    If two jobs need the stages at the same time, one job waits for the other. Verdicts are computed without waiting.
    """
    own = settings.data / "computing" / folder_name("/".join(place))
    try:
        with nullcontext() if verdicts else writing(own, LONGEST_S):
            data = open_scene(place[0], settings.processed, [place[1]], None)
            (stages,) = data.experiments
            needed = ("response", "outcome") if verdicts else sorted(needed_stages(data), key=list(NEEDS).index)
            if all(stages.is_stored(stage) for stage in needed):
                return False
            compute_stages([stages], needed)
            for stage in needed:
                stages.table(stage)
    except DeviceError:  # all of its trials are excluded, or were removed a moment ago
        return False
    except PipelineError as error:
        failed[", experiment ".join(place)] = str(error)
        return False
    return True


def experiment(settings: Settings, asked: DocumentRequest, progress: Progress) -> JsonObject:
    """Compare one experiment with theory, and return its numbers and the first figures of the report."""
    result = _compared(settings, asked, None, progress)
    found = result.model_dump(mode="json")
    causes = {each["experiment"]: each["causes"] for each in found["experiments"]}
    figures = figures_of(settings.processed, result)
    return {**found, "causes": causes, "figures": {name: each.document for name, each in figures.items()}}


def next_walls(settings: Settings, asked: DocumentRequest, _progress: Progress) -> JsonObject:
    """Return the walls that the planner proposes next."""
    found = plan(asked.device, settings.processed, asked.experiments[0], PlanOptions(goal=asked.goal))
    return found.model_dump(mode="json")


def optimum(_settings: Settings, asked: DocumentRequest, _progress: Progress) -> JsonObject:
    """Find the point with the lowest cost in theory. The computation is stopped if it takes too long, for example for a
    malicious loop."""
    found: JsonObject = TheoryProcess(OPTIMUM_S).compute(*asked.theory)
    return found


def drawing(settings: Settings, asked: DocumentRequest, progress: Progress) -> JsonObject:
    """Draw trials or experiments. Experiments are compared first if needed."""
    results = []
    for device, name in dict.fromkeys((place[0], place[1]) for place in asked.places):
        of = whole(device, name)
        key = key_of(settings, of)
        document = read_document(settings, key)
        if document is None:
            document = _keep(settings, key, experiment(settings, DocumentRequest.model_validate(of), progress))
        plain = {part: value for part, value in document.items() if part not in ("causes", "figures")}
        results.append(ComparisonResult.model_validate(plain))
    return DRAWINGS[asked.what](settings.processed, asked, results).document


def _keep(settings: Settings, key: str, document: JsonObject) -> JsonObject:
    write_text(document_file(settings, key), json.dumps(document))
    return document


def kept(make: Callable[[Settings, DocumentRequest, Progress], JsonObject]) -> Run:
    """Return the function of a job that computes a document and stores it under its key."""

    def run(settings: Settings, _database: Database, request: JsonObject, progress: Progress) -> JsonObject:
        _keep(settings, request["key"], make(settings, DocumentRequest.model_validate(request["request"]), progress))
        return {"key": request["key"]}

    return run


def run_comparison(settings: Settings, _database: Database, request: JsonObject, progress: Progress) -> JsonObject:
    """Write a report on a device or on the comparison of two experiments. Its document is written next to it."""
    key, asked = request["key"], DocumentRequest.model_validate(request["request"])
    report = document_file(settings, key, report=True).with_suffix(".html")
    if (other := asked.against) is not None:
        first, second = (asked.device, asked.experiments[0]), (other.device, other.experiment)
        with heard_by(Names(progress)):
            notes = asked.notes, other.notes
            page = against_experiments(settings.processed, first, second, asked.criteria, notes)
        write(page, report)
    else:
        _compared(settings, asked, report, progress)
    return {"key": key}


def _compared(settings: Settings, asked: DocumentRequest, report: Path | None, progress: Progress) -> ComparisonResult:
    for name in asked.experiments:
        _computed(settings, (asked.device, name), {})
    with heard_by(Names(progress)):
        what = ComparisonSelection(
            asked.device,
            settings.processed,
            experiments=asked.experiments,
            criteria=asked.criteria,
            notes=asked.notes,
        )
        finished = run(plan_comparison(what, ReportOptions(report) if report is not None else None))
        write_report(finished)
    return finished.document


def figures_of(processed: Path, result: ComparisonResult) -> dict[str, Drawing]:
    """Return the first figures of the report on an experiment, keyed by name: the limits with theory, and a
    response."""
    (found,) = result.experiments
    data = open_scene(result.device, processed, [found.experiment], None)
    theory = Theory(found.theory) if found.theory else None
    figures = {f"response{n or ''}": figure for n, figure in enumerate(response_figures(data))}
    if found.boundary:
        figures["limits"] = answer_figure(found, theory, result.motion, 0, trials_of(data.experiments[0]))
    return {name: _drawn(figure, [result]) for name, figure in figures.items()}


def _drawn(figure: Figure, results: Sequence[ComparisonResult], **of_trial: dict[str, str]) -> Drawing:
    """Return a drawn figure. The drawing is marked if the logs of any result are simulated."""
    drawn = draw(replace(figure, simulated=any(each.simulated for each in results)))
    return Drawing(panels=drawn.panels, shown=drawn.shown, title=figure.title, caption=figure.caption, **of_trial)


def limits(_processed: Path, asked: DocumentRequest, results: Sequence[ComparisonResult]) -> Drawing:
    """Draw the limits of several experiments with theory in the plane of K and B, or (`plane`) of alpha and beta."""
    runs = [(f"{r.device}, {r.experiments[0].experiment}", r.experiments[0]) for r in results]
    theories = [Theory(found.theory) if found.theory else None for _, found in runs]
    if asked.plane == "normalised":
        known = [(*run, t, n) for n, (run, t) in enumerate(zip(runs, theories, strict=True)) if t is not None]
        return _drawn(plane_figure(known), results)
    series = [s for n, (label, found) in enumerate(runs) for s in measured(found.boundary, label, n)]
    series += [by_theory(t, "_theory", n) for n, t in enumerate(theories) if t is not None]
    text = f"{MEASURED} Dashed lines in the same colour show theory."
    panel = limits_panel("", series, results[0].motion)
    return _drawn(limits_figure("Stability limits", text, [panel], "limits"), results)


def trials(processed: Path, asked: DocumentRequest, results: Sequence[ComparisonResult]) -> Drawing:
    """Draw a trial with theory and fitted loops, or several trials in one figure, each with theory."""
    of = {(result.device, result.experiments[0].experiment): result for result in results}
    figures, labels = [], []
    for device, experiment, trial in asked.places:
        result = of[device, experiment]
        spring = declared_spring(known_devices().get(device), experiment)
        stages = ExperimentStages.stored(processed, device, experiment, spring)
        figures.append(trial_figure(stages, result.experiments[0], trial, result.motion))
        row = next(iter(stages.trials.filter(pc.equal(stages.trials["trial_id"], trial)).to_pylist()), None)
        if row is None and len(asked.places) > 1:
            raise DeviceError(
                f"trial {trial} is excluded manually. Include this trial again, or omit it from the drawing."
            )
        k, b = (significant(row[name], 4) if row else "" for name in ("stiffness", "damping"))
        units = UNITS[result.motion]
        labels.append(f"K {k} {units.stiffness}, B {b} {units.damping} ({device}, {experiment})")
    if len(figures) > 1:
        return _drawn(overlaid_figure(figures, labels), results)
    return _drawn(figures[0], results, **_told_of(stages, trial))


def _told_of(stages: ExperimentStages, trial: str) -> dict[str, dict[str, str]]:
    """Return the evidence for the verdict and the outcome of a trial, and the reason for each missing cost."""
    ids = stages.texts("response", "trial_id")
    if trial not in ids:
        return {}
    row = ids.index(trial)
    evidence = {"verdict": stages.texts("response", "reason")[row], "outcome": ""}
    if stages.is_stored("outcome"):
        evidence["outcome"] = stages.texts("outcome", "evidence")[row].replace("+-", "±")
    missing = {}
    for criterion in REPORTED:
        if stages.is_stored(criterion_of(criterion).family.name) and np.isnan(stages.cost(criterion)[0][row]):
            reason = reason_of(criterion, stages.cost_reasons(criterion)[row])
            missing[criterion] = reason or "costs are defined only for stable trials"
    return {"evidence": {name: text for name, text in evidence.items() if text}, "missing": missing}


DRAWINGS: dict[str, Callable[[Path, DocumentRequest, Sequence[ComparisonResult]], Drawing]] = {
    "limits": limits,
    "trials": trials,
}
"""Function of each kind of drawing."""


KINDS: dict[str, Run] = {
    "upload": run_upload,
    "stages": run_stages,
    "experiment": kept(experiment),
    "plan": kept(next_walls),
    "optimum": kept(optimum),
    "drawing": kept(drawing),
    "comparison": run_comparison,
}
"""Function of each kind of job."""

"""What jobs compute, by the functions that the command line calls, and where it is kept: by a key of its inputs."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pipeline.base.disk import write_text
from pipeline.base.errors import DeviceError, PipelineError
from pipeline.base.file_names import path_of_text
from pipeline.base.provenance import digest
from pipeline.comparison.against_run import against_experiments
from pipeline.comparison.compare import compare, report_code
from pipeline.comparison.executors import LOCAL, executor_of
from pipeline.comparison.figures.figure_trial import trial_figure
from pipeline.comparison.scene.scene import needed_stages, open_scene
from pipeline.comparison.stage_pool import compute_stages
from pipeline.device_data.devices import declared_spring, known_devices
from pipeline.intake.ingest import ingest
from pipeline.measured.stages.stages import STAGES, ExperimentStages
from pipeline.records.findings import Note
from pipeline.records.results import ExperimentResult
from pipeline.rendering.report.report_against import write
from pipeline.service.database import Database
from pipeline.service.settings import Settings
from pipeline.store.corrections import read_corrections
from pipeline.store.storage import list_devices, list_experiments, trials_files

Progress = Callable[[object], None]


def state_of(processed: Path, device: str, experiments: Sequence[str]) -> str:
    """Return a hash of what is stored of experiments: another one after any change, exclusions by hand among them."""
    files = [file for name in experiments for file in trials_files(processed, device, name)]
    places = [(device, name) for name in experiments]
    known = read_corrections(processed).values()
    corrected = [one.model_dump() for one in known if {one.place, (one.device, one.experiment)} & {*places}]
    return digest([[[file.name, *file.stat()[6:9:2]] for file in files], corrected])


def key_of(settings: Settings, request: dict[str, Any]) -> str:
    """Return the key of an experiment's document or a comparison: a hash of request, logs, device file and code."""
    sides = [(request["device"], request["experiments"])]
    if request.get("against"):
        sides.append((request["against"]["device"], [request["against"]["experiment"]]))
    known = known_devices()
    devices = [known[name].model_dump_json() if name in known else "" for name, _ in sides]
    states = [state_of(settings.processed, *side) for side in sides]
    return digest([request, states, devices, report_code()])


def document_file(settings: Settings, key: str, report: bool = False) -> Path:
    """Return the file of a document, that of an experiment or of a report."""
    folder = settings.comparisons if report else settings.data / "documents"
    return folder / f"{key}.json"


def run_upload(settings: Settings, database: Database, request: dict[str, Any], progress: Progress) -> Any:
    """Ingest uploaded logs; the result is what ``ingest --json`` prints, with the names as uploaded."""
    skipped, result = request["skipped"], {"found": 0, "ingested": 0, "skipped": 0, "quarantined": []}
    folder = settings.data / "logs" / request["folder"]
    places = [Path(path) for path in (folder, *request.get("again", ())) if os.path.exists(path)]
    if places:
        report = ingest(
            places,
            settings.processed,
            request["profile"] or None,
            progress=lambda done, found: progress({"done": done, "found": found}),
            wait_s=3600.0,
        )
        result = _named(report.model_dump(mode="json", exclude={"plan"}), folder.parent, database)
    result["found"] += skipped
    result["skipped"] += skipped
    database.add_job("stages", {}, "stages")
    return result


def _named(value: Any, folder: Path, database: Database) -> Any:
    """Return a document with the paths below a folder replaced by the names under which they were uploaded."""
    if isinstance(value, dict):
        return {name: _named(part, folder, database) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_named(part, folder, database) for part in value]
    if isinstance(value, str) and value.startswith(str(folder)):
        rows = database.run("SELECT name FROM uploads WHERE path = ?", value)
        return rows[0]["name"] if rows else Path(value).name
    return value


def run_stages(settings: Settings, _database: Database, _request: dict[str, Any], progress: Progress) -> Any:
    """Compute verdicts and costs of all experiments that lack them; one that cannot be computed is named."""
    failed: dict[str, str] = {}
    waiting = _without_stages(settings, failed)
    if settings.executor != LOCAL:
        for needed in sorted({needed for _, needed in waiting}):
            executor_of(settings.executor)([stages for stages, own in waiting if own == needed], needed)
    computed = 0
    while waiting:
        stages, needed = waiting.pop(0)
        try:
            progress({"device": stages.device, "experiment": stages.experiment})
            compute_stages([stages], needed)
            for stage in needed:
                stages.table(stage)
            computed += 1
        except DeviceError:  # its trials were removed a moment ago
            continue
        except PipelineError as error:
            failed[f"{stages.device}, experiment {stages.experiment}"] = str(error)
    return {"computed": computed, "failed": failed}


def _without_stages(settings: Settings, failed: dict[str, str]) -> list[tuple[ExperimentStages, tuple[str, ...]]]:
    """Return the experiments that lack stages, and all that each needs; those that cannot be read go into `failed`."""
    found = []
    for device in list_devices(settings.processed):
        for experiment in list_experiments(settings.processed, device):
            try:
                data = open_scene(device, settings.processed, [experiment], None)
                needed = tuple(sorted(needed_stages(data), key=list(STAGES).index))
                (stages,) = data.experiments
                if not all(stages.is_stored(stage) for stage in needed):
                    found.append((stages, needed))
            except DeviceError:  # all of its trials are excluded, or were removed a moment ago
                continue
            except PipelineError as error:
                failed[f"{device}, experiment {experiment}"] = str(error)
    return found


def run_experiment(settings: Settings, _database: Database, request: dict[str, Any], progress: Progress) -> Any:
    """Compare one experiment with theory, for its numbers alone."""
    document = _compared(settings, request, None, progress)
    write_text(document_file(settings, request["key"]), json.dumps(document))
    return {"key": request["key"]}


def run_trial(settings: Settings, database: Database, request: dict[str, Any], progress: Progress) -> Any:
    """Draw a trial beside theory and the fitted loop of its experiment, which is compared first where it was not."""
    key, asked = request["key"], request["request"]
    whole = {name: value for name, value in asked.items() if name != "trial"}
    whole_key = key_of(settings, whole)
    file = document_file(settings, whole_key)
    if not file.is_file():
        run_experiment(settings, database, {"key": whole_key, "request": whole}, progress)
    document = json.loads(file.read_bytes())
    device, (experiment,) = asked["device"], asked["experiments"]
    found = ExperimentResult.model_validate(document["experiments"][0])
    spring = declared_spring(known_devices().get(device), experiment)
    stages = ExperimentStages.stored(settings.processed, device, experiment, spring)
    figure = trial_figure(stages, found, asked["trial"], document["motion"])
    # matplotlib takes half a second, which jobs that draw nothing need not wait for
    from pipeline.rendering.figures.trial_drawing import courses

    panels = courses(figure, document["motion"])
    write_text(document_file(settings, key), json.dumps({"panels": panels, "caption": figure.caption}))
    return {"key": key}


def run_comparison(settings: Settings, _database: Database, request: dict[str, Any], progress: Progress) -> Any:
    """Make a report, of a device or of two experiments against each other, with its document beside it."""
    key, asked = request["key"], request["request"]
    report = document_file(settings, key, report=True).with_suffix(".html")
    against = asked.get("against")
    if against:
        first, second = (asked["device"], asked["experiments"][0]), (against["device"], against["experiment"])
        said = _notes(asked), _notes(against)
        write(against_experiments(settings.processed, first, second, asked["criteria"], progress, said), report)
    else:
        _compared(settings, request, report, progress)
    return {"key": key}


def _notes(asked: dict[str, Any]) -> list[Note]:
    return [Note.model_validate(one) for one in asked.get("notes", ())]


def _compared(settings: Settings, request: dict[str, Any], report: Path | None, progress: Progress) -> Any:
    asked = request["request"]
    result = compare(
        asked["device"],
        settings.processed,
        experiments=asked["experiments"],
        criteria=asked["criteria"],
        report=report,
        notes=_notes(asked),
        progress=progress,
        executor=executor_of(settings.executor),
    ).result
    assert result is not None, "only a dry run has none"
    document = result.model_dump(mode="json")
    return {**document, "causes": {each["experiment"]: each["causes"] for each in document["experiments"]}}


KINDS = {
    "upload": run_upload,
    "stages": run_stages,
    "experiment": run_experiment,
    "trial": run_trial,
    "comparison": run_comparison,
}
"""Function of each kind of job."""


def uploaded_name(database: Database, source: str) -> str:
    """Return the name under which a source was uploaded, or its path."""
    rows = database.run("SELECT name FROM uploads WHERE path = ?", source)
    return rows[0]["name"] if rows else str(path_of_text(source))

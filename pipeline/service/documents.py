"""Files with the results of jobs, named by a key of their inputs. The module imports little, because it is all that the
server needs of the code of jobs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pipeline.base.json_object import JsonObject
from pipeline.base.provenance import code_digest, digest, sha256
from pipeline.device_data.devices import known_devices
from pipeline.device_data.published import published_files
from pipeline.service.settings import Settings
from pipeline.store.storage import read_corrections, trials_files


def state_of(processed: Path, device: str, experiments: Sequence[str]) -> str:
    """Return a hash of the stored data of experiments.

    Any change of the data, including a manual exclusion, changes the hash.
    """
    files = [file for name in experiments for file in trials_files(processed, device, name)]
    places = [(device, name) for name in experiments]
    known = read_corrections(processed).values()
    corrected = [one.model_dump() for one in known if {one.place, (one.device, one.experiment)} & {*places}]
    return digest([[[file.name, *file.stat()[6:9:2]] for file in files], corrected])


def key_of(settings: Settings, request: JsonObject) -> str:
    """Return the key of a document. The key is a hash of the request, the logs, the device files and the code."""
    sides = [(place[0], [place[1]]) for place in request.get("places", ())]
    if "device" in request:
        sides.append((request["device"], request["experiments"]))
    if request.get("against"):
        sides.append((request["against"]["device"], [request["against"]["experiment"]]))
    known = known_devices()
    devices = [known[name].model_dump_json() if name in known else "" for name, _ in sides]
    states = [state_of(settings.processed, *side) for side in sides]
    code = [code_digest("report"), *(sha256(file.read_bytes()) for file in published_files())]
    return digest([request, states, devices, code])


def whole(device: str, experiment: str) -> JsonObject:
    """Return the request for all results of an experiment."""
    return {"device": device, "experiments": [experiment], "criteria": None}


def document_file(settings: Settings, key: str, report: bool = False) -> Path:
    """Return the file of the document of an experiment or a report."""
    folder = settings.comparisons if report else settings.data / "documents"
    return folder / f"{key}.json"


def read_document(settings: Settings, key: str) -> JsonObject | None:
    """Return the stored document of an experiment, a plan or a drawing."""
    try:
        document: JsonObject = json.loads(document_file(settings, key).read_bytes())
    except FileNotFoundError:
        return None
    return document

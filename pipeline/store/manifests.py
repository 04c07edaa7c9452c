"""Manifests of an object store: which objects are the files of an experiment at this moment.

    manifests/<device>/<experiment>.json     files of an experiment: path in `processed/` and the object that holds it
    manifests/store.json                     those of no experiment: exclusions, quarantine, optima of theory
    objects/<device>/<experiment>/<sha256>-<random>    the files, as they are in a folder; never changed, never reused

A batch, its samples with its trials, becomes visible by one manifest that is put in the place of the one it was made
from (`Objects.advance`), so that no reader sees a half of it, and of two writers the second one notices.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from pipeline.base.errors import PipelineError, StoreError
from pipeline.base.json_seal import sealed_json, unsealed_json
from pipeline.base.provenance import digest
from pipeline.store.names import name_of_folder
from pipeline.store.objects import Objects

STORE = "store"
"""Name of the manifest of all files that belong to no experiment."""

FORMAT = 1

_FOLDER = "manifests/"

_DERIVED = ("stages/", "theory/")
"""Files that follow from others and say by a key from which: of two versions either may be kept."""

ADVANCES = 30
"""Times that derived files are published anew because the manifest moved on; an ingest moves it once in 64 MiB."""

Files = Mapping[str, str]
"""Path of each file below `processed/`, and the name of its object."""


class ConflictError(PipelineError):
    """Another command was faster; what this one did rests on what is there no more, and has to be done anew."""


@dataclass(frozen=True)
class Manifest:
    """The files of an experiment, or of the store, as of one moment; without an ETag there is none yet."""

    name: str
    files: Files = field(default_factory=dict)
    etag: str | None = None


def manifest_of(path: str) -> str:
    """Return the name of the manifest of a file.

    Examples
    --------
    >>> manifest_of("trials/lwr/1/000001-ab.parquet"), manifest_of("exclusions.parquet")
    ('lwr/1', 'store')
    """
    tree, *place = path.split("/")
    return "/".join(place[:2]) if tree in ("trials", "samples", "stages") and len(place) == 3 else STORE


def device_of(name: str) -> str | None:
    """Return the device of a manifest's experiment, None for that of the store."""
    folder, slash, _ = name.partition("/")
    return name_of_folder(folder) if slash else None


def object_folder(name: str) -> str:
    """Return the folder of the objects of a manifest."""
    return "objects/" if name == STORE else f"objects/{name}/"


def list_manifests(objects: Objects) -> list[str]:
    """Return the names of all manifests of experiments."""
    names = (path.removeprefix(_FOLDER).removesuffix(".json") for path, _, _ in objects.list(_FOLDER))
    return [name for name in names if "/" in name]


def read_manifest(objects: Objects, name: str) -> Manifest:
    """Return a manifest, one without files where there is none.

    Raises
    ------
    StoreError
        If it is damaged, or of a later version.
    """
    found = objects.get(f"{_FOLDER}{name}.json")
    if found is None:
        return Manifest(name)
    content, etag = found
    try:
        document = unsealed_json(content)
        if document["format"] != FORMAT:
            raise StoreError(
                f"{objects.url}/{_FOLDER}{name}.json: has format {document['format']!r}, this version reads {FORMAT}. "
                "Install the version that wrote it."
            )
        files = {str(path): str(held) for path, held in document["files"].items()}
        if strange := [path for path in files if manifest_of(path) != name or _leads_outside(path)]:
            raise ValueError(f"it names {strange[0]!r}")
        return Manifest(name, files, etag)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(
            f"{objects.url}/{_FOLDER}{name}.json: is damaged ({error}). Restore it by a backup."
        ) from error


def advance(objects: Objects, base: Manifest, files: Files) -> Manifest:
    """Put files in the place of those of a manifest; return the manifest that is there then.

    Where it moved on meanwhile, derived files are put into the present one. Whatever else changed rests on trials that
    may be others now.

    Raises
    ------
    ConflictError
        If trials or other files that are not derived changed, and those of the present manifest are not as in `base`.
    """
    changed = {path: files.get(path) for path in {*base.files, *files} if base.files.get(path) != files.get(path)}
    own = any(not path.startswith(_DERIVED) for path in changed)
    present = base
    for _ in range(ADVANCES):
        merged = {path: name for path, name in {**present.files, **changed}.items() if name is not None}
        text = json.dumps({"format": FORMAT, "files": dict(sorted(merged.items()))}, indent=0)
        etag = objects.advance(f"{_FOLDER}{base.name}.json", sealed_json(text + "\n").encode(), present.etag)
        if etag is not None:
            return Manifest(base.name, merged, etag)
        present = read_manifest(objects, base.name)
        if own and _authoritative(present.files) != _authoritative(base.files):
            raise ConflictError(f"{objects.url}: another command stored into {base.name} at the same time.")
    raise StoreError(
        f"{objects.url}: the manifest of {base.name} was changed by others {ADVANCES} times in a row. "
        "Repeat the command."
    )


def _leads_outside(path: str) -> bool:
    """Return whether a path, which others wrote, is none of a file below the folder."""
    parts = path.split("/")
    return "\\" in path or ":" in parts[0] or any(part in ("", ".", "..") for part in parts)


def _authoritative(files: Files) -> str:
    return digest(sorted(pair for pair in files.items() if not pair[0].startswith(_DERIVED)))

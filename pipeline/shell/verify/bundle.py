"""`pipeline bundle`: a report with all that `verify` needs in one zip, and its verification anywhere.

A bundle holds the page, its JSON document, ``logs/PROFILE/EXPERIMENT/`` with the logs as they were recorded,
``profiles/`` with what reads them, and ``devices/`` with the device file where there is one. Equal inputs give equal
bytes.
"""

from __future__ import annotations

import os
import tempfile
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipeline.base.disk import replacing
from pipeline.base.errors import DeviceError, LogError, StoreError, UsageError
from pipeline.base.paths import path_of_text
from pipeline.base.provenance import USER_FOLDER_VARIABLE, schema_folder
from pipeline.base.wording import counted
from pipeline.comparison.truths import TRUTH_FILE
from pipeline.device_data.devices import device_file
from pipeline.intake.sources import METADATA, find_sources, load_source
from pipeline.profiles.profile_files import load_profile, read_profile
from pipeline.records.findings import Record
from pipeline.records.results import ComparisonResult
from pipeline.shell.verify.verify import (
    Request,
    Verification,
    read_document,
    read_report,
    stored_place,
    verify,
)
from pipeline.store.names import folder_name
from pipeline.store.storage import read_trials

ENDING = ".zip"
TIME = (1980, 1, 1, 0, 0, 0)
"""Time of every entry, so that equal inputs give equal bytes: the earliest that a zip can hold."""

READ_ME = """{report} is a report by `pipeline compare` (haptic-pipeline); all that it was computed from lies beside it.
To compute every number anew and compare it with the report, wherever this file lies:

    pipeline verify {bundle}
"""


class Bundle(Record):
    """What a bundle holds: its file, how many logs, and how many files and bytes in all."""

    bundle: str
    logs: int
    files: int
    bytes: int


def bundle(report: Path, profiles: Sequence[Path] = ()) -> Bundle:
    """Write a report and all that it rests on into one zip beside it.

    Parameters
    ----------
    report : Path
        HTML page by `compare`, with its JSON document beside it.
    profiles : sequence of Path
        Profile files of the lab that read the logs; shipped ones are known.

    Raises
    ------
    UsageError
        If the file is no report, has no document beside it, or a profile is not given.
    DeviceError
        If the device file behind the report is not known here.
    StoreError
        If a log is gone or has changed since the report was made.
    """
    target = report.with_suffix(ENDING)
    _, _, request = read_report(report)
    document, notes = read_document(report)
    if document is None:
        raise UsageError(f"{notes[0]}. A bundle holds it, too: write the report anew, or lay its document beside it.")
    count, logs = _logs(Path(stored_place(report, request.processed, None)), request, document, profiles)
    files = {report.name: report, f"{report.stem}.json": report.with_suffix(".json"), **logs}
    if request.device_file:
        files[f"devices/{folder_name(request.scene.device)}.toml"] = _device_file(request)
    size = 0
    with replacing(target) as stream, zipfile.ZipFile(stream, "w") as archive:
        readme = READ_ME.format(report=report.name, bundle=target.name)
        archive.writestr(_entry("README.txt"), readme, zipfile.ZIP_DEFLATED)
        for name, path in sorted(files.items()):
            content = path.read_bytes()
            size += len(content)
            archive.writestr(_entry(name), content, zipfile.ZIP_DEFLATED)
    return Bundle(bundle=str(target), logs=count, files=len(files), bytes=size)


def verify_bundle(path: Path, progress: Callable[[str], None] | None = None) -> Verification:
    """Verify the report of a bundle by nothing but what the bundle holds; nothing is left behind.

    Raises
    ------
    UsageError
        If the file is no bundle.
    """
    with tempfile.TemporaryDirectory(prefix="pipeline-bundle-") as temporary:
        folder = Path(temporary)
        try:
            with zipfile.ZipFile(path) as archive:
                archive.extractall(folder)  # takes ".." and the like out of names
        except (OSError, zipfile.BadZipFile) as error:
            why = getattr(error, "strerror", None) or error
            raise UsageError(f"{path}: is no zip that can be read ({why}). Give one by `pipeline bundle`.") from error
        pages = sorted(folder.glob("*.html"))
        if len(pages) != 1:
            raise UsageError(
                f"{path}: expected one report (.html) at the top of a bundle, found {len(pages)}. Make it with "
                "`pipeline bundle REPORT`."
            )
        profiles = sorted((folder / "profiles").glob("*.toml"))
        places = {profile: folder / "logs" / folder_name(read_profile(profile).name) for profile in profiles}
        with _devices_of(folder / "devices"):
            found = verify(pages[0], profiles=profiles, logs=list(places.items()), progress=progress)
    return found.model_copy(update={"report": str(path)})


def _logs(
    processed: Path, request: Request, document: ComparisonResult, profiles: Sequence[Path]
) -> tuple[int, dict[str, Path]]:
    """Return how many logs are behind a report, excluded ones too, and their files and profiles by name in a bundle."""
    given = {load_profile(path).name: path for path in profiles}
    wanted = {sha for logs in document.logs for sha in logs.files.values()}
    wanted |= {one.source_sha256 for one in request.excluded}
    columns = ["profile", "experiment", "source_path", "source_sha256"]
    trials = read_trials(processed, request.scene.device, columns=columns)
    rows = set(zip(*(trials.column(name).to_pylist() for name in columns), strict=True))
    groups: dict[tuple[str, str], dict[str, str]] = defaultdict(dict)
    for profile, experiment, path, sha in sorted(row for row in rows if row[3] in wanted):
        groups[profile, experiment][path] = sha
    missing = len(wanted - {sha for group in groups.values() for sha in group.values()})
    if missing:
        raise StoreError(
            f"{processed}: {counted(missing, 'log')} of the report {'is' if missing == 1 else 'are'} not stored there "
            "as when it was made. Ingest them again, or write the report anew."
        )
    files: dict[str, Path] = {}
    for (profile, experiment), sources in groups.items():
        file = given.get(profile) or _shipped_profile(profile)
        files[f"profiles/{folder_name(profile)}.toml"] = file
        top = path_of_text(os.path.commonpath([os.path.dirname(path) for path in sources]))
        place = f"logs/{folder_name(profile)}/{folder_name(experiment)}"
        for path in _files(sources, file):
            files[f"{place}/{os.path.relpath(path, top).replace(os.sep, '/')}"] = path
    return len({path for group in groups.values() for path in group}), files


def _files(sources: Mapping[str, str], profile: Path) -> Iterator[Path]:
    """Yield every file of some logs, and what lies beside them that the pipeline reads."""
    paths = [path_of_text(path) for path in sources]
    gone = [path for path in paths if not path.exists()]
    if gone:
        raise StoreError(
            f"{gone[0]}: is no longer where it was ({counted(len(gone), 'log')} of the report in all). A bundle holds "
            "the logs themselves: lay them there again, or ingest them where they are now."
        )
    beside = set()
    for source in find_sources(paths, (load_profile(profile),)):
        expected = sources.get(source.key)
        try:
            sha256 = load_source(source)[1]
        except LogError as error:
            raise StoreError(f"{source.shown}: {error}") from error
        if expected not in (None, sha256):
            raise StoreError(
                f"{source.shown}: has changed since the report was made; expected SHA-256 {expected}, found {sha256}. "
                "Lay the former file there, or ingest it and write the report anew."
            )
        yield from source.files
        beside |= {file.parent / name for file in source.files for name in (TRUTH_FILE, METADATA)}
    yield from (path for path in sorted(beside) if path.is_file())


def _shipped_profile(name: str) -> Path:
    for path in sorted((schema_folder() / "profiles").glob("*.toml")):
        if read_profile(path).name == name:
            return path
    raise UsageError(f"profile {name!r}, which read logs of the report, is not shipped. Give its file with --profile.")


def _device_file(request: Request) -> Path:
    file = device_file(request.scene.device)
    if file is None:
        raise DeviceError(
            f"device {request.scene.device!r}: the report rests on its device file, which is not known here. Name its "
            f"folder in {USER_FOLDER_VARIABLE}."
        )
    return file


@contextmanager
def _devices_of(folder: Path) -> Iterator[None]:
    """Take device files from a folder for the time of a block; processes begun in it do, too."""
    before = os.environ.get(USER_FOLDER_VARIABLE)
    os.environ[USER_FOLDER_VARIABLE] = str(folder)
    try:
        yield
    finally:
        os.environ.pop(USER_FOLDER_VARIABLE)
        if before is not None:
            os.environ[USER_FOLDER_VARIABLE] = before


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, TIME)
    entry.external_attr = 0o644 << 16
    return entry

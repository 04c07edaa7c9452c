"""Functions for `pipeline bundle`, which packs a report with all inputs of `verify` into a zip, and verifies it.

A bundle contains the page, its JSON document, ``processed/`` with the stored trials, and ``devices/`` with the device
file if there is one. Equal inputs give identical bytes.
"""

from __future__ import annotations

import os
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.base.disk import replacing
from pipeline.base.errors import DeviceError, StoreError, UsageError
from pipeline.base.provenance import USER_FOLDER_VARIABLE
from pipeline.device_data.devices import device_file
from pipeline.records.findings import Record
from pipeline.shell.fresh_logs import read_again
from pipeline.shell.verify import Request, Verification, read_document, read_report, stored_place, verify
from pipeline.store.names import folder_name
from pipeline.store.objects import opened

ENDING = ".zip"
TIME = (1980, 1, 1, 0, 0, 0)
"""Time stamp of every entry: the earliest that a zip allows. It is fixed, so that equal inputs give identical bytes."""

READ_ME = """{report} is a report by `pipeline compare` (haptic-pipeline). This file also contains its input data.
The following command recomputes every number and compares it with the report:

    pipeline verify {bundle}
"""


class Bundle(Record):
    """File of a bundle, and the number of trials, files and bytes in it."""

    bundle: str
    trials: int
    files: int
    bytes: int


def bundle(report: Path) -> Bundle:
    """Write a report and all its inputs into a zip in the folder of the report.

    Parameters
    ----------
    report : Path
        HTML page that `compare` wrote, with its JSON document in the same folder.

    Raises
    ------
    UsageError
        If the file is not a report, or its document is missing.
    DeviceError
        If the device file of the report is not available on this machine.
    StoreError
        If the stored trials have changed since the report was written.
    """
    target = report.with_suffix(ENDING)
    _, _, request = read_report(report)
    document, notes = read_document(report)
    if document is None:
        raise UsageError(
            f"{notes[0]}. A bundle needs this document. Write the report again, or add its document to its folder."
        )
    device, lists = request.scene.device, {logs.experiment: logs for logs in document.logs}
    files = {report.name: report, f"{report.stem}.json": report.with_suffix(".json")}
    if request.device_file:
        files[f"devices/{folder_name(device)}.toml"] = _device_file(request)
    place = stored_place(report, request.processed, None)
    with tempfile.TemporaryDirectory(prefix="pipeline-bundle-") as temporary, opened(place, device) as processed:
        store = Path(temporary) / "processed"
        fresh = read_again(device, processed, request.logs, lists, store, None, request.excluded)
        for problem in fresh.problems:
            raise StoreError(f"{problem.path}: {problem.problem}. Ingest its log again, or write the report again.")
        # The page lists the exclusions. Corrections would add the current time.
        kept = (*(store / "trials").rglob("*.parquet"), *store.glob("*.json"))
        files |= {path.relative_to(temporary).as_posix(): path for path in kept}
        size = sum(path.stat().st_size for path in files.values())
        with replacing(target) as stream, zipfile.ZipFile(stream, "w") as archive:
            readme = READ_ME.format(report=report.name, bundle=target.name)
            archive.writestr(_entry("README.txt"), readme, zipfile.ZIP_DEFLATED)
            for name, path in sorted(files.items()):
                archive.writestr(_entry(name), path.read_bytes(), zipfile.ZIP_DEFLATED)
    return Bundle(bundle=str(target), trials=fresh.kept, files=len(files), bytes=size)


def verify_bundle(path: Path) -> Verification:
    """Verify the report of a bundle in a temporary folder, using only the contents of the bundle.

    Raises
    ------
    UsageError
        If the file is not a bundle.
    """
    with tempfile.TemporaryDirectory(prefix="pipeline-bundle-") as temporary:
        folder = Path(temporary)
        try:
            with zipfile.ZipFile(path) as archive:
                archive.extractall(folder)  # this removes ".." and similar parts from names
        except (OSError, zipfile.BadZipFile) as error:
            why = getattr(error, "strerror", None) or error
            raise UsageError(f"{path}: cannot be read as a zip ({why}). Give a file by `pipeline bundle`.") from error
        pages = sorted(folder.glob("*.html"))
        if len(pages) != 1:
            raise UsageError(
                f"{path}: expected one report (.html) at the top of a bundle, found {len(pages)}. Write a bundle with "
                "`pipeline bundle REPORT`."
            )
        with _devices_of(folder / "devices"):
            return verify(pages[0], folder / "processed", None, path)


def _device_file(request: Request) -> Path:
    file = device_file(request.scene.device)
    if file is None:
        raise DeviceError(
            f"device {request.scene.device!r}: the report uses its device file, which was not found. Set "
            f"{USER_FOLDER_VARIABLE} to the folder of this file."
        )
    return file


@contextmanager
def _devices_of(folder: Path) -> Iterator[None]:
    """Use the device files of a folder inside the block, also in processes that the block starts."""
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

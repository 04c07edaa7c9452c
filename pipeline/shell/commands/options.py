"""Options that several commands share, each declared once. A list is an option given several times, or commas."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from pipeline.records.models import Device


def _folder(text: str) -> Path:
    from pipeline.store.objects import is_url

    if is_url(text):
        raise typer.BadParameter(f"{text}: this command takes a folder; docs/storage.md names those that take a URL.")
    return Path(text)


def _split(given: list[str] | None) -> list[str] | None:
    """Return the words of a list; one with a comma stands in double quotes."""
    return [word for row in csv.reader(given, skipinitialspace=True) for word in row or ("",)] if given else None


def listed(name: str, help_text: str, *more: str, **how: Any) -> Any:
    """Return an option that is a list of words."""
    return typer.Option(name, *more, callback=_split, help=f"{help_text} Repeat or use commas.", **how)


PROCESSED, REPORTS = "PIPELINE_PROCESSED", "PIPELINE_REPORTS"
"""Variables that stand for the folders of stored tables and of reports, where an option does not."""

Processed = Annotated[
    Path, typer.Option("--processed", envvar=PROCESSED, parser=_folder, help="Folder of the stored tables.")
]
Store = Annotated[str, typer.Option("--processed", envvar=PROCESSED, help="Stored tables: folder or s3://BUCKET/KEY.")]
Reports = Annotated[Path, typer.Option("--reports", envvar=REPORTS, help="Folder of the reports.")]
ExecutorName = Annotated[str, typer.Option("--executor", help="Where to compute: local, or dask://HOST:PORT.")]
ProfileFile = Annotated[str | None, typer.Option("--profile", help="Log profile: name or file (.toml).")]
DeviceName = Annotated[str, typer.Option("--device", help="Device: name or file (.toml).")]
One = Annotated[str | None, typer.Option("--experiment", "-e", help="Experiment (default: the first).")]
Experiments = Annotated[list[str] | None, listed("--experiment", "Experiments (default: all).", "-e")]
Criteria = Annotated[list[str] | None, listed("--criteria", "Criteria (default: standard set).")]
Out = Annotated[Path | None, typer.Option("--out", help="File to write.", show_default=False)]


def device_of(text: str) -> Device:
    """Return a device by its name or file."""
    from pipeline.device_data.devices import load_device, read_device

    return read_device(Path(text)) if text.endswith(".toml") else load_device(text)


def reports_folder() -> Path:
    """Return the folder of reports of a command without `Reports`."""
    return Path(os.environ.get(REPORTS, "reports"))

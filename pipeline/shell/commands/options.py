"""Options that several commands share, each declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def _folder(text: str) -> Path:
    from pipeline.store.objects import is_url

    if is_url(text):
        raise typer.BadParameter(f"{text}: this command takes a folder; docs/storage.md names those that take a URL.")
    return Path(text)


Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout, nothing else there.")]
JsonLines = Annotated[bool, typer.Option("--json", help="Print each line as a JSON document.")]
PROCESSED, REPORTS = "PIPELINE_PROCESSED", "PIPELINE_REPORTS"
"""Variables that stand for the folders of stored tables and of reports, where an option does not."""

Processed = Annotated[
    Path, typer.Option("--processed", envvar=PROCESSED, parser=_folder, help="Folder of the stored tables.")
]
Store = Annotated[
    str, typer.Option("--processed", envvar=PROCESSED, help="Folder of the stored tables, or s3://BUCKET/PREFIX.")
]
Reports = Annotated[Path, typer.Option("--reports", envvar=REPORTS, help="Folder of the reports.")]
ExecutorName = Annotated[
    str, typer.Option("--executor", help="What computes experiments: local, or dask://HOST:PORT of a scheduler.")
]
ProfileFile = Annotated[str | None, typer.Option("--profile", help="Log profile by name, or a profile file (.toml).")]
Criteria = Annotated[
    str | None,
    typer.Option("--criteria", help="Separated by commas; a wrong one lists all. The usual ones where not given."),
]
Experiments = Annotated[
    list[str] | None,
    typer.Option("--experiment", "-e", help="Only this experiment; may be given several times."),
]

"""Files that are asked for: refused before the work begins, not after minutes of it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from pipeline.base.errors import PipelineError, UsageError


def check_output(path: Path, option: str, *, document_beside: bool = False) -> None:
    """See that a file can be written where an option says. Nothing is created.

    Parameters
    ----------
    path : Path
        File that the command will write; folders above it may be missing.
    option : str
        Name of the option, for the message; empty where a command has none.
    document_beside : bool
        Whether a JSON document of the same name is written beside it, which would replace a file that ends in .json.

    Raises
    ------
    UsageError
        If it is a folder, or ends in .json where the document beside it does.
    PipelineError
        If its folder takes no files.
    """
    place = f"{option} {path}".strip()
    if path.is_dir():
        raise UsageError(f"{place}: is a folder; expected a file. Add a file name, such as {path / 'report.html'}.")
    if document_beside and path.suffix.lower() == ".json":
        raise UsageError(
            f"{place}: expected the name of the page, found that of the JSON document, which is written "
            f"beside it and would replace it. Give {path.with_suffix('.html')}."
        )
    # the folder above a missing one decides; a missing current folder is told by the error below
    folder = next((above for above in path.parents if above.exists()), Path("."))
    try:
        with tempfile.TemporaryFile(dir=folder):  # a file without a name: a folder's permissions alone do not tell
            pass
    except OSError as error:
        raise PipelineError(
            f"{place}: cannot be written, since {folder} takes no files ({error.strerror or error}). Choose "
            "another place, or correct the permissions."
        ) from error

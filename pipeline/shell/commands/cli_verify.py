"""Commands that hold a report against its logs, here or anywhere: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.base.errors import EXIT_ERROR, UsageError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import Json

Stored = Annotated[
    Path | None,
    typer.Option("--processed", help="Folder of the stored tables; the one that the report names where not given."),
]
Profiles = Annotated[
    list[Path] | None,
    typer.Option("--profile", help="Profile file (.toml) that read the logs; may be given several times."),
]


def verify(
    report: Annotated[Path, typer.Argument(help="Report (HTML) by `pipeline compare`, or bundle (.zip).")],
    processed: Annotated[
        str | None,
        typer.Option("--processed", help="Folder or URL of the stored tables; as the report names it if not given."),
    ] = None,
    profile: Profiles = None,
    logs: Annotated[
        Path | None,
        typer.Option("--logs", help="Folder with the logs, wherever they were; nothing stored is needed then."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Recompute the numbers of a report, and name those that differ.

    Reads the logs from where they lay (their stored samples where they are gone), from --logs, or from a bundle,
    computes everything in a temporary folder, and compares each cell and value. What no log
    determines, such as run times, is held against hashes in the page. Exit status 1 where something differs.

    Example: pipeline verify reports/falcon.html
    """
    from pipeline.shell.verify.bundle import ENDING, verify_bundle
    from pipeline.shell.verify.verify import lines_of
    from pipeline.shell.verify.verify import verify as verify_report

    progress = None if as_json else console.note
    if report.suffix.lower() == ENDING:
        if processed or profile or logs:
            raise UsageError(f"{report}: a bundle holds all that is needed. Leave the options out.")
        found = verify_bundle(report, progress)
    else:
        if processed and logs:
            raise UsageError("--processed and --logs do not go together: give the stored tables, or the logs.")
        # a lab's own profiles first: what they do not claim the shipped ones may
        places = [(path, logs) for path in (*(profile or ()), None)] if logs else []
        found = verify_report(report, processed, profile or (), places, progress)
    if as_json:
        console.print_json(found.model_dump(mode="json"))
    else:
        for line in lines_of(found):
            console.say(line)
    if not found.equal:
        raise typer.Exit(EXIT_ERROR)


def bundle(
    report: Annotated[Path, typer.Argument(help="Report (HTML) by `pipeline compare`.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="File to write; beside the report where not given.", show_default=False)
    ] = None,
    processed: Stored = None,
    profile: Profiles = None,
    as_json: Json = False,
) -> None:
    """Pack a report and all that `pipeline verify` needs into one zip.

    Example: pipeline bundle reports/falcon.html
    """
    from pipeline.shell.verify.bundle import bundle as write

    if out is not None:
        check_output(out, "--out")
    written = write(report, out, processed, profile or ())
    if as_json:
        console.print_json(written.model_dump(mode="json"))
        return
    console.say(f"bundle: {written.bundle}, {written.logs} logs in {written.files} files")

"""Commands of the service: parse, call, print."""

from __future__ import annotations

import os
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from pipeline.base.errors import EXIT_ERROR, EXIT_QUARANTINED, UsageError
from pipeline.shell import console
from pipeline.shell.commands.options import ExecutorName, Json, Processed, Reports

TOKEN_VARIABLE = "PIPELINE_TOKEN"


class RoleName(StrEnum):
    """What the holder of a token may do."""

    viewer = "viewer"
    contributor = "contributor"
    admin = "admin"


def serve(
    processed: Processed = Path("processed"),
    reports: Reports = Path("reports"),
    host: Annotated[str, typer.Option("--host", help="Address to listen at; other computers need a token.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port to listen at.")] = 8000,
    read_only: Annotated[bool, typer.Option("--read-only", help="Refuse every change.")] = False,
    executor: ExecutorName = "local",
) -> None:
    """Serve the lab in the browser and by REST, until Ctrl-C.

    Limits are set by variables: PIPELINE_MAX_FILE and PIPELINE_MAX_REQUEST (MiB, 64 and 1024), PIPELINE_RATE (requests
    a minute of a token or address; 0: any), PIPELINE_RENEW (0: reports are not made anew when logs come).

    Example: pipeline serve --processed processed
    """
    _check_installed()
    from pipeline.comparison.executors import executor_of
    from pipeline.service.app import serve as run
    from pipeline.service.settings import Settings, limits

    executor_of(executor)  # one that cannot be used is refused at once
    settings = Settings(
        processed=processed,
        reports=reports,
        host=host,
        port=port,
        read_only=read_only,
        executor=executor,
        **limits(os.environ),
    )
    run(settings, lambda place: console.note(f"{place} (Ctrl-C ends it)"))


class Deed(StrEnum):
    """What is done with tokens."""

    create = "create"
    list = "list"
    revoke = "revoke"


def token(
    deed: Annotated[Deed, typer.Argument(help="What to do.", metavar="create|list|revoke")],
    identifier: Annotated[str | None, typer.Argument(help="Token to revoke, as the list shows it.")] = None,
    role: Annotated[
        RoleName | None,
        typer.Option("--role", help="viewer reads, contributor uploads, compares and corrects, admin deletes, too."),
    ] = None,
    name: Annotated[str, typer.Option("--name", help="Whose it is: stands beside all that he does.")] = "",
    days: Annotated[float | None, typer.Option("--days", min=0, help="Days after which it ends.")] = None,
    processed: Processed = Path("processed"),
    as_json: Json = False,
) -> None:
    """Create, list or revoke tokens for other computers.

    A new token is printed once: only its hash is stored.

    Example: pipeline token create --role contributor --name "lab computer"

    Example: pipeline token list

    Example: pipeline token revoke 0123456789ab
    """
    if (deed is Deed.create) != (role is not None) or (deed is Deed.revoke) != (identifier is not None):
        raise UsageError("expected create --role ROLE, list, or revoke ID.")
    database = _database(processed)
    if role is not None:
        console.say(database.create_token(role.value, name, days))
    elif identifier is not None:
        rows = database.run("DELETE FROM tokens WHERE substr(hash, 1, 12) = ? RETURNING hash", identifier)
        if not rows:
            raise UsageError(f"no token {identifier!r}. `pipeline token list` shows all.")
    else:
        rows = database.run(
            "SELECT substr(hash, 1, 12) AS id, role, name, date(expires, 'unixepoch') AS ends "
            "FROM tokens ORDER BY created"
        )
        tokens = [dict(row) for row in rows]
        if as_json:
            console.print_json(tokens)
            return
        for line in console.table(tokens, ("id", "role", "name", "ends")):
            console.say(line)


def push(
    folder: Annotated[Path, typer.Argument(help="Folder with logs (searched below, too), or one log.")],
    to: Annotated[str, typer.Option("--to", help="Address of the server, such as http://127.0.0.1:8000.")],
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Log profile by name, or a profile file (.toml), which the server keeps."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Upload logs to a server; run again to resume.

    A token is taken from the variable PIPELINE_TOKEN. Exit status 3 where a log was refused.

    Example: pipeline push raw --to http://127.0.0.1:8000
    """
    from pipeline.service.push import push as push_logs

    with console.progress("push", "logs", as_json) as advance:
        report = push_logs(folder, to, profile, os.environ.get(TOKEN_VARIABLE), advance)
    if as_json:
        console.print_json(report)
    else:
        counts = {key: report[key] for key in ("found", "ingested", "skipped")}
        counts["quarantined"] = len(report["quarantined"])
        for line in console.table([counts], tuple(counts)):
            console.say(line)
        for refusal in report["quarantined"]:
            row = "" if refusal["row"] is None else f", row {refusal['row']}"
            console.say(f"{refusal['path']}{row}: {refusal['reason']}")
    if report["damaged"] or report["quarantined"]:
        raise typer.Exit(EXIT_ERROR if report["damaged"] else EXIT_QUARANTINED)


def _check_installed() -> None:
    needed = ("fastapi", "uvicorn", "python_multipart")
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        raise UsageError(
            f"the service needs {', '.join(missing)}, which a plain installation leaves out. "
            "Install them in the project's folder: pip install '.[serve]'."
        )


def _database(processed: Path):  # type: ignore[no-untyped-def]  # imported when needed
    from pipeline.service.database import Database
    from pipeline.service.settings import Settings

    return Database(Settings(processed, Path("reports")).data)

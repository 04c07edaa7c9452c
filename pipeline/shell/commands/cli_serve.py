"""Commands of the service: `serve`, `token` and `push`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, UsageError
from pipeline.shell import console
from pipeline.shell.commands.cli_storage import counts_of, refusals, warnings_of
from pipeline.shell.commands.log_columns import reads_logs
from pipeline.shell.commands.options import LogProfile, Processed, Reports
from pipeline.shell.console import argument, option

TOKEN_VARIABLE = "PIPELINE_TOKEN"
NEEDED = ("fastapi", "uvicorn", "python_multipart")
"""Packages that a plain installation does not include."""


def serve(
    processed: Processed = Path("processed"),
    reports: Reports = Path("reports"),
    host: Annotated[str, option("--host", "Address to listen at. Other computers need a token.")] = ("127.0.0.1"),
    port: Annotated[int, option("--port", "Port to listen at.", min=0, max=65535)] = 8000,
    read_only: Annotated[bool, option("--read-only", "Refuse every change.")] = False,
) -> None:
    """Serve pages for a browser and a REST interface, until Ctrl-C.

    Environment variables set the limits: PIPELINE_MAX_FILE and PIPELINE_MAX_REQUEST (MiB, 64 and 1024), PIPELINE_RATE
    (requests a minute for each token or address; 0: no limit), PIPELINE_RENEW (0: do not update reports when logs
    arrive).

    Example: pipeline serve --processed processed
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise UsageError(
            f"the service needs {', '.join(missing)}, which a plain installation does not include. "
            "Install them in the project's folder: pip install '.[serve]'."
        )
    from pipeline.service.app import serve as run
    from pipeline.service.settings import Settings, limits

    settings = Settings(processed, reports, host, port, read_only, **limits(os.environ))
    run(settings, lambda place: console.note(f"{place} (stop with Ctrl-C)"))


def token(
    action: Annotated[Literal["create", "list", "revoke"], argument("What to do.", metavar="create|list|revoke")],
    identifier: Annotated[str | None, argument("Id of the token to revoke, as listed.")] = None,
    role: Annotated[Literal["viewer", "contributor", "admin"] | None, option("--role", "What the user may do.")] = None,
    name: Annotated[str, option("--name", "Name of the user, recorded with each change.")] = "",
    days: Annotated[float | None, option("--days", "Days until the token expires.", min=0)] = None,
    processed: Processed = Path("processed"),
) -> None:
    """Create, list or revoke tokens for other computers.

    A viewer may read; a contributor may also upload, compare and correct; an admin may also delete. A new token is
    printed only once, because only its hash is stored.

    Example: pipeline token create --role contributor --name "lab computer"

    Example: pipeline token list

    Example: pipeline token revoke 0123456789ab
    """
    from pipeline.service.database import Database
    from pipeline.service.settings import Settings

    if (action == "create") != (role is not None) or (action == "revoke") != (identifier is not None):
        raise UsageError("expected `create --role ROLE`, `list`, or `revoke ID`.")
    database = Database(Settings(processed, Path("reports")).data)
    if role is not None:
        made = database.create_token(role, name, days)
        console.show({"token": made}, [made])
    elif identifier is not None:
        if not database.revoke_token(identifier):
            raise UsageError(f"no token has the id {identifier!r}. `pipeline token list` lists all tokens.")
        console.show({"revoked": identifier}, [])
    else:
        tokens = database.tokens()
        console.show(tokens, console.table(tokens, ("id", "role", "name", "ends")))


@reads_logs("folder")
def push(
    folder: Annotated[Path, argument("Folder with logs (searched recursively), or a log.")],
    to: Annotated[str, option("--to", "Address of the server, such as http://127.0.0.1:8000.")],
    profile: LogProfile = None,
) -> int:
    """Upload logs to a server. Repeat the command to resume an upload.

    A profile file is stored on the server. The token is read from the variable PIPELINE_TOKEN. The same warnings as by
    `pipeline ingest` are printed on stderr. The exit status is 3 if a log was refused.

    Example: pipeline push raw --to http://127.0.0.1:8000
    """
    from pipeline.service.push import push as push_logs

    with console.progress("push", "logs") as advance:
        report = push_logs(folder, to, profile, os.environ.get(TOKEN_VARIABLE), advance)
    for line in warnings_of(report):
        console.step(line)
    console.show(report, _push_lines(report))
    return EXIT_ERROR if report["damaged"] else EXIT_QUARANTINED if report["quarantined"] else EXIT_OK


def _push_lines(report: Mapping[str, Any]) -> Iterable[str]:
    yield from counts_of(report)
    yield from refusals(report["quarantined"])

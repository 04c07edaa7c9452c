"""Write output to the user. Results go to stdout, and progress and notes go to stderr. An error has a message and an
exit status."""

from __future__ import annotations

import inspect
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from pipeline.base.compiled import on_compiling
from pipeline.base.disk import naming
from pipeline.base.errors import EXIT_ERROR, PipelineError
from pipeline.base.process import Ended, ending_on_signals
from pipeline.base.progress import heard_by

Advance = Callable[[int, int | None], None]
"""Callback that receives the number done and the total number, or None if the total is unknown."""

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Control characters except tab and line feed."""

_JSON = ContextVar("json", default=False)
"""True if the running command prints only JSON."""


def option(name: str, help_text: str, *more: str, **how: Any) -> Any:
    """Return an option with its help text."""
    return typer.Option(name, *more, help=help_text, **how)


def argument(help_text: str, **how: Any) -> Any:
    """Return an argument with its help text."""
    return typer.Argument(help=help_text, **how)


Json = Annotated[bool, option("--json", "Print only JSON on stdout.")]


def command(work: Callable[..., int | None]) -> Callable[..., None]:
    """Return a command with the option ``--json``. It prints its result by `show` and returns its exit status."""

    @wraps(work)
    def run(as_json: bool = False, **given: Any) -> None:
        before = _JSON.set(as_json)
        on_compiling(None if as_json or not _is_watched() else note)
        try:
            raise typer.Exit(work(**given) or 0)
        finally:
            _JSON.reset(before)

    signature = inspect.signature(work, eval_str=True)
    last = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Json)
    parameters = [*signature.parameters.values(), last]
    run.__signature__ = signature.replace(parameters=parameters, return_annotation=None)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def show(document: object, lines: Iterable[str]) -> None:
    """Print the document of a result if ``--json`` is given, otherwise its lines."""
    if _JSON.get():
        _write(json.dumps(document, indent=1, allow_nan=False) + "\n")
    else:
        for line in lines:
            say(line)


def show_line(document: object, lines: Iterable[str]) -> None:
    """Print one of many results without buffering. A JSON document is printed on one line."""
    if _JSON.get():
        _write(json.dumps(document, allow_nan=False) + "\n")
    else:
        show(document, lines)
    sys.stdout.flush()


def run_app(app: typer.Typer, arguments: Sequence[str] | None) -> None:
    """Run the command line, and exit with its status. An expected error is printed as a message on stderr.

    An error of the operating system, such as a full disk, is also printed as a message. Other exceptions are defects
    and are raised with their traceback. A termination signal ends the process as usual, after incomplete files are
    removed.
    """
    try:
        with ending_on_signals():
            app(args=None if arguments is None else list(arguments))
    except Ended as end:
        note(f"Stopped by {end}. Each file is complete or unchanged. Run the command again for the remaining work.")
        end.leave()
    except PipelineError as error:
        note(f"Error: {error}")
        sys.exit(error.exit_status)
    except SystemExit:
        _flush()
        raise
    except OSError as error:
        _leave(error)


def _flush() -> None:
    """Flush the output while an error can still be reported with its name and exit status."""
    try:
        if sys.stdout is not None:
            with naming(Path("standard output")):
                sys.stdout.flush()
    except BrokenPipeError:  # the program that reads the pipe has ended
        _drop_output()
        sys.exit(EXIT_ERROR)
    except OSError as error:
        _leave(error)


def _leave(error: OSError) -> NoReturn:
    place = "a file that the system does not name" if error.filename is None else os.fsdecode(error.filename)
    note(
        f"Error: {place}: cannot be read or written ({error.strerror}). Free disk space or correct the permissions, "
        "and run the command again."
    )
    _drop_output()
    sys.exit(EXIT_ERROR)


def _drop_output() -> None:
    """Discard output that could not be written. Otherwise, the end of the process would fail to write it again."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _write(text: str) -> None:
    if sys.stdout is not None:  # stdout is None if it was closed, for example by `>&-`
        with naming(Path("standard output")):
            sys.stdout.write(text)


def say(text: str) -> None:
    """Print a line of a result on stdout.

    Characters that the terminal cannot display, or would execute, are escaped.
    """
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    _write(_harmless(text).encode(encoding, "backslashreplace").decode(encoding) + "\n")


def note(text: str) -> None:
    """Print a line about the progress of the work on stderr."""
    print(_harmless(text), file=sys.stderr, flush=True)


def step(text: str) -> None:
    """Print the current step on stderr, except with ``--json``."""
    if not _JSON.get():
        note(text)


def _harmless(text: str) -> str:
    """Return a text without control characters. Names and cells of logs may contain control sequences for the
    terminal."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def grouped(messages: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield messages about places. Equal texts are merged into one line, with the first place and the number of
    places."""
    yield from warned((place, text, None) for place, text in messages)


def warned(warnings: Iterable[tuple[str, str, str | None]]) -> Iterator[str]:
    """Yield warnings of logs, (log, text, code or None).

    There is one line for each code or text, with the first log.
    """
    groups: dict[str, list[tuple[str, str]]] = {}
    for log, text, code in warnings:
        groups.setdefault(code or text, []).append((log, text))
    for members in groups.values():
        log, text = members[0]
        yield f"{log if len(members) == 1 else f'{len(members)} logs, first {log}'}: {text}"


def table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> list[str]:
    """Return rows as lines of aligned columns with a header. None is an en dash, and floats have six digits."""
    cells = [list(columns), *([_text(row[name]) for name in columns] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in cells]


def _text(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {None: "–", True: "yes", False: "no"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def is_answered() -> bool:
    """Return True if the user can answer questions, because input and stderr are terminals and no JSON is requested."""
    return not _JSON.get() and _is_watched() and sys.stdin is not None and sys.stdin.isatty()


def _is_watched() -> bool:
    """Return True if stderr is a terminal."""
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def progress(label: str, unit: str = "") -> Iterator[Advance]:
    """Show stage, completed share and remaining time on stderr, if it is a terminal and ``--json`` is not given.

    The share comes from `base.progress`, or from items (``unit``) that the caller counts with the yielded callback.
    """
    if _JSON.get() or not _is_watched():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.fields[shown]}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        begun = time.monotonic()
        task = bar.add_task(label, total=None, shown="", share=0.0)

        def count(done: int, total: int | None) -> None:
            share = done / total if total else None
            shown = f"{done} {unit}" if total is None else f"{done}/{total} {unit}"
            bar.update(task, completed=done, total=total, shown=f"{shown}{_time_left(share, time.monotonic() - begun)}")

        def hear(name: str, share: float) -> None:
            # The displayed share never decreases, even if a search takes longer than usual.
            share = max(share, bar.tasks[0].fields["share"])
            shown = f"{share:.0%}{_time_left(share, time.monotonic() - begun)}"
            title = f"{label}: {name}" if name else label
            bar.update(task, description=title, completed=share, total=1, shown=shown, share=share)

        with heard_by(hear):
            yield count


LEAST_SHARE = 0.03
"""Smallest completed share at which the remaining time is extrapolated from the elapsed time."""


def _time_left(share: float | None, seconds: float) -> str:
    """Return the text for the remaining time, extrapolated from the completed share.

    >>> _time_left(0.25, 30.0), _time_left(0.9, 3600.0), _time_left(0.01, 5.0)
    (', 90 s left', ', 7 min left', '')
    """
    if share is None or share < LEAST_SHARE:
        return ""
    left = seconds * (1 - share) / share
    return f", {left:.0f} s left" if left < 100 else f", {left / 60:.0f} min left"

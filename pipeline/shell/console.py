"""What a user sees: results on stdout, progress and notes on stderr, an error as message and exit status."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import typer

from pipeline.base.disk import naming
from pipeline.base.errors import EXIT_ERROR, PipelineError
from pipeline.base.process import Ended, ending_on_signals

Advance = Callable[[int, int | None], None]
"""Reports (things done, things in all or None where that is not known)."""

QUIET_SECONDS = 2.0
"""Least time between two progress lines where stderr is no terminal: a log file stays short."""

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Control characters but for tab and line feed."""

REFRESH = 8
"""Redraws of the progress bar in a second."""

STANDARD_OUTPUT = Path("standard output")
"""Stands for the output in errors of writing to it."""

OUTSIDE = frozenset(
    {
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EROFS,
        errno.EACCES,
        errno.EPERM,
        errno.EIO,
        errno.EFBIG,
        errno.EMFILE,
        errno.ENFILE,
    }
)
"""Errors of the operating system that no command can foresee: a full or read-only disk, permissions, limits."""


def run_app(app: typer.Typer, arguments: Sequence[str] | None) -> None:
    """Run the command line and leave with its exit status; a named error becomes a message on stderr.

    So does an error of the operating system that is no defect of the program (`OUTSIDE`). Other exceptions are defects:
    they pass with their traceback. A signal that asks for an end ends it as it would any process, when what was not
    complete is taken away.
    """
    try:
        with ending_on_signals():
            app(args=None if arguments is None else list(arguments))
            _flush()
    except Ended as end:
        note(f"Stopped by {end}. Each file is complete or as it was before: run the command again for what is left.")
        for text in getattr(end, "__notes__", ()):
            note(text)
        end.leave()
    except PipelineError as error:
        note(f"Error: {error}")
        sys.exit(error.exit_status)
    except SystemExit:
        _flush()
        raise
    except OSError as error:
        if error.errno not in OUTSIDE:
            raise
        _leave(error)


def _flush() -> None:
    """Write out what was said, while an error can still be told by name and status."""
    try:
        if sys.stdout is not None:
            with naming(STANDARD_OUTPUT):
                sys.stdout.flush()
    except BrokenPipeError:  # who read it has seen enough
        _drop_output()
        sys.exit(EXIT_ERROR)
    except OSError as error:
        _leave(error)


def _leave(error: OSError) -> NoReturn:
    place = "a file that the system does not name" if error.filename is None else os.fsdecode(error.filename)
    note(
        f"Error: {place}: cannot be read or written ({error.strerror}). Make room or correct the permissions, and run "
        "the command again."
    )
    _drop_output()
    sys.exit(EXIT_ERROR)


def _drop_output() -> None:
    """Let what could not be written go nowhere: the end of the process would try again, and fail again."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _write(text: str) -> None:
    if sys.stdout is not None:  # started without one, as by `>&-`: nobody listens
        with naming(STANDARD_OUTPUT):
            sys.stdout.write(text)


def print_json(document: object) -> None:
    """Print one JSON document on stdout; ASCII only, so that no locale can break it."""
    _write(json.dumps(document, indent=1, allow_nan=False) + "\n")


def say(text: str) -> None:
    """Print a line of a result on stdout; a character that the terminal cannot show, or would obey, is escaped."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    _write(_harmless(text).encode(encoding, "backslashreplace").decode(encoding) + "\n")


def grouped(told: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield what is told of places: equal texts once, with their number and the first place."""
    groups: dict[str, list[str]] = {}
    for place, text in told:
        groups.setdefault(text, []).append(place)
    for text, places in groups.items():
        yield f"{places[0] if len(places) == 1 else f'{len(places)} logs, first {places[0]}'}: {text}"


def draft_hint(log: str) -> str:
    """Return what to do about a log of other columns than any profile reads."""
    return f"Other columns? pipeline profile draft {shlex.quote(log)}"


def note(text: str) -> None:
    """Print a line about the work itself on stderr."""
    print(_harmless(text), file=sys.stderr, flush=True)


def _harmless(text: str) -> str:
    """Return a text without control characters: names and cells of logs may hold commands to the terminal."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> list[str]:
    """Return rows as lines of aligned columns with a header; None as an en dash, floats with six digits."""
    cells = [list(columns), *([_text(row[name]) for name in columns] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in cells]


def _text(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@contextmanager
def progress(label: str, unit: str, silent: bool) -> Iterator[Advance]:
    """Show progress on stderr: a bar on a terminal, a line now and then elsewhere, nothing where silent.

    Parameters
    ----------
    label, unit : str
        What is done, and what is counted.
    silent : bool
        With --json.
    """
    if silent:
        yield lambda done, total: None
    elif sys.stderr.isatty():
        with _bar(label, unit) as advance:
            yield advance
    else:
        yield _Lines(label, unit).advance


class _Lines:
    """Progress as lines, at most one in `QUIET_SECONDS`."""

    def __init__(self, label: str, unit: str) -> None:
        self.label, self.unit = label, unit
        self.began = self.printed = time.monotonic()

    def advance(self, done: int, total: int | None) -> None:
        """Print a line when it is due."""
        now = time.monotonic()
        if now - self.printed >= QUIET_SECONDS:
            self.printed = now
            of = "" if total is None else f" of {total}"
            note(f"{self.label}: {done}{of} {self.unit}{_pace(done, total, now - self.began)}")


def _pace(done: int, total: int | None, seconds: float) -> str:
    """Return things done in a second, and the time left where the total is known."""
    if not done or seconds <= 0:
        return ""
    rate = done / seconds
    left = "" if total is None else f", {max(total - done, 0) / rate:.3g} s left"
    return f", {rate:.3g}/s{left}"


@contextmanager
def _bar(label: str, unit: str) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    began = time.monotonic()

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.fields[count]}", markup=False),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=REFRESH, transient=True) as bar:
        task = bar.add_task(label, total=None, count="")

        def advance(done: int, total: int | None) -> None:
            count = f"{done}{'' if total is None else f'/{total}'} {unit}"
            pace = _pace(done, total, time.monotonic() - began)
            bar.update(task, completed=done, total=total, count=count + pace)

        yield advance

"""Command lines in documentation, and what is wrong with them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from typing import Any

import typer


def commands(text: str) -> list[str]:
    """Commands in code blocks and in back quotes."""
    spans = re.findall(r"`(pipeline(?: [^`]+)?)`", " ".join(text.split("\n")))
    lines = re.findall(r"^ {4}(pipeline .*)$", text, flags=re.MULTILINE)
    return [span for span in (*spans, *lines) if " " in span]


def every_command() -> Iterator[tuple[str, Any]]:
    """All commands that do something, with their names."""
    from pipeline.shell.cli import app

    waiting: list[tuple[str, Any]] = [("pipeline", typer.main.get_command(app))]
    while waiting:
        name, command = waiting.pop()
        of = getattr(command, "commands", {})
        waiting += [(f"{name} {word}", each) for word, each in of.items()]
        if not of:
            yield name, command


def fault(command: str) -> str | None:
    """What is wrong with a command line, or None."""
    from pipeline.shell.cli import app

    words = shlex.split(command.split("#")[0])[1:]
    here: Any = typer.main.get_command(app)
    while words and hasattr(here, "commands") and not words[0].startswith("-"):
        if words[0] not in here.commands:
            return f"no command {words[0]!r} in {sorted(here.commands)}"
        here = here.commands[words.pop(0)]
    if "--help" in words:
        return None
    try:
        given, left, _ = here.make_parser(here.context_class(here)).parse_args([*words])
    except Exception as error:  # of the library's parser, which typer may bring along or not
        return str(error)
    if left:
        return f"too many arguments: {left}"
    needed = {p.name for p in here.params if p.required and p.param_type_name == "option"}
    # a command that is only named, as in a list of changes, says nothing of its options
    return f"{sorted(needed - set(given))} missing" if words and needed - set(given) else None

"""The command line: parse, call, print. Nothing is computed here.

A process loads the module of the one command that it runs, and each command imports what it needs itself: start-up is
most of what a short command takes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated

import typer

from pipeline import __version__
from pipeline.base.process import begin_alone
from pipeline.shell import console

COMMANDS = {
    "demo": ("cli_course", "demo"),
    "simulate": ("cli_course", "simulate"),
    "ingest": ("cli_storage", "ingest"),
    "status": ("cli_storage", "status"),
    "check": ("cli_storage", "check"),
    "exclude": ("cli_storage", "exclude"),
    "move": ("cli_storage", "move"),
    "delete": ("cli_storage", "delete"),
    "watch": ("cli_watch", "watch"),
    "compare": ("cli_report", "compare"),
    "verify": ("cli_verify", "verify"),
    "bundle": ("cli_verify", "bundle"),
    "accuracy": ("cli_course", "accuracy"),
    "serve": ("cli_serve", "serve"),
    "token": ("cli_serve", "token"),
    "push": ("cli_serve", "push"),
    "theory": ("cli_theory", "app"),
    "look": ("cli_profiles", "look"),
    "profile": ("cli_profiles", "profile"),
    "quarantine": ("cli_profiles", "quarantine"),
    "identify": ("cli_identify", "identify"),
    "plan": ("cli_plan", "plan"),
    "design": ("cli_design", "design"),
}
"""Module and name of each command, or group of commands, in the order of the help."""


def application(word: str | None = None) -> typer.Typer:
    """Return the command that a first word names, or all where it names none."""
    app = typer.Typer(
        name="pipeline",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        help="From logs of step responses against virtual walls to stability, costs and their comparison with theory.",
    )
    app.callback()(_main)
    for name in [word] if word in COMMANDS else COMMANDS:
        module, attribute = COMMANDS[name]
        part = getattr(import_module(f"pipeline.shell.commands.{module}"), attribute)
        if isinstance(part, typer.Typer):
            app.add_typer(part, name=name)
        else:
            app.command(name)(part)
    return app


def __getattr__(name: str) -> typer.Typer:
    """Make ``app``, the whole command line, for who asks for it."""
    if name == "app":
        return application()
    raise AttributeError(name)


def _version(asked: bool) -> None:
    if asked:
        console.say(f"pipeline {__version__}")
        raise typer.Exit


def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def run(arguments: Sequence[str] | None = None) -> None:
    """Run the command line, by default with the arguments of the process, and leave with its exit status."""
    if arguments is None:
        begin_alone()
    given = sys.argv[1:] if arguments is None else arguments
    console.run_app(application(next(iter(given), None)), arguments)

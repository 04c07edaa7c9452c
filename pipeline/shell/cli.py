"""The command line. Its modules parse arguments, call functions and print results. They compute nothing.

A process loads only the module of the command that it runs, and each command imports its dependencies itself, because
start-up dominates the run time of a short command.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated

import typer

from pipeline.base.process import begin_alone
from pipeline.base.provenance import __version__
from pipeline.shell import console

COMMANDS = {
    name: module
    for module, names in (
        ("cli_start", ("start",)),
        ("cli_device", ("demo", "simulate", "identify", "design")),
        ("cli_storage", ("ingest", "status", "check", "exclude", "move", "delete")),
        ("cli_report", ("compare", "verify", "bundle", "watch")),
        ("cli_device", ("plan",)),
        ("cli_storage", ("look", "profile", "quarantine")),
        ("cli_serve", ("serve", "token", "push")),
        (
            "cli_theory",
            ("accuracy", "explore", *(f"theory {name}" for name in ("points", "boundary", "optimum", "map", "tables"))),
        ),
    )
    for name in names
}
"""Module of each command, in the order of the help. The last word of a command is the name of its function."""

PLAIN = ("demo", "serve")
"""Commands without a result, which therefore have no --json."""

THEORY = (
    "Compute stability, costs and optima of the sampled, delayed loop. Parameters are normalised by sampling period T "
    "and mass m: alpha = K T^2/m, beta = B T/m, gamma = k T^2/m, delta = b T/m. With --device, all values are in SI, "
    "for the loop of a device with its filter, lag, mode and operator."
)
SETTINGS = {"help_option_names": ["-h", "--help"]}


def application(word: str | None = None) -> typer.Typer:
    """Return the application with the command that starts with the given word, otherwise with all commands."""
    app = typer.Typer(
        name="pipeline",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings=SETTINGS,
        help="Analyse step responses at virtual walls for stability and costs, and compare them with theory.",
    )
    app.callback()(_main)
    theory = typer.Typer(no_args_is_help=True, help=THEORY)
    chosen = [name for name in COMMANDS if name.split()[0] == word] or COMMANDS
    for name in chosen:
        group, _, own = name.rpartition(" ")
        module = import_module(f"pipeline.shell.commands.{COMMANDS[name]}")
        work = getattr(module, {"map": "cost_map"}.get(own, own))
        (theory if group else app).command(own)(work if name in PLAIN else console.command(work))
    if any(" " in name for name in chosen):
        app.add_typer(theory, name="theory")
    return app


def __getattr__(name: str) -> typer.Typer:
    """Create ``app``, the complete command line, when it is first accessed."""
    if name == "app":
        return application()
    raise AttributeError(name)


def _version(requested: bool) -> None:
    if requested:
        console.say(f"pipeline {__version__}")
        raise typer.Exit


def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def run(arguments: Sequence[str] | None = None) -> None:
    """Run the command line, and exit with its status. By default, the arguments of the process are used."""
    if arguments is None:
        begin_alone()
    given = sys.argv[1:] if arguments is None else arguments
    console.run_app(application(next(iter(given), None)), arguments)

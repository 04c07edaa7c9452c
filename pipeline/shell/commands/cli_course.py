"""Commands that simulate logs and measure the methods: parse, call, print."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.base.errors import UsageError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import PROCESSED, Experiments, Json

if TYPE_CHECKING:
    from pipeline.records.models import Device


SET = ("quantum", "noise", "jitter", "duration_s", "damping_range")
"""What of a simulation may be set in place of what the device file says."""


def demo(
    full: Annotated[bool, typer.Option("--full", help="Thesis size: all experiments, all trials.")] = False,
) -> None:
    """Simulate, ingest and compare small courses of two devices.

    Writes raw/demo/, processed/demo/, reports/falcon.html and reports/lwr.html below the current folder, and
    replaces files of these names.

    Example: pipeline demo
    """
    from pipeline.shell.demo import run_demo

    check_output(Path("reports/falcon.html"), "", document_beside=True)
    for line in run_demo(full=full, report_progress=console.note).lines:
        console.say(line)


def _count(advance: console.Advance, kept: int) -> None:
    """Show how many trials a course has so far; how many there will be is known only at its end."""
    advance(kept, None)


def simulate(
    device: Annotated[str, typer.Argument(help="Name of a known device, or a device file (.toml).")],
    experiment: Experiments = None,
    out: Annotated[Path, typer.Option("--out", help="Logs go to DEVICE/EXPERIMENT below this folder.")] = Path("raw"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of noise and jitter.")] = 0,
    ideal: Annotated[bool, typer.Option("--ideal", help="Without noise, quantum and jitter.")] = False,
    setting: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="In place of the device's: quantum, noise (m or rad), jitter (such as 3,4,5, or none), duration_s, "
            "damping_range (tested or full); may be given several times.",
        ),
    ] = None,
    coarsen: Annotated[int, typer.Option("--coarsen", help="Every n-th damping and n times the stiffness step.")] = 1,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the logs of an earlier simulation.")] = False,
    as_json: Json = False,
) -> None:
    """Write simulated logs of a device, with the truth beside them.

    Example: pipeline simulate falcon --experiment 1 --out raw --seed 1
    """
    from pipeline.simulation.course import run_course, write_course

    record = _device(device)
    names = [e.name for e in record.experiments] if not experiment else list(dict.fromkeys(experiment))
    changed = _settings(setting or ())
    counts: dict[str, int] = {}
    for name in names:
        with console.progress(f"{record.name} {name}", "trials", as_json) as advance:
            course = run_course(
                record,
                name,
                seed=seed,
                ideal=ideal,
                coarsen=coarsen,
                progress=partial(_count, advance),
                **changed,
            )
        counts[name] = write_course(course, out, overwrite=overwrite)
        if not as_json:
            console.say(f"{record.name}, experiment {name}: {counts[name]} logs in {out}")
    if as_json:
        console.print_json({"device": record.name, "folder": str(out), "seed": seed, "logs": counts})


def _device(text: str) -> Device:
    from pipeline.device_data.devices import load_device, read_device

    return read_device(Path(text)) if text.endswith(".toml") else load_device(text)


def _settings(given: Sequence[str]) -> dict[str, Any]:
    """Return what is set by words KEY=VALUE, as `run_course` takes it."""
    found: dict[str, Any] = {}
    for word in given:
        key, _, value = word.partition("=")
        try:
            if key == "jitter":
                found[key] = () if value == "none" else tuple(map(int, value.split(",")))
            elif key == "damping_range":
                found[key] = {"tested": "tested", "full": "full"}[value]
            else:
                found[{name: name for name in SET}[key]] = float(value)
        except (KeyError, ValueError):
            raise UsageError(
                f"--set {word}: expected one of {', '.join(SET)}, = and a number; jitter is such as 3,4,5 or none, "
                "and damping_range tested or full."
            ) from None
    return found


def accuracy(
    out: Annotated[Path, typer.Option("--out", help="HTML file to write, with the JSON document beside it.")] = Path(
        "reports/accuracy.html"
    ),
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer settings and repetitions: seconds, not two minutes.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Measure error against run time of each numerical method.

    Reports of comparisons show the part on theory while code and machine are unchanged (stored in processed, or where
    PIPELINE_PROCESSED says).

    Example: pipeline accuracy --quick
    """
    from pipeline.base.disk import write_text
    from pipeline.records import accuracy as results
    from pipeline.studies.accuracy import page, run

    check_output(out, "--out", document_beside=True)
    say = (lambda _: None) if as_json else console.note
    report = run.measure(quick, say)
    write_text(out, page.render(report))
    write_text(out.with_suffix(".json"), report.model_dump_json(indent=1) + "\n")
    results.store(report, Path(os.environ.get(PROCESSED, "processed")))
    if as_json:
        console.print_json(report.model_dump(mode="json"))
        return
    for line in console.table(page.summary_rows(report), ("quantity", "error", "time", "other", "other time")):
        console.say(line)
    console.say(f"{report.machine['processor']}, Python {report.machine['python']}, numpy {report.machine['numpy']}")
    console.say(f"report: {out}")

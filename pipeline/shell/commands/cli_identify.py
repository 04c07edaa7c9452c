"""Command `pipeline identify`: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import Json, ProfileFile

WORDS = {
    "acceleration": "acceleration by the largest command, friction and constant force included",
    "damping_per_mass": "damping over mass",
    "stiffness_per_mass": "stiffness over mass",
    "friction_less_force": "friction less the constant force in the direction of motion",
    "delay_and_lag": "delay and actuator lag together",
}
"""Combinations in words."""


def identify(
    paths: Annotated[list[Path], typer.Argument(help="Logs with command and position, or folders with some.")],
    profile: ProfileFile = None,
    period: Annotated[
        float | None, typer.Option("--period", help="Sampling period of the walls in s (default: that of the logs).")
    ] = None,
    delay: Annotated[
        float | None, typer.Option("--delay", help="Delay of the walls in samples (default: that of the logs).")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Device file (.toml) to write.")] = None,
    as_json: Json = False,
) -> None:
    """Identify a device from any logs, and the walls it can render.

    No wall and no rest are needed; steps, staircases, sweeps and wall trials all serve. A native log of no wall may
    leave out stiffness, damping, step and names.

    Example: pipeline identify logs --out motor.toml
    """
    from pipeline.base.disk import write_text
    from pipeline.surface.identified_device import device_text, identified_device

    if out is not None:
        check_output(out, "--out")
    document = identified_device(paths, profile, period, delay)
    if out is not None:
        write_text(out, device_text(document, out.stem))
    if as_json:
        console.print_json(document)
        return
    for line in _lines(document):
        console.say(line)
    if out is not None:
        console.say(f"wrote {out}")


def _lines(document: dict[str, Any]) -> list[str]:
    from pipeline.surface.identified_device import FOLLOWS

    fit = document["replay"]["fit_percent"]
    lines = [f"{document['trials']} logs, {document['rows']} rows, T = {document['sampling_period_s']:g} s", ""]
    lines += console.table(document["parameters"], ("name", "value", "low", "high", "unit"))
    lines.append("")
    found = [part["name"] for part in document["parts"] if part["found"]]
    lines.append(f"parts beside mass, damper and delay: {', '.join(found) or 'none found'}")
    open_parts = [part["name"] for part in document["parts"] if not part["found"]]
    if open_parts:
        lines.append(f"may be there or not by these logs: {', '.join(open_parts)}")
    if document["assumed_none"]:
        words = ", ".join(name.replace("_", " ") for name in document["assumed_none"])
        lines.append(f"taken as none, since the command never changes: {words}")
    for each in document["not_told_apart"]:
        names = ", ".join(name.replace("_", " ") for name in each["members"])
        lines.append(
            f"not told apart: {names}. Known is {WORDS[each['combination']]}: "
            f"{each['value']:.5g} ({each['low']:.5g} to {each['high']:.5g}) {each['unit']}. Record {each['record']}."
        )
    if not document["scatter_in_interval"]:
        lines.append("the intervals are from within the logs; what differs from run to run needs 8 logs or more")
    if fit is not None:
        lines.append(f"free runs of held-out logs: fit {fit:.1f} % (median)")
        if fit < FOLLOWS:
            lines.append(
                "this model does not predict the device by its command alone: something else moves it, or a part is "
                "missing, and the intervals hold only as far as the model does"
            )
    border = document["boundary"]
    if border is not None:
        top = border["stiffness_max"]
        lines.append(
            f"walls at T = {border['sampling_period_s']:g} s and a delay of {border['delay_samples']:.4g} samples: "
            f"stable up to K = {top['value']:.5g} ({top['low']:.5g} to {top['high']:.5g}) at B = "
            f"{border['damping_at_stiffness_max']:.5g} (linear; --json has the boundary)"
        )
    return lines

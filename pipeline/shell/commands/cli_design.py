"""The command `pipeline design`: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.base.errors import UsageError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import Json

if TYPE_CHECKING:
    from pipeline.records.models import Device
    from pipeline.surface.physical_loop import Loop

_SHOWN = 6
"""Changes that are printed; the document has all."""


def design(
    device: Annotated[str, typer.Option("--device", help="Name of a device or its TOML file.")],
    experiment: Annotated[
        str | None, typer.Option("--experiment", help="Experiment of the device; its first where not given.")
    ] = None,
    stiffness: Annotated[
        float | None, typer.Option("--stiffness", help="K of the wall that is wanted, in N/m or Nm/rad.")
    ] = None,
    settling: Annotated[
        float | None, typer.Option("--settling", help="Longest settling time to 2 %, in seconds.")
    ] = None,
    overshoot: Annotated[
        float | None, typer.Option("--overshoot", help="Largest overshoot, a fraction; 0 for none.")
    ] = None,
    margin: Annotated[
        float, typer.Option("--margin", help="The wall stays stable with K so many times as large.")
    ] = 1.0,
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="The wish holds with mass, damping, delay off by this share.")
    ] = 0.0,
    hand: Annotated[
        str | None, typer.Option("--hand", help="Arm of Table 3.2 that holds the device, as Hogan; else free.")
    ] = None,
    keep: Annotated[
        list[str] | None, typer.Option("--keep", help="Quantity that cannot be changed; may be given several times.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Draw the stiffest wall over two quantities: .svg, .pdf, .png.")
    ] = None,
    over: Annotated[
        str, typer.Option("--over", help="The two quantities of the picture, separated by a comma.")
    ] = "sampling_period_s,delay_samples",
    as_json: Json = False,
) -> None:
    """Find the smallest changes of a rig that reach the wanted wall.

    Example: pipeline design --device falcon --stiffness 5000 --overshoot 0

    Example: pipeline design --device arm.toml --stiffness 20000 --margin 1.5 --keep mass --picture arm.svg
    """
    from pipeline.rig.design import design as answer_of

    known, case, loop = _rig(device, experiment, hand)
    if picture is not None:
        check_output(picture, "--picture")
        if picture.suffix not in (".svg", ".pdf", ".png"):
            raise UsageError(f"--picture {picture}: expected a name that ends with .svg, .pdf or .png.")
    answer = answer_of(
        loop,
        stiffness,
        settling_s=settling,
        overshoot=overshoot,
        margin=margin,
        tolerance=tolerance,
        keep=keep or (),
    )
    if picture is not None:
        from pipeline.rig.picture import picture as draw

        draw(loop, answer, tuple(word.strip() for word in over.split(",")), picture)
    document = {"device": known.name, "experiment": case, "hand": hand, **answer.document()}
    document["left_out"] = known.loop_of(next(e for e in known.experiments if e.name == case)).left_out
    document["quantum"] = _quantum(known, case, stiffness)
    document["published"] = _published(known, case, loop, answer.wall["damping"] or 0.0)
    if as_json:
        console.print_json(document)
        return
    for line in _lines(document, loop):
        console.say(line)


def _rig(name: str, experiment: str | None, hand: str | None) -> tuple[Device, str, Loop]:
    """Return a device, the name of its experiment and its loop, held by an arm where one is named."""
    from dataclasses import replace

    from pipeline.device_data.devices import find_experiment, load_device, read_device
    from pipeline.device_data.human_arm import human_arms
    from pipeline.surface.physical_loop import loop_of_device

    known = read_device(Path(name)) if name.endswith(".toml") else load_device(name)
    conditions = find_experiment(known, experiment) if experiment else known.experiments[0]
    loop = loop_of_device(known, conditions)
    if hand is None:
        return known, conditions.name, loop
    arms = {arm.source.lower(): arm for arm in human_arms()}
    if hand.lower() not in arms:
        raise UsageError(f"--hand {hand}: expected one of {', '.join(arm.source for arm in human_arms())}.")
    if loop.motion == "rotation":
        raise UsageError("--hand: arms of Table 3.2 are in kg and N/m. Give an operator in the device file.")
    arm = arms[hand.lower()].model_dump(include={"mass", "damping", "stiffness"})
    return known, conditions.name, replace(loop, operator=arm)


def _quantum(device: Device, experiment: str, stiffness: float | None) -> dict[str, Any] | None:
    """Return up to which stiffness the sensor's quantum causes no limit cycle, and the quantum that K asks for."""
    from pipeline.device_data.devices import find_experiment
    from pipeline.theory.limits import quantum_limit

    friction = device.loop_of(find_experiment(device, experiment)).friction
    quantum = device.sensor.quantum
    if friction is None or not friction.coulomb > 0 or not quantum > 0:
        return None
    needed = None if stiffness is None else 2 * friction.coulomb / stiffness
    return {"stiffness": quantum_limit(friction.coulomb, quantum), "quantum": quantum, "quantum_needed": needed}


def _published(device: Device, experiment: str, loop: Loop, damping: float) -> list[dict[str, Any]]:
    """Return what published conditions allow at the damping of the nearest wall."""
    from pipeline.device_data.devices import find_experiment
    from pipeline.rig.published import published_limits

    friction = device.loop_of(find_experiment(device, experiment)).friction
    coulomb = friction.coulomb if friction is not None else 0.0
    found = published_limits(loop, damping, coulomb=coulomb, quantum=device.sensor.quantum)
    rows: list[dict[str, Any]] = found.astype(object).where(found.notna(), None).to_dict("records")
    return rows


def _lines(document: dict[str, Any], loop: Loop) -> list[str]:
    """Return the answer as lines: reached or not, the wall, changes, sensitivities."""
    k, b = ("N/m", "Ns/m") if loop.motion == "translation" else ("Nm/rad", "Nms/rad")
    wall, reached = document["wall"], document["stiffness_reached"]
    lines = [f"Reached: {'yes' if document['reached'] else 'no'}."]
    if reached is not None and document["wish"]["stiffness"] is not None:
        word = "Up to" if document["reached"] else "Only up to"
        lines[0] += f" {word} K = {reached:.5g} {k} all that is wished for holds."
    lines.append(f"Nearest wall: K = {wall['stiffness']:.5g} {k}, B = {wall['damping']:.4g} {b}: {_told(wall, k)}")
    changes = document["changes"]
    if changes:
        lines += ["", "Changes that reach it, smallest first:"]
        for change in changes[:_SHOWN]:
            parts = [
                f"{name} {change['before'][name]:.4g} -> {change['after'][name]:.4g} {change['units'][name]}"
                for name in change["after"]
            ]
            lines.append(
                f"  {' and '.join(parts)}: then B = {change['wall']['damping']:.4g} {b}, {_told(change['wall'], k)}"
            )
        if len(changes) > _SHOWN:
            lines.append(f"  ({len(changes) - _SHOWN} more: --json)")
    lines += [f"  {name} alone: {why}" for name, why in document["out_of_reach"].items()]
    if not document["reached"] and not changes:
        lines.append("No change of one quantity or of two within the ranges that are searched reaches it.")
    lines += ["", f"Largest stable K {document['sensitivities'][0]['stiffness_max']:.5g} {k}; it changes with"]
    for row in document["sensitivities"]:
        percent, unit = row["stiffness_max_percent"], f"{k} per {row['unit']}"
        lines.append(
            f"  {row['quantity']} by {percent:+.3g} % per percent ({row['stiffness_max_per_unit']:.4g} {unit})"
        )
    lines += ["", f"Published conditions at B = {wall['damping']:.4g} {b}, and what they leave out:"]
    for row in document["published"]:
        if row["stiffness"] is not None:
            lines.append(
                f"  K <= {row['stiffness']:.5g} {k} for {row['promises']}: {row['condition']} ({row['assumes']})"
            )
    if document["left_out"]:
        lines.append(f"Left out of linear theory: {', '.join(document['left_out'])}.")
    quantum = document["quantum"]
    if quantum is not None:
        lines.append(
            f"The sensor's quantum causes no limit cycle up to K = 2 f_c/quantum = {quantum['stiffness']:.5g} {k}."
        )
    return lines


def _told(wall: dict[str, float | None], k: str) -> str:
    limit, settling, overshoot = wall["stiffness_limit"], wall["settling_s"], wall["overshoot"]
    words = ["unstable" if limit is None or limit < (wall["stiffness"] or 0) else f"limit {limit:.5g} {k}"]
    if settling is not None:
        words.append(f"settles in {settling:.3g} s")
    if overshoot is not None:
        words.append(f"overshoot {100 * overshoot:.2g} %")
    return ", ".join(words)

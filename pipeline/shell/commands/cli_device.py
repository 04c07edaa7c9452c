"""Commands for devices: `demo`, `simulate`, `identify`, `design` and `plan`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from math import inf, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pipeline.base.errors import EXIT_QUARANTINED, UsageError
from pipeline.base.json_object import JsonObject
from pipeline.base.paths import check_output
from pipeline.base.process import Ended
from pipeline.base.wording import counted
from pipeline.shell import console
from pipeline.shell.commands.log_columns import reads_logs
from pipeline.shell.commands.options import (
    DeviceName,
    Experiments,
    Ignore,
    LogProfile,
    One,
    Out,
    Processed,
    ProfileFile,
    device_of,
    listed,
    quantity,
    stiffness_of,
)
from pipeline.shell.console import argument, option

if TYPE_CHECKING:
    from pipeline.records.models import Device
    from pipeline.surface.physical_loop import Loop

_SHOWN = 6
"""Largest number of log names that are printed. The JSON document has all names."""

UNEXPLAINED = "The motion is not explained by the command, because another force acts or the model is incomplete."

DRIVEN = ("positive", "negative", "small", "large")
"""Classes of commands. If the gain of the drive differs between classes, the mass is given for each class."""

LIMIT_QUANTITIES = {
    "stiffness": ("stiffness", "rotational stiffness"),
    "damping": ("damping", "rotational damping"),
    "force": ("force", "torque"),
    "travel": ("length", "angle"),
}
"""Options that limit the planned trials, with their physical quantities."""


def demo() -> None:
    """Simulate, ingest and compare small experiments with three devices.

    The command writes raw/demo/, processed/demo/ and the reports falcon-real, falcon and lwr (reports/*.html) below the
    current folder. Files of these names are replaced.

    Example: pipeline demo
    """
    from pipeline.shell.demo import run_demo

    check_output(Path("reports/falcon.html"), "", document_beside=True)
    reports, lines = run_demo(report_progress=console.step)
    console.show({"reports": [str(path) for path in reports]}, lines)


def simulate(
    device: Annotated[str, argument("Device: name or file (.toml).")],
    experiment: Experiments = None,
    out: Annotated[Path, option("--out", "Folder. Logs are written to its subfolders DEVICE/EXPERIMENT.")] = Path(
        "raw"
    ),
    seed: Annotated[int, option("--seed", "Seed of noise and jitter.", min=0)] = 0,
    coarsen: Annotated[int, option("--coarsen", "Use every n-th damping, and n times the step in K.")] = 1,
) -> None:
    """Write simulated logs of a device, and its true parameters.

    Logs of an earlier simulation in the folder are replaced. Other files are never changed.

    Example: pipeline simulate falcon --experiment 1 --out raw --seed 1
    """
    from pipeline.simulation.sweep import run_sweep, write_sweep

    record = device_of(device)

    def simulated(name: str) -> int:
        with console.progress(f"{record.name} {name}", "trials") as advance:
            course = run_sweep(record, name, seed=seed, coarsen=coarsen, progress=lambda kept: advance(kept, None))
        return write_sweep(course, out, overwrite=True)

    counts = {name: simulated(name) for name in experiment or [e.name for e in record.experiments]}
    lines = (f"{record.name}, experiment {name}: {count} logs in {out}" for name, count in counts.items())
    console.show({"device": record.name, "folder": str(out), "seed": seed, "logs": counts}, lines)


@reads_logs("paths", walls=False)
def identify(
    paths: Annotated[list[Path], argument("Logs with command and position, or folders with such logs.")],
    profile: LogProfile = None,
    period: Annotated[str | None, option("--period", "Sampling period of the walls: 0.0005, '0.5 ms'.")] = None,
    delay: Annotated[float | None, option("--delay", "Delay of the walls, in samples.")] = None,
    out: Out = None,
    report: Annotated[Path | None, option("--report", "Page with the evidence to write (.html).")] = None,
    ignore: Ignore = None,
) -> None:
    """Identify a device from logs, and compute the walls it can render.

    Neither a wall nor rest is needed. Steps, staircases, sweeps and wall trials are suitable. A native log without a
    wall may omit stiffness, damping, step and names. By default, the period and the delay of the logs are used for the
    walls. With --out, a device file (.toml) is written. With --report, a page (.html) compares the measured motion with
    free runs. It also shows residuals, parameters, tested parts and walls, or the reason why no device can be
    identified.

    Example: pipeline identify logs --out motor.toml

    Example: pipeline identify logs --report motor.html

    Example: pipeline identify run.mat --time t --command u:V --position x:mm --gain '2.3 N/V'
    """
    from pipeline.base.disk import write_text
    from pipeline.surface.identify import Reading, WallSampling, check_report, device_text, identified_device

    if out is not None:
        check_output(out, "--out")
    if report is not None:
        check_report(report, "--report")
        if out is not None and out.resolve() == report.resolve():
            raise UsageError(f"--report {report}: the device file of --out has the same name. Give a different name.")
    wall_period = None if period is None else quantity("--period", period, "time")
    with console.progress("identify", "logs") as advance:
        reading = Reading(paths, profile, ignore or (), advance)
        document = identified_device(reading, WallSampling(wall_period, delay), report).document
    console.show(document, identified_lines(document))
    copies = document["copies"]
    if copies:
        what = (
            f"{counted(len(copies), 'log')} with the same samples as another log count{'s' * (len(copies) == 1)} only "
            "once"
        )
        console.note(f"{what}: {', '.join(copies[:_SHOWN])}")
    findings = (each for each in document["findings"] if each["log"] not in copies)
    for line in console.warned((each["log"], each["sentence"], each["code"]) for each in findings):
        console.note(f"warning: {line}")
    for each in document["refused"]:
        row = "" if each["row"] is None else f", row {each['row']}"
        place = f"{each['path']}{row}: "
        console.note(f"Refused: {place}{each['reason'].removeprefix(place)}")
    if report is not None:
        console.note(f"wrote {report}")
    if out is not None:
        write_text(out, device_text(document, out.stem))
        console.note(f"wrote {out}")
    if document["refused"]:
        raise SystemExit(EXIT_QUARANTINED)


def _with_interval(number: JsonObject) -> str:
    """Return a number with its interval and unit. The digits are enough to distinguish the ends of the interval."""
    from pipeline.rendering.labels import interval_texts

    value, low, high = interval_texts(number["value"], number["low"], number["high"])
    return f"{value} ({low} to {high}) {number['unit']}"


def identified_lines(document: JsonObject) -> Iterator[str]:
    """Yield the result of an identification as lines: parameters, inseparable combinations, replay, limits."""
    from pipeline.device.parameters import unit_of
    from pipeline.surface.identification_page import COMBINATIONS, idle_sentences, sentences_on_unused
    from pipeline.surface.identify import DRIFT

    fit, limits = document["replay"]["fit_percent"], document["boundary"]
    yield f"{document['trials']} logs, {document['rows']} rows, T = {document['sampling_period_s']:g} s"
    yield from sentences_on_unused(document)
    yield from ("", *console.table(document["parameters"], ("name", "value", "low", "high", "unit")), "")
    for reason in dict.fromkeys(row["reason"] for row in document["parameters"] if row["reason"]):
        names = [row["name"] for row in document["parameters"] if row["reason"] == reason]
        yield f"not identifiable: {_words(names)}. {reason[0].upper()}{reason[1:]}"
    parts = {found: ", ".join(p["name"] for p in document["parts"] if p["found"] is found) for found in (True, False)}
    yield f"parts identified in addition to mass, damping and delay: {parts[True] or 'none'}"
    if parts[False]:
        yield f"parts that these logs neither show nor exclude: {parts[False]}"
    yield from idle_sentences(document)
    if (force := document["measured_force"]) is not None and force["reason"] is not None:
        yield f"force: {force['reason']}"
    elif force is not None:
        yield (
            f"force: device and drive are identified separately; the drive model explains {force['fit_percent']:.1f} % "
            "of the force"
        )
    if (drive := document["drive"]) is not None:
        ways = (f"{_with_interval(drive[way])} for {way} commands" for way in DRIVEN if way in drive)
        inertia = "Mass" if document["motion"] == "translation" else "Inertia"
        kinds = [kind for number, kind in (("asymmetry", "direction"), ("curvature", "size")) if number in drive]
        where = "in each direction" if kinds == ["direction"] else "at several sizes of the command"
        yield f"The gain of the drive differs by {_words(kinds)}. {inertia} per unit of command: {', '.join(ways)}."
        yield f"  The intervals above include all of these values. Record the force, or calibrate the drive {where}."
    if (gravity := document["gravity"]) is not None:
        torque, angle = (_with_interval(gravity[name]) for name in ("torque", "angle"))
        yield f"Gravity acts with up to {torque}. The device would hang at rest at an angle of {angle}."
    if document["assumed_none"]:
        yield f"assumed zero, because the command never changes: {_words(document['assumed_none'])}"
    for each in document["not_told_apart"]:
        known = f"{COMBINATIONS[each['combination']]}: {_with_interval(each)}"
        yield f"cannot be separated: {_words(each['members'])}. Identifiable: {known}."
        yield f"  To separate them, record {each['record']}."
    if not document["scatter_in_interval"]:
        yield "the intervals do not include the scatter between runs, because its estimate needs at least 8 logs"
    if fit is not None:
        naive = document["replay"]["naive_percent"]
        without = f"without the command {naive:.1f} %"
        yield f"replayed logs that were left out of the fit: {fit:.1f} % of the velocity (median; {without})"
        if not document["replay"]["follows"]:
            behind_walls = document["replay"]["behind_walls"]
            yield f"  ({DRIFT})" if behind_walls else f"{UNEXPLAINED} No limit of stable walls is reported."
    if limits is not None:
        top, B = limits["stiffness_max"], limits["damping_at_stiffness_max"]
        yield f"walls at T = {limits['sampling_period_s']:g} s with a delay of {limits['delay_samples']:.4g} samples:"
        k, b = unit_of("stiffness", document["motion"]), unit_of("damping", document["motion"])
        ends = f"{top['low']:.5g} to {top['high']:.5g}"
        yield f"  stable up to K = {top['value']:.5g} {k} ({ends}) at B = {B:.5g} {b}"
        unfiltered = "" if document["velocity_filter"] else ", a velocity filter lowers the limit"
        plain = "" if document["loop"]["velocity"] else ", with the difference quotient as velocity"
        yield f"  (linear theory{plain}: friction raises the limit{unfiltered})"
    if document["velocity_filter"]:
        yield document["velocity_filter"]
    if "jitter" in document["left_out"]:
        jitter = document["loop"]["jitter_samples"]
        yield (
            f"The delay jitters with a standard deviation of {jitter['value']:.3g} samples ({jitter['low']:.3g} to "
            f"{jitter['high']:.3g})."
        )
    if document["left_out"]:
        yield f"parts not included in linear theory: {', '.join(document['left_out'])}"


def _words(names: list[str]) -> str:
    return ", ".join(name.replace("_", " ") for name in names)


def design(
    device: DeviceName,
    experiment: One = None,
    stiffness: Annotated[str | None, option("--stiffness", "Required K, such as 5000 or '5 N/mm'.")] = None,
    settling: Annotated[
        str | None, option("--settling", "Longest settling time to 2 %, such as 0.03 or '30 ms'.")
    ] = None,
    overshoot: Annotated[
        str | None, option("--overshoot", "Largest overshoot, such as 0.05 or 5%; less than 0.001 means none.")
    ] = None,
    margin: Annotated[float, option("--margin", "Gain margin: factor on K up to which the wall stays stable.")] = 1.0,
    hand: Annotated[
        str | None, option("--hand", "Arm of Table 3.2, which replaces the operator of the device file.")
    ] = None,
    keep: Annotated[list[str] | None, listed("--keep", "Quantities that cannot change.")] = None,
    picture: Annotated[
        Path | None, option("--picture", "Picture of the largest K over T and delay: .svg, .pdf, .png.")
    ] = None,
) -> None:
    """Find the smallest changes to a rig that allow the required wall.

    Example: pipeline design --device falcon --stiffness 5000 --overshoot 0

    Example: pipeline design --device arm.toml --stiffness 20000 --margin 1.5 --keep mass --picture arm.svg
    """
    from dataclasses import asdict

    from pipeline.device_data.devices import find_experiment
    from pipeline.rig.design import answer as answer_of
    from pipeline.rig.guidelines import guidelines
    from pipeline.rig.picture import picture as draw
    from pipeline.rig.published import published_rows
    from pipeline.rig.wish import DesignTarget
    from pipeline.theory.reachable import reachable

    if picture is not None:
        check_output(picture, "--picture")
        if picture.suffix not in (".svg", ".pdf", ".png"):
            raise UsageError(f"--picture {picture}: expected a name that ends with .svg, .pdf or .png.")
    known = device_of(device)
    conditions = find_experiment(known, experiment)
    loop = _held(known, conditions, hand)
    wanted = None if stiffness is None else stiffness_of(stiffness, loop.motion)
    wish = {
        "settling_s": None if settling is None else quantity("--settling", settling, "time"),
        "overshoot": None if overshoot is None else _share(overshoot),
        "margin": margin,
    }
    with console.progress("design"):
        answer = answer_of(loop, DesignTarget(wanted, **wish), keep or ())  # type: ignore[arg-type]
        if picture is not None:
            draw(loop, answer, ("sampling_period_s", "delay_samples"), picture)
    coulomb, quantum = loop.value("friction.coulomb") or 0.0, loop.sensor.quantum
    rows = published_rows(loop, answer.wall["damping"] or 0.0)
    document = {"device": known.name, "experiment": conditions.name, "hand": hand, **answer.document()}
    low, high = loop.delay_range
    document |= {"delay_samples": conditions.delay_samples, "delay_samples_low": low, "delay_samples_high": high}
    replaced = None if hand is None else known.loop_for(conditions).operator
    document["operator_replaced"] = None if replaced is None else replaced.model_dump()
    document["quantum"] = _quantum(coulomb / loop.force_gain, quantum, wanted)
    document["guidelines"] = guidelines(loop).document()
    document["reachable"] = asdict(reachable("settle_2pct", loop.delay_samples))
    document["published"] = [row | {"stiffness": None if isnan(row["stiffness"]) else row["stiffness"]} for row in rows]
    console.show(document, [*str(answer).splitlines(), *_design_lines(document, loop)])


def _held(device: Device, conditions: Any, hand: str | None) -> Loop:
    """Return the loop of a device, with the named arm attached, if any."""
    from dataclasses import replace

    from pipeline.device.parameters import is_rotation
    from pipeline.device.parts import Operator
    from pipeline.device_data.published import human_arms
    from pipeline.surface.physical_loop import Loop

    loop = Loop.of(device.loop_for(conditions))
    if hand is None:
        return loop
    arms = {arm.source.lower(): arm for arm in human_arms()}
    if hand.lower() not in arms:
        raise UsageError(f"--hand {hand}: expected one of {', '.join(arm.source for arm in human_arms())}.")
    if is_rotation(loop.motion):
        raise UsageError("--hand: the arms of Table 3.2 are in kg and N/m. Define an operator in the device file.")
    return replace(loop, operator=Operator(**arms[hand.lower()].model_dump(include={"mass", "damping", "stiffness"})))


def _quantum(coulomb: float, quantum: float, stiffness: float | None) -> JsonObject | None:
    """Return the largest stiffness without a limit cycle due to the sensor resolution, and the resolution required for
    K.

    ``coulomb`` is the Coulomb friction per unit of command.
    """
    from pipeline.theory.boundary import quantum_limit

    if not (coulomb > 0 and quantum > 0):
        return None
    needed = None if stiffness is None else 2 * coulomb / stiffness
    return {"stiffness": quantum_limit(coulomb, quantum), "quantum": quantum, "quantum_needed": needed}


def _design_lines(document: JsonObject, loop: Loop) -> Iterator[str]:
    """Yield the remaining lines of the answer: sensitivities, published limits, guidelines."""
    from pipeline.device.parameters import unit_of

    k, b = unit_of("stiffness", loop.motion), unit_of("damping", loop.motion)
    yield from ("", f"Largest stable K {document['sensitivities'][0]['stiffness_max']:.5g} {k}; sensitivities:")
    for row in document["sensitivities"]:
        yield f"  {row['quantity']}: {row['stiffness_max_percent']:+.3g} % per percent"
    yield from ("", f"Published limits of K [{k}] at B = {document['wall']['damping']:.4g} {b}:")
    limits = [row for row in document["published"] if row["stiffness"] is not None]
    yield from console.table(limits, ("stiffness", "promises", "condition", "assumes"))
    yield from ("", "Guidelines (Hulin 2017, 3.6), evaluated for this rig:")
    yield from (f"  {sentence}" for sentence in document["guidelines"]["sentences"])
    best = document["reachable"]
    yield (
        f"  With this delay, no wall settles (2 %) in less than about {best['cost']:.3g} samples; one sample less of "
        f"delay saves {best['per_sample']:.2g}. All delays and T must stay below 20 % of the required settling time."
    )
    if (low := document["delay_samples_low"]) < (high := document["delay_samples_high"]):
        yield f"Delay {document['delay_samples']:.4g} samples: mean of a delay that jitters from {low:g} to {high:g}."
    if document["left_out"]:
        yield f"Parts not included in linear theory: {', '.join(document['left_out'])}."
    if (operator := document["operator_replaced"]) is not None:
        yield f"The arm replaces the operator in the device file ({operator['mass']:g} kg)."
    if document["quantum"] is not None:
        limit = document["quantum"]["stiffness"]
        yield f"The sensor resolution causes no limit cycle up to K = 2 f_c/(g quantum) = {limit:.5g} {k}."


def plan(
    device: DeviceName,
    experiment: Annotated[
        str | None, option("--experiment", "Experiment (default: the only stored one).", "-e")
    ] = None,
    count: Annotated[int, option("--next", "Number of walls to recommend.", min=1)] = 1,
    goal: Annotated[str, option("--goal", "boundary, optimum, or a criterion.")] = "boundary",
    dampings: Annotated[list[str] | None, listed("--dampings", "Dampings B: 0,20,40 or '0,20,40 Ns/m'.")] = None,
    gentle: Annotated[bool, option("--gentle", "Prefer stable walls: approach each limit from below.")] = False,
    limit: Annotated[
        list[str] | None, listed("--limit", "Bound of the recommended walls.", metavar="KEY=VALUE")
    ] = None,
    processed: Processed = Path("processed"),
    watch: Annotated[
        list[Path] | None, option("--watch", "Folder where logs arrive.", exists=True, file_okay=False)
    ] = None,
    profile: ProfileFile = None,
) -> None:
    """Recommend which wall (K, B) to try next, and when to stop.

    The goal `optimum` is the best wall by settle_2pct. A limit on force excludes walls that are stiffer than a wall
    whose command exceeded the limit. A limit on travel excludes walls whose start is further from the centre than the
    limit.

    Example: pipeline plan --device falcon --experiment 1

    Example: pipeline plan --device falcon --experiment 1 --watch logs --gentle
    """
    from pipeline.planning.campaign import plan_options
    from pipeline.planning.planner import plan as plan_stored

    walls = _dampings(dampings or ())
    bounds = {}
    for word in limit or ():
        key, _, value = word.partition("=")
        if key not in LIMIT_QUANTITIES:
            raise UsageError(f"--limit {word}: expected KEY=VALUE, where KEY is one of {', '.join(LIMIT_QUANTITIES)}.")
        bounds[key] = _above("--limit", value, LIMIT_QUANTITIES[key], 1e-300)
    wish = plan_options(goal, count, walls, gentle, bounds)
    if not watch:
        with console.progress("plan"):
            answer = plan_stored(device, processed, experiment, wish, remembered=True)
        console.show(answer.model_dump(mode="json"), str(answer).splitlines())
        return
    from pipeline.shell.watch import plan_beside

    with suppress(Ended):
        for answer in plan_beside(watch, device, processed, experiment, wish, profile):
            console.show_line(answer.model_dump(mode="json"), str(answer).splitlines())


def _share(text: str) -> float:
    """Return the fraction of an overshoot from a number or a percentage.

    >>> _share("5 %"), _share("0.05")
    (0.05, 0.05)
    """
    percent = text.strip().endswith("%")
    try:
        return float(text.strip().rstrip("%")) / (100 if percent else 1)
    except ValueError as error:
        raise UsageError(f"--overshoot {text}: expected a number or a percentage, such as 0.05 or 5%.") from error


def _dampings(words: Sequence[str]) -> tuple[float, ...]:
    """Return dampings in SI. The unit of the last damping also applies to earlier ones without a unit."""
    from pipeline.base.units import split_quantity

    last = split_quantity(words[-1]) if words else None
    unit = last[1] if last else ""
    bare = [word if not unit or (split_quantity(word) or (0, unit))[1] else f"{word} {unit}" for word in words]
    return tuple(_above("--dampings", word, LIMIT_QUANTITIES["damping"], 0.0) for word in bare)


def _above(option: str, text: str, names: Sequence[str], least: float) -> float:
    value = quantity(option, text, *names)
    if not least <= value < inf:
        kind = "above 0" if least else "of 0 or more"
        raise UsageError(f"{option} {text}: expected a number {kind}.")
    return value

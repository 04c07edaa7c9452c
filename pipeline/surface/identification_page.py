"""Page on the identification of a device: evidence, parameters, tested parts, and predicted walls."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.base.json_object import JsonObject
from pipeline.base.wording import counted, listed, percent, power_of_ten, true_minus
from pipeline.device.parameters import PARAMETERS, Motion, is_rotation, unit_of
from pipeline.measured.identification.departures import CAUSES, SHARE, shares_between_groups
from pipeline.measured.identification.estimated import ESTIMATED
from pipeline.measured.identification.identified import Identification
from pipeline.measured.identification.part_table import PARTS, Decision
from pipeline.measured.identification.recordings import Recording
from pipeline.measured.identification.replay import TIME_CONSTANTS, Replay
from pipeline.records.trials import Booleans, Floats
from pipeline.rendering.figures.drawing import Figure, Panel, Series, around
from pipeline.rendering.figures.overview import thinned
from pipeline.rendering.labels import interval_texts, significant, unit_text
from pipeline.rendering.report.sectioned_page import Section, SectionedPage
from pipeline.rendering.table import Column, Table, table_of, word_table
from pipeline.surface.free_run_residuals import (
    COMMAND_BAND,
    GROUPS,
    Quartiles,
    Residuals,
    Spectra,
    command_band,
    shown_replays,
    spectra_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COMBINATIONS = {
    "acceleration": "acceleration due to the largest command, including friction and constant force",
    "damping_per_mass": "damping over mass",
    "stiffness_per_mass": "stiffness over mass",
    "friction_less_force": "friction minus the constant force in the direction of motion",
    "delay_and_lag": "sum of delay and actuator lag",
}
"""Descriptions of identifiable combinations of parameters that cannot be separated from each other."""

DECISIONS: dict[Decision, str] = {
    "accepted": "accepted",
    "undecided": "neither identified nor excluded: included as unknown",
    "imitated": "removed: a part that was accepted later explains the same motion",
    "no start": "rejected: at its best starting value, the gain is too small",
    "white noise": "rejected: with the measurement noise alone, the gain is too small",
    "random force": "rejected: with the random force of the device, the gain is too small",
    "size": "rejected: its size cannot be distinguished from zero",
    "gain": "rejected: the gain is too small",
    "left out": "rejected: the likelihood of left-out logs increases too little",
    "at a limit": "rejected: one of its parameters is at a limit of the search",
    "command noise": "rejected: the force limit would clip only the noise of the command",
    "free runs": "rejected: it does not sufficiently reduce the random force or the errors of free runs",
    "small errors": "rejected: free runs without it are as accurate as the readings",
    "no load": "rejected: the mass of its load cannot be identified",
}
"""Text for each decision on a part."""

GROUPINGS = {
    "direction": "direction of command and motion",
    "size": "size of the command",
    "place": "place",
    "time": "time",
}
"""Names of the groupings of `CAUSES`."""


FORCE = (
    "The device is identified from the measured force, and the drive from command and force. The gain, delay, "
    "lag and limit of the drive explain {} of the measured force."
)
"""Sentence on a drive that is identified from a measured force."""

BESIDE = 0.3
"""Distance between the bars for the two directions of motion, as a share of the width of a group."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Identification with its recordings, from which the figures of the page are drawn.

    ``simulated`` is True if any log is simulated.
    """

    identification: Identification
    recordings: Sequence[Recording]
    simulated: bool


def identification_page(document: JsonObject, evidence: Evidence) -> SectionedPage:
    """Return the page on an identification. ``document`` is the output of `pipeline identify --json`."""
    found, motion = evidence.identification, document["motion"]
    force = document["measured_force"]
    drive = () if force is None else (force["reason"] or FORCE.format(_percent(force["fit_percent"])),)
    input_label = f"command [{_unit('force', motion)}]"
    if force is not None and force["used"]:
        input_label = f"measured force [{_unit('force', 'rotation' if is_rotation(motion) else 'translation')}]"
    residuals = Residuals.of(found.replay)
    sections = [
        _runs(found, motion),
        _residual_section(residuals, found, motion, input_label),
        _spectrum(spectra_of(found.replay), command_band(evidence.recordings), motion),
        Section("parameters", "Parameters", drive, (), [_parameters(document, found), _combinations(document)]),
        _parts(found),
        _walls(document),
        _log_section(document),
    ]
    return SectionedPage(
        f"Identification from {counted(document['trials'], 'log')}",
        f"{document['rows']} rows, sampling period {document['sampling_period_s']:g} s, {_kind(motion)}.",
        list(_answers(document, found)),
        [*sentences_on_unused(document), *idle_sentences(document), *_warnings(document["findings"])],
        sections,
        evidence.simulated,
    )


def refusal_page(reason: str, logs: Mapping[str, int], document: JsonObject) -> SectionedPage:
    """Return the page on logs from which no device can be identified.

    Parameters
    ----------
    reason : str
        Reason and remedy, in sentences.
    logs : dict of str to int
        Number of rows of each log that was read.
    document : dict
        ``findings``, ``refused`` and ``copies`` of the logs, as in the document of an identification.
    """
    text = f"{reason[:1].upper()}{reason[1:].rstrip('.')}."
    rows = [(name, str(count)) for name, count in logs.items()]
    table = word_table("read", "Logs that were read", ("log", "rows"), rows)
    logs_section = _log_section(document)
    return SectionedPage(
        "No device identified",
        f"{counted(len(logs), 'log')}, {sum(logs.values())} rows.",
        [("Device", "It cannot be identified from these logs."), ("Reason", text)],
        (),  # the reason contains them
        [replace(logs_section, tables=[table, *logs_section.tables])],
    )


def _kind(motion: Motion) -> str:
    return "rotation" if is_rotation(motion) else "translation"


def _unit(dimension: Any, motion: Motion) -> str:
    return unit_text(unit_of(dimension, motion))


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _number(row: Mapping[str, Any]) -> str:
    """Return a number with its unit and interval."""
    value, low, high = interval_texts(row["value"], row["low"], row["high"])
    unit = f" {unit_text(row['unit'])}" if row["unit"] else ""
    return f"{value}{unit} ({low} to {high})"


def _answers(document: JsonObject, found: Identification) -> Sequence[tuple[str, str]]:
    """Return the answers at the top of the page."""
    known = [f"{row['name'].replace('_', ' ')} {_number(row)}" for row in document["parameters"] if row["told"]]
    unknown = [row["name"].replace("_", " ") for row in document["parameters"] if not row["told"]]
    missing = f"Not identified: {listed(unknown)}." if known and unknown else ""
    device = f"{'; '.join(known)}. {missing}" if known else "No parameter is identified."
    parts, undecided = (
        [name for name, gain in found.parts.items() if (gain > 0) is found_in] for found_in in (True, False)
    )
    unknown_parts = f" Neither identified nor excluded: {listed(undecided)}." if undecided else ""
    loop, replay = document["loop"], document["replay"]
    if replay["fit_percent"] is None:
        prediction = "No log could be replayed, so the device has not been tested."
    else:
        follows = "The device follows" if replay["follows"] else "No device with these parts follows"
        fit, naive = replay["fit_percent"], replay["naive_percent"]
        prediction = (
            f"{follows} the command: free runs fit {_percent(fit)} of the velocity of left-out logs (median), and a "
            f"motion without the command fits {_percent(naive)}."
        )
    limits = document["boundary"]
    walls = f"None is predicted: {loop['reason']}."
    if limits is not None:
        stiffest = limits["stiffness_max"] | {"unit": unit_of("stiffness", document["motion"])}
        walls = f"Stable up to K = {_number(stiffest)}."
    gravity = []
    if (weight := document["gravity"]) is not None:
        torque, angle = (_number(weight[name]) for name in ("torque", "angle"))
        gravity = [
            (
                "Gravity",
                f"The torque due to gravity is up to {torque}. The device would hang at rest at an angle of {angle}.",
            )
        ]
    return [
        ("Device", device.strip()),
        *gravity,
        ("Parts", f"{listed(['mass', 'damping', 'delay', *parts]).capitalize()}.{unknown_parts}"),
        ("Prediction", prediction),
        (
            "Errors",
            found.departure or "The errors do not depend significantly on direction, command, position or time.",
        ),
        ("Walls", walls),
    ]


def sentences_on_unused(document: JsonObject) -> list[str]:
    """Return a sentence for each reason why logs are not used, naming the first three logs."""
    reasons: dict[str, list[str]] = {}
    for each in document["logs_left_out"]:
        reasons.setdefault(each["reason"], []).append(each["log"])
    return [
        f"{counted(len(logs), 'log')} left out ({', '.join(logs[:3])}{', ...' if len(logs) > 3 else ''}): {reason}"
        for reason, logs in reasons.items()
    ]


def idle_sentences(document: JsonObject) -> list[str]:
    """Return a sentence on rows that were left out because the command does not act, or an empty list."""
    idle = document["idle_starts"]
    if not idle:
        return []
    first = f"{idle[0]['log']}, first {idle[0]['rows']} rows ({idle[0]['duration_s']:.3g} s)"
    where = first if len(idle) == 1 else f"{len(idle)} logs, such as {first}"
    return [
        (
            f"The command does not act at the start of {where}, because the drive was off or the device was blocked. "
            "These rows are left out."
        )
    ]


def _warnings(findings: Sequence[JsonObject]) -> list[str]:
    """Return one sentence for each kind of finding, with the first log and the number of logs."""
    kinds: dict[str, list[JsonObject]] = {}
    for each in findings:
        kinds.setdefault(each["code"], []).append(each)
    return [
        f"{some[0]['log'] if len(some) == 1 else f'{len(some)} logs, first ' + some[0]['log']}: {some[0]['sentence']}"
        for some in kinds.values()
    ]


def _line(pairs: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Return a line of few points through the windows of a log, with a gap after each window."""
    x = np.concatenate([np.append(x, x[-1:]) for x, _ in pairs])
    y = np.concatenate([np.append(y, np.full(len(y[-1:]), np.nan)) for _, y in pairs])
    return thinned(x, y)


def _runs(found: Identification, motion: Motion) -> Section:
    """Return the section with free runs of three logs, and the fit of each log."""
    shown, panels = shown_replays(found.replay), []
    for name, each in zip(_ranks(len(shown)), shown, strict=True):
        panels.append(_run(each, f"{name}, {_percent(each.fit_percent)}", motion))
    figures = []
    if panels:
        logs = listed([f"{each.log} ({name})" for name, each in zip(_ranks(len(shown)), shown, strict=True)])
        caption = (
            f"{logs}. The velocity is shown above, and the displacement since the start of the log below. Wide line: "
            f"measured; thin line: free run. Each free run covers about {TIME_CONSTANTS:g} time constants of the "
            "device, or the whole log, and begins from its estimated initial state."
        )
        figures = [Figure("response", "runs", "Measured motion and free runs", caption, tuple(panels))]
    rows = [
        {"log": each.log, "fit": _finite(each.fit_percent), "naive": _finite(each.naive_percent)}
        for each in found.replay
    ]
    why = "the readings hide the changes of the motion"
    columns = (
        Column("log"),
        Column("fit", "free run", "% of the velocity", show=lambda value, _: _percent(value)[:-2], why=why),
        Column("naive", "motion without the command", "%", show=lambda value, _: _percent(value)[:-2], why=why),
    )
    table = table_of("replay", "Fit of each log by a device that was fitted without this log", columns, rows, _log)
    text = (
        "Each log is predicted by a device that was fitted without this log. If there is only one log, its last part "
        "is predicted."
    )
    return Section("runs", "Free runs", (text if rows else "No log could be replayed.",), figures, (table,))


def _ranks(count: int) -> Sequence[str]:
    return {0: (), 1: ("only log",), 2: ("smallest fit", "largest fit")}.get(
        count, ("smallest fit", "median fit", "largest fit")
    )


def _percent(value: float) -> str:
    """Return a percentage with one decimal, and without the sign of a negative zero."""
    return true_minus(f"{round(value, 1) + 0.0:.1f} %")


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _log(row: Mapping[str, Any]) -> str:
    return str(row["log"])


def _run(each: Replay, title: str, motion: Motion) -> Panel:
    """Return the panel of a log: velocity above, displacement below."""
    moved, speeds = [], []
    for run in each.windows:
        measured, simulated = run.velocities(each.half)
        inside = run.time[each.half : each.half + len(measured)]
        speeds.append((inside, measured, simulated))
        moved.append((run.time, run.position, run.simulated))
    start = float(each.windows[0].position[0])
    is_small = max(float(np.abs(run.position - start).max()) for run in each.windows) < SMALL
    factor, prefix = (1e3, "m") if is_small else (1.0, "")
    moved = [(time, factor * (measured - start), factor * (simulated - start)) for time, measured, simulated in moved]
    names = f"velocity [{_unit('velocity', motion)}]", f"displacement [{prefix}{_unit('length', motion)}]"
    velocity, position = (
        (
            Series("measured", "wide log", *_line([(time, values) for time, values, _ in rows])),
            Series("free run", "free run", *_line([(time, values) for time, _, values in rows])),
        )
        for rows in (speeds, moved)
    )
    words = f"{each.log}: free runs fit {_percent(each.fit_percent)} of the velocity."
    plain = tuple(replace(series, label=f"_{series.label}") for series in position)
    below = Panel("", ("time [s]", names[1]), plain, words)
    return Panel(title, ("", names[0]), velocity, words, below=below)


SMALL = 0.5
"""Largest displacement [m, rad] that is drawn in mm or mrad, because the numbers are then shorter."""


def _grouped(name: str, residuals: Residuals, at: Floats, label: str, unit: str) -> Panel:
    """Return the panel of the residual over a quantity, by direction of motion."""
    ends = (float(at.min()), float(at.max()))
    series, words = [], []
    for number, (direction, inside) in enumerate(_directions(residuals).items()):
        groups = Quartiles.of(residuals.residual, at, ends if ends[0] < ends[1] else (ends[0], ends[0] + 1.0), inside)
        if not len(groups.centre):
            continue
        # the bars of the two directions are drawn next to each other
        centre = groups.centre + (number - 0.5) * BESIDE * (ends[1] - ends[0]) / GROUPS
        numbers = centre, groups.median, groups.low, groups.high
        series.append(Series(direction, "group", *numbers, number=number, along="y"))
        largest = groups.median[np.argmax(np.abs(groups.median))]
        words.append(f"{direction}, median up to {significant(float(largest), 2)} {unit}")
    limits = (None, around(*(end for each in series for end in (each.low, each.high) if end is not None)))
    text = f"Residual of the velocity by {name}: {'; '.join(words)}."
    return Panel(f"by {name}", (label, f"residual [{unit}]"), tuple(series), text, limits)


def _directions(residuals: Residuals) -> dict[str, Booleans]:
    return {"positive motion": residuals.velocity > 0, "negative motion": residuals.velocity < 0}


def _by_direction(residuals: Residuals, unit: str) -> Panel:
    """Return the panel of the residual by direction of motion and sign of the command."""
    commands = {"+": residuals.command > 0, "−": residuals.command < 0}
    motions = {"+": residuals.velocity > 0, "−": residuals.velocity < 0}
    places, numbers, ticks = list[float](), list[Floats](), list[str]()
    for motion, moving in motions.items():
        for sign, driven in commands.items():
            own = residuals.residual[moving & driven]
            if len(own):
                places.append(float(len(ticks)))
                numbers.append(np.percentile(own, (50, 25, 75)))
                ticks.append(f"{motion} {sign}")
    median, low, high = np.array(numbers, dtype=np.float64).reshape(-1, 3).T
    series = Series("_residual", "estimate", np.array(places), median, low, high, along="y")
    shown = "; ".join(
        f"{tick}: {significant(float(value), 2)} {unit}" for tick, value in zip(ticks, median, strict=True)
    )
    limits = (-0.5, len(ticks) - 0.5), around(low, high)
    text = f"Median residual by the signs of velocity and command: {shown}."
    names = "signs of velocity and command", f"residual [{unit}]"
    return Panel("by direction", names, (series,), text, limits, ticks=tuple(ticks))


def _residual_section(residuals: Residuals, found: Identification, motion: Motion, input_label: str) -> Section:
    """Return the section on the residuals of the velocity, and on the dependence of the prediction errors on other
    quantities."""
    shares = shares_between_groups(found.choice)
    rows = [
        {
            "grouping": GROUPINGS[name],
            "share": max(shares[name], 0.0),
            "result": CAUSES[name] if shares[name] > SHARE else "no dependence is reported",
        }
        for name in CAUSES
    ]
    columns = (
        Column("grouping", "errors grouped by"),
        Column("share", "share of their variance", show=lambda value, _: percent(value)),
        Column("result"),
    )
    caption = "One-step-ahead prediction errors: share of variance between groups"
    table = table_of("shares", caption, columns, rows, lambda row: str(row["grouping"]))
    sentences = [
        "The residual is the measured velocity minus the velocity of the free runs, for all replayed logs.",
        (
            f"Prediction errors are reported to depend on a quantity if at least {percent(SHARE)} of their variance is "
            "between the groups of this quantity."
        ),
    ]
    if not len(residuals.residual):
        return Section("residuals", "Residuals", ("No log could be replayed.", sentences[1]), (), (table,))
    unit = _unit("velocity", motion)
    panels = (
        _grouped("place", residuals, residuals.position, f"position [{_unit('length', motion)}]", unit),
        _by_direction(residuals, unit),
        _grouped(input_label.partition(" [")[0], residuals, residuals.command, input_label, unit),
        _grouped("time", residuals, residuals.time, "time since the start of the log [s]", unit),
    )
    words = (
        f"Markers: median of the residual in each of {GROUPS} groups; bars: from the first to the third quartile. If "
        "the model is complete, all medians are near zero."
    )
    figure = Figure("residuals", "residuals", "Residual of the velocity", words, panels, size=(440.0, 270.0))
    return Section("residuals", "Residuals", sentences, (figure,), (table,))


def _spectrum(spectra: Spectra | None, band: tuple[float, float] | None, motion: Motion) -> Section:
    """Return the section on the spectrum of the residual, and the band in which the command has power."""
    share = percent(COMMAND_BAND[1] - COMMAND_BAND[0])
    command = "No command changes within a log, so the command has no band."
    if band is not None:
        ends = f"{significant(band[0], 3)} to {significant(band[1], 3)} Hz"
        command = f"The middle {share} of the power of the command is between {ends}."
    if spectra is None:
        return Section("spectrum", "Spectrum", ("The free runs are too short for a spectrum.", command))
    x, unit = spectra.frequency, _unit("velocity", motion)
    series = [
        Series("measured velocity", "log", x, spectra.velocity),
        Series("residual of the free runs", "straight", x, spectra.residual),
    ]
    if band is not None:
        strip = np.clip(band, x[0], x[-1])
        series.append(Series(f"middle {share} of the power of the command", "span", strip, np.zeros(2)))
    names = "frequency [Hz]", f"power density [({unit})²/Hz]"
    inside = np.ones(len(x), dtype=bool)
    if band is not None:
        inside = (spectra.frequency >= band[0]) & (spectra.frequency <= band[1])
    left = float(spectra.residual[inside].sum() / spectra.velocity[inside].sum()) if inside.any() else np.nan
    where = "in the band of the command" if band is not None else "at all frequencies"
    words = f"The residual has {percent(left, 1)} of the power of the velocity {where}."
    if not np.isfinite(left):
        words = "The band of the command is narrower than the distance between two frequencies of the spectrum."
    caption = (
        "Mean spectra of all logs, with the free runs of each log joined. Where the residual is far below the "
        "velocity, the identified device explains the motion. Where both are equal, it explains nothing. Smoothing of "
        "the velocity reduces both at high frequencies."
    )
    panel = Panel("", names, tuple(series), words, paint=_on_logarithmic_axes)
    figure = Figure("response", "spectrum", "Spectra of velocity and residual", caption, (panel,))
    return Section("spectrum", "Spectrum", (command, words), (figure,))


def _on_logarithmic_axes(axes: Axes) -> None:
    """Scale both axes logarithmically. Label frequencies [Hz] with plain numbers, and the other axis with powers of
    ten."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_major_formatter(lambda value, _: power_of_ten(round(math.log10(value))))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter("")


def _method(name: str, document: JsonObject, found: Identification) -> str:
    """Return the method by which a parameter is identified."""
    force = document["measured_force"]
    is_apart = force is not None and force["used"] and force["reason"] is None
    if name == "force_gain" or (is_apart and name in ("actuator_lag_s", "force_limit")):
        return "output error of the measured force, with a jackknife over blocks of rows"
    if is_apart and name == "delay_samples":
        return "output error of the measured force, and likelihood of the motion"
    if name == "damping" and found.quasi_static:
        return "displacements over windows of eight rows, with a jackknife over blocks of windows"
    free = "free runs through all reversals" if found.choice.segments.free else "predictions one row ahead"
    more = ""
    if name == "delay_samples" and "actuator_lag_s" in found.choice.bounds:
        more = f"; with a lag of up to {significant(found.choice.bounds['actuator_lag_s'], 2)} s"
    if found.drive and name in ("mass", "damping", "stiffness"):
        more = "; the interval covers all gains of the drive"
    return f"likelihood of {free}{more}"


def _parameters(document: JsonObject, found: Identification) -> Table | None:
    """Return the table of the parameters, each with its method or the reason why it is not identified."""
    rows = []
    keys = {ESTIMATED[name].key: name for name in found.parameters} | {"inertia": "mass"}
    for row in document["parameters"]:
        name = keys.get(row["name"], row["name"])
        texts = interval_texts(row["value"], row["low"], row["high"]) if row["told"] else (None, None, None)
        shown = dict(zip(("value", "low", "high"), texts, strict=True))
        label = "inertia" if row["name"] == "inertia" else PARAMETERS[name].label
        about = {
            "label": label,
            "unit": unit_text(row["unit"]),
            "method": _method(name, document, found) if row["told"] else None,
        }
        rows.append(shown | about | {"name": row["name"], "reason": _sentence(row["reason"] or "not identifiable")})
    columns = (
        Column("label", "parameter"),
        Column("value", show=_as_is),
        Column("low", "from", group="95 % interval", show=_as_is),
        Column("high", "to", group="95 % interval", show=_as_is),
        Column("unit", why="a ratio"),
        Column("method"),
    )
    table = table_of("parameters", "Parameters with 95 % intervals", columns, rows, lambda row: str(row["name"]))
    if table is not None:
        table.notes.append(
            "The half width of an interval is Student's t times the largest of three standard errors: from the "
            "information of the rows, from the differences between logs, and from the differences between phases of "
            "the motion."
        )
        if not document["scatter_in_interval"]:
            table.notes.append("The intervals do not include the scatter between runs, which needs at least 8 logs.")
    return table


def _as_is(value: Any, _: Mapping[str, Any]) -> str:
    return str(value)


def _combinations(document: JsonObject) -> Table | None:
    """Return the table of the identifiable combinations of parameters that cannot be separated."""
    rows = [
        (
            COMBINATIONS[each["combination"]],
            _number(each),
            ", ".join(name.replace("_", " ") for name in each["members"]),
            each["record"],
        )
        for each in document["not_told_apart"]
    ]
    heads = ("combination", "value, 95 % interval", "parameters that cannot be separated", "record in addition")
    return word_table("combinations", "Identifiable combinations", heads, rows)


def _parts(found: Identification) -> Section:
    """Return the section on the tested parts."""
    tried = found.choice.tried
    rows = []
    for name in dict.fromkeys(("friction", "stiffness", *PARTS, *tried)):
        test = tried.get(name)
        decision = DECISIONS[test.decision] if test is not None else _untried(name, found)
        if test is not None and test.decision == "accepted" and not found.parts.get(name):
            decision = "accepted by the search, but undecided, because the device does not predict the logs"
        numbers = {} if test is None else {"gain": _finite(test.gain), "required": test.required}
        why = "not tested" if test is None else "the test ended before a fit with this part"
        rows.append({"part": name, "decision": decision, "reason": why} | numbers)
    columns = (
        Column("part"),
        Column("gain", "gain of ln L", show=lambda value, _: significant(value, 3)),
        Column("required", show=lambda value, _: significant(value, 3)),
        Column("decision"),
    )
    table = table_of("parts", "Tested parts", columns, rows, lambda row: str(row["part"]))
    text = (
        "A part is accepted only if it passes all steps of its test. The gain of the log-likelihood is that of the "
        "last step. For an accepted part of the drive, a lag or a mode, this is the gain for left-out logs."
    )
    return Section("parts", "Parts", (text,), (), (table,))


def _untried(name: str, found: Identification) -> str:
    """Return the reason why a part was not tested."""
    numbers = found.choice.fit.device.numbers
    if name == "friction":
        return "not tested: the direction of motion is known in too few rows"
    if "delay" not in numbers:
        return "not tested: the delay cannot be identified, because the command does not change"
    needs = PARTS[name].needs if name in PARTS else ""
    if needs and needs not in found.parts:
        return f"not tested: it requires a {needs}"
    return "not tested: an accepted part has the same parameter"


def _walls(document: JsonObject) -> Section:
    """Return the section on the walls that the device renders, or on the reason why no limit is predicted."""
    limits, motion = document["boundary"], document["motion"]
    if limits is None:
        return Section("walls", "Predicted walls", (f"No limit of walls is predicted: {document['loop']['reason']}.",))
    K, B = (_unit(dimension, motion) for dimension in ("stiffness", "damping"))
    top = limits["stiffness_max"]
    rows = (
        f"Walls with T = {limits['sampling_period_s']:g} s and a delay of {limits['delay_samples']:.4g} samples. "
        f"Stable up to K = {_number(top | {'unit': unit_of('stiffness', motion)})} at "
        f"B = {significant(limits['damping_at_stiffness_max'], 4)} {B}."
    )
    included = f"Not included in linear theory: {listed(document['left_out'])}." if document["left_out"] else ""
    stiffness, damping = (np.array(limits[name], dtype=np.float64) for name in ("stiffness", "damping"))
    at = np.array([top["value"]]), np.array([limits["damping_at_stiffness_max"]])
    series = (
        Series("limit of stable walls", "line", stiffness, damping),
        Series("largest stiffness, 95 % interval", "estimate", *at, np.array([top["low"]]), np.array([top["high"]])),
    )
    panel = Panel("", (f"stiffness K [{K}]", f"damping B [{B}]"), series, rows)
    caption = "Walls to the left of the line are stable. The limit is that of the linear loop, without friction."
    figure = Figure("boundaries", "walls", "Predicted limit of stable walls", caption, (panel,))
    sentences = [rows, *filter(None, (included, document["velocity_filter"]))]
    return Section("walls", "Predicted walls", sentences, (figure,))


def _log_section(document: JsonObject) -> Section:
    """Return the section on faults of the recordings, rejected files and copies."""
    findings = word_table(
        "findings",
        "Faults of the recordings",
        ("log", "code", "fault"),
        [(each["log"], each["code"], each["sentence"]) for each in document["findings"]],
    )
    refused = word_table(
        "refused", "Rejected files", ("file", "reason"), [(row["path"], row["reason"]) for row in document["refused"]]
    )
    rows = [(each["log"], str(each["rows"]), f"{each['duration_s']:.3g}") for each in document.get("idle_starts", ())]
    idle = word_table("idle", "Rows left out because the command does not act", ("log", "first rows", "time [s]"), rows)
    copies = word_table(
        "copies", "Logs with the same samples as another log", ("log",), [(n,) for n in document["copies"]]
    )
    faults = "No fault was found in the recordings." if findings is None else ""
    return Section("logs", "Logs", tuple(filter(None, (faults,))), (), (idle, findings, refused, copies))

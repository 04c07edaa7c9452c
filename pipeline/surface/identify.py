"""Identification of a device from logs, for `pipeline.identify` and `pipeline identify`.

The module reads logs, estimates parameters with intervals, computes the limit of stable walls and writes a device file.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from pipeline.base.disk import write_text
from pipeline.base.errors import LogError, ParameterError, UsageError
from pipeline.base.paths import check_output
from pipeline.base.progress import part_of_work
from pipeline.base.wording import counted
from pipeline.comparison.loops.loop_basis import filter_of_numbers, filter_quantities
from pipeline.device.loop import Loop as LoopRecord
from pipeline.device.parameters import PARAMETERS, UNITS, Motion, is_rotation, unit_of
from pipeline.device.parts import Mode
from pipeline.device_data.devices import known_devices
from pipeline.intake.sources import Source, find_sources, load_source, motion_of, requested_profiles
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.measured.identification.estimated import ESTIMATED
from pipeline.measured.identification.force_driven import identified_by_force
from pipeline.measured.identification.identified import Identification, identified
from pipeline.measured.identification.idle_start import IdleStart, identified_while_driven
from pipeline.measured.identification.intervals import Interval
from pipeline.measured.identification.measured_drive import MeasuredDrive, unknown_drive
from pipeline.measured.identification.recordings import SHORTEST, Recording
from pipeline.measured.identification.replay import follows
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.measured.stages.stage_device import unusable_trials, usable_recordings
from pipeline.measured.student import NORMAL_95
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log, RawLog, reader_of
from pipeline.recording.signals import same_samples
from pipeline.records.findings import are_unsafe
from pipeline.records.trials import Trial
from pipeline.rendering.frames import frame_of
from pipeline.rendering.report.sectioned_page import SectionedPage, render
from pipeline.simulation.simulate import applied_delay_moments, delays_of
from pipeline.surface.identification_page import Evidence, identification_page, refusal_page
from pipeline.surface.wall_filter import WallFilter, wall_filter
from pipeline.theory.boundary import outline

if TYPE_CHECKING:
    import pandas as pd

    from pipeline.surface.logs import PathLike
    from pipeline.surface.physical_loop import Loop

DRIFT = "free runs drift because no wall corrects their errors; `pipeline compare` replays the logs with their walls"
"""Remark in a document whose free runs come from logs of walls, because a drift reduces their fit."""

TOO_SHORT = f"The log has fewer than {SHORTEST} usable rows."
"""Reason for not using a log that has no other fault."""

SHIFTED = (
    "in each log, the command is shifted by rows relative to the position, or the sampling period is wrong, so that "
    "neither delay nor limits can be estimated. `pipeline compare` lists the finding for each log. Correct the "
    "recording, and record the logs again"
)
"""Message if logs of walls are all rejected, because no device can be identified from them."""

WITHOUT_WALL = {"device": "device", "experiment": "1", "stiffness": "0", "damping": "0", "step": "0"}
"""Header entries that a native log without a wall may omit, with their default values."""


@dataclass(frozen=True, eq=False)
class IdentifiedDevice:
    """A device identified from logs.

    ``estimates``: ``name``, ``value``, ``low``, ``high``, ``unit``, ``told`` (True if the parameter is identifiable
    from the logs alone). ``replay``: ``log``, ``fit_percent``, ``naive_percent``. ``loop``: the linear loop as `Loop`,
    or None if mass or delay cannot be identified. ``document``: output of `pipeline identify --json`.
    ``evidence``: data of the page.
    """

    document: dict[str, Any]
    evidence: Evidence = field(repr=False)

    def __str__(self) -> str:
        """Return a table of the parameters with their intervals, including the parameters that are not identifiable."""
        return str(self.estimates.to_string(index=False, na_rep="–"))

    @property
    def estimates(self) -> pd.DataFrame:
        """Parameters with their 95 % intervals."""
        rows = self.document["parameters"]
        return frame_of("name value low high unit told", rows, {row["name"]: row["unit"] for row in rows})

    @property
    def replay(self) -> pd.DataFrame:
        """Fit [%] of free runs to the velocity of logs. Each log is left out of the estimation of the device that
        predicts this log.

        ``naive_percent`` is the fit of a motion that ignores the command.
        """
        return frame_of("log fit_percent naive_percent", self.document["replay"]["logs"], {})

    @property
    def findings(self) -> pd.DataFrame:
        """Faults of the recordings, each with kind, location, evidence and remedy."""
        return frame_of("log code severity first_row rows evidence remedy", self.document["findings"], {})

    @cached_property
    def loop(self) -> Loop | None:
        """The linear loop of the device, without friction."""
        from pipeline.surface.physical_loop import Loop

        loop = wall_loop(self.document)
        return None if loop is None else Loop.of(loop)

    def write(self, path: PathLike) -> None:
        """Write a device file , which theory, simulator and planner can read.

        Raises
        ------
        ParameterError
            If mass or delay cannot be identified.
        """
        write_text(Path(path), device_text(self.document, Path(path).stem))

    def write_report(self, path: PathLike) -> Path:
        """Write a page on the identification, and return its path.

        The page compares the measured motion with free runs, and shows residuals, parameters, tested parts, and walls.
        An existing page is replaced.

        Raises
        ------
        UsageError
            If the path does not end in .html, or is a folder.
        PipelineError
            If the file cannot be written.
        """
        check_report(Path(path), "")
        return _write_page(identification_page(self.document, self.evidence), Path(path))


class WallSampling(NamedTuple):
    """Sampling period [s] and delay [samples] of the walls that a device would render.

    A value of None is replaced by that of the logs.
    """

    period: float | None = None
    delay: float | None = None


OF_LOGS = WallSampling()
"""Period and delay of the logs."""


def identify(
    paths: PathLike | Sequence[PathLike],
    profile: PathLike | None = None,
    *,
    period: float | None = None,
    delay: float | None = None,
    report: PathLike | None = None,
) -> IdentifiedDevice:
    """Identify a device from logs with command and position. Neither a wall nor a phase at rest is needed.

    Parameters
    ----------
    paths : path, or sequence of them
        Logs, and folders that are searched recursively.
    profile : str or path, optional
        As for `ingest`.
    period : float, optional
        Sampling period T [s] of the wall that the device would render. The default is the period of the logs.
    delay : float, optional
        Delay of that wall [samples of T]. The default is the delay estimated from the logs.
    report : path, optional
        Page (.html) to write, as by `IdentifiedDevice.write_report`. If no device can be identified, the page states
        the reason.

    Raises
    ------
    LogError
        If all logs are rejected. The message names the path and the row. If only some logs are rejected, the document
        lists them.
    ParameterError
        If the logs have no motion, no command or too few rows, a value is out of range, or most logs were recorded
        incorrectly.
    UsageError
        If a path does not exist, or no log is found.
    """
    places = [paths] if isinstance(paths, (str, os.PathLike)) else list(paths)
    given = profile if profile is None or isinstance(profile, str) else Path(profile)
    reading = Reading([Path(path) for path in places], given)
    return identified_device(reading, WallSampling(period, delay), None if report is None else Path(report))


@dataclass(frozen=True)
class Reading:
    """Logs to read.

    Parameters
    ----------
    paths : sequence of Path
    profile : str, Path or Profile, optional
    ignore : sequence of str
        Patterns of names of files that are not logs.
    advance : callable, optional
        Function that receives the number of files read and their total number. The last call has None as total.
    """

    paths: Sequence[Path]
    profile: str | Path | Profile | None = None
    ignore: Sequence[str] = ()
    advance: Callable[[int, int | None], None] | None = None


def identified_device(reading: Reading, wall: WallSampling = OF_LOGS, report: Path | None = None) -> IdentifiedDevice:
    """Return the device identified from logs, and write the page ``report`` if it is given. Errors as in `identify`."""
    if report is not None:
        check_report(report, "")
    read = _read(reading)
    try:
        result = _identified(read, wall)
    except ParameterError as error:
        if report is not None:
            logs = {name: len(log.time) for name, log in read.logs}
            _write_page(refusal_page(str(error), logs, read.document), report)
        raise
    if report is not None:
        result.write_report(report)
    return result


def check_report(path: Path, option: str) -> None:
    """Check that a page can be written. The name must end in .html, so that no log or device file is replaced.

    Raises
    ------
    UsageError
        If the path does not end in .html, or is a folder.
    PipelineError
        If no file can be created in the folder.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{option} {path}: expected a name that ends with .html.".strip())
    check_output(path, option)


def _write_page(page: SectionedPage, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, render(page))
    return path


def _identified(read_logs: _Read, wall: WallSampling) -> IdentifiedDevice:
    """Return the device identified from logs that were read."""
    read = read_logs.logs
    known = {name: device.motion for name, device in known_devices().items()}
    motions = {motion_of(log, known) for _, log in read}
    if len(motions) > 1:
        raise ParameterError("some logs record a translation, others a rotation. Select the logs of only one device.")
    check_findings(read)
    faulty = {name: each.sentence for name, log in read for each in log.findings if each.leaves_out}
    trials = [measured_trial(name, log) for name, log in read if name not in faulty]
    recordings = usable_recordings(trials)
    unused = dict.fromkeys(dict(read).keys() - {each.name for each in recordings}, TOO_SHORT)
    unused |= faulty | unusable_trials(trials)
    if motions == {"rotation"} and not any(any(each.wall) for each in recordings):
        # gravity is estimated only for free motion, because an arm at a wall hardly moves
        recordings = [replace(each, turns=True) for each in recordings]
    if not recordings:
        raise ParameterError(SHIFTED)
    recordings = with_forces(recordings, read)
    try:
        with part_of_work("fit", 0.1, 0.95):
            found = _device_of(recordings)
    except ParameterError as error:
        findings = _first_findings(read)
        reason = f"{str(error).rstrip('.')}." if findings else str(error)
        raise ParameterError(" ".join([reason, *findings])) from error
    document = _document(found, recordings, motions.pop(), wall_filter(trials), wall)
    document["logs_left_out"] = [{"log": name, "reason": reason} for name, reason in sorted(unused.items())]
    simulated = any(log.header.simulated for _, log in read)
    return IdentifiedDevice(document | read_logs.document, Evidence(found.device, recordings, simulated))


def with_forces(recordings: list[Recording], read: Sequence[tuple[str, Log]]) -> list[Recording]:
    """Return recordings with the measured forces of their logs. The forces are used only if each log has one."""
    logs = dict(read)
    found = []
    for each in recordings:
        log = logs[each.name]
        if log.force is None:
            return recordings
        first = int(np.searchsorted(log.time, each.time[0]))
        found.append(replace(each, force=log.force[first : first + len(each.time)]))
    return found


class _Found(NamedTuple):
    """Identified device, the same device per unit of the command, and details of the identification.

    Parameters
    ----------
    device, by_command : Identification
    drive : MeasuredDrive or None
        Drive, if a force is measured.
    by_force : bool
        True if the device is identified from this force.
    idle : list of IdleStart
        Rows at the start of logs that were left out because the command does not act.
    """

    device: Identification
    by_command: Identification
    drive: MeasuredDrive | None = None
    by_force: bool = False
    idle: Sequence[IdleStart] = ()


def _device_of(recordings: list[Recording]) -> _Found:
    """Return the device of recordings. With a measured force that explains the motion, device and drive are identified
    separately.

    A force sensor may also measure a different force, such as that of a hand. The device is then identified from the
    command.
    """
    if any(each.force is None for each in recordings):
        found, idle = identified_while_driven(recordings)
        return _Found(found, found, idle=idle)
    try:
        apart = identified_by_force(recordings)
    except ParameterError as error:
        drive = unknown_drive(f"No device can be identified from the measured force: {error}")
    else:
        device, drive = apart.device, apart.drive
        if follows(device.fit_percent, device.naive_percent):
            by_command = identified(recordings) if drive.reason else apart.by_command
            return _Found(device, by_command, drive, by_force=True)
        why = "The measured force does not explain the motion, so the device is identified from the command."
        drive = replace(drive, reason=why)
    found, idle = identified_while_driven(recordings)
    return _Found(found, found, drive, idle=idle)


def _unparted(profile: Profile) -> Profile:
    """Return a copy of the profile that reads a staircase as a single motion, because its separate steps would share
    rows."""
    return profile.model_copy(update={"kind": "free"}) if profile.kind == "staircase" else profile


class _Read(NamedTuple):
    """Logs that were read, with their names. Duplicates of earlier logs, which are not counted. Rejected files."""

    logs: list[tuple[str, Log]]
    copies: list[tuple[str, Log]]
    refused: list[dict[str, Any]]

    @property
    def document(self) -> dict[str, Any]:
        """Entries of the document on the recordings: ``findings``, ``refused`` and ``copies``."""
        rows = [{"log": name, **each.document} for name, log in (*self.logs, *self.copies) for each in log.findings]
        return {"findings": rows, "refused": self.refused, "copies": [name for name, _ in self.copies]}


def _read(reading: Reading) -> _Read:
    """Read all logs.

    Raises
    ------
    LogError
        If all sources are rejected. The first error of a source that matches a profile has priority.
    UsageError
        If no log is found.
    """
    asked = requested_profiles(reading.profile, reading.paths)
    profiles = tuple(map(_unparted, asked.profiles))
    sources = find_sources(reading.paths, profiles, ignore=(*reading.ignore, *asked.ignore))
    advance = reading.advance
    read: list[tuple[str, Log]] = []
    copies: list[tuple[str, Log]] = []
    errors: list[tuple[Source, LogError]] = []
    seen: dict[str, str] = {}
    for number, source in enumerate(sources):
        if advance is not None:
            advance(number, len(sources))
        try:
            logs = _logs(source)
        except LogError as error:
            errors.append((source, error))
            continue
        for log in logs:
            name = source.shown if log.label is None else f"{source.shown}: {log.label}"
            other = seen.setdefault(log.samples_sha256, name)
            if other == name:
                read.append((name, log))
            else:
                copies.append((name, replace(log, noted=(*log.noted, same_samples(len(log.time), other)))))
    if advance is not None:
        advance(len(sources), None)
    if errors and not read:
        source, why = next((pair for pair in errors if pair[1].code != "no-profile"), errors[0])
        raise why if source.shown in why.reason else why.reworded(f"{source.shown}: {why.reason}")
    if not read:
        names = ", ".join(map(str, reading.paths))
        raise UsageError(f"{names}: no log found. Name log files, or folders that contain logs.")
    refused = [{"path": source.shown, "reason": error.reason, "row": error.row} for source, error in errors]
    return _Read(read, copies, refused)


def _first_findings(read: Sequence[tuple[str, Log]]) -> list[str]:
    """Return the first finding of each kind, with its log."""
    found: dict[str, str] = {}
    for name, log in read:
        for each in log.findings:
            found.setdefault(each.code, f"{name}: {each.sentence}")
    return list(found.values())


def measured_trial(name: str, log: Log) -> MeasuredTrial:
    """Return a log as a trial with the given name. Nothing is stored."""
    header = log.header
    declared = header.extra.get("step_row")
    return MeasuredTrial(
        Trial(
            *(name, header.stiffness, header.damping, header.step, header.sampling_period_s),
            *(log.time, log.command, log.position),
            step_row=None if declared is None else int(declared),
            integrated=header.extra.get("integrated") == "trapezoid",
        )
    )


def check_findings(read: Sequence[tuple[str, Log]]) -> None:
    """Raise an error if most logs were recorded incorrectly, or if none can be used.

    Raises
    ------
    ParameterError
        If most recordings are faulty, so that neither delay nor limits can be estimated from them.
    """
    unsafe = [(name, each) for name, log in read for each in log.findings if each.is_unsafe]
    names = {name for name, _ in unsafe}
    if are_unsafe([log.findings for _, log in read]):
        name, first = unsafe[0]
        others = f" ({len(names)} of {counted(len(read), 'log')} are faulty.)" if len(read) > 1 else ""
        raise ParameterError(f"{name}: {first.sentence}{others}")
    if all(any(each.leaves_out for each in log.findings) for _, log in read):
        name, log = read[0]
        finding = next(each for each in log.findings if each.leaves_out)
        others = f" (The same applies to all {len(read)} logs.)" if len(read) > 1 else ""
        raise ParameterError(f"{name}: {finding.sentence}{others}")


def _logs(source: Source) -> tuple[Log, ...]:
    """Return the logs of a source. A native log need not state a wall."""
    raw, _, _ = load_source(source)
    assert source.profile is not None, "a source that no profile claims is refused by load_source"
    whole = _completed(raw) if source.profile.format == "native" else raw
    (outcome,) = reader_of(source.profile)(source.profile, [whole])
    if isinstance(outcome, LogError):
        added = whole.data[0].count(b"\n") - raw.data[0].count(b"\n")
        row = None if outcome.row is None else max(outcome.row - added, 1)
        place = source.shown if row is None else f"{source.shown}, row {row}"
        raise LogError(f"{place}: {outcome.reason}", row, code=outcome.code, profile_line=outcome.profile_line)
    return outcome


def _completed(raw: RawLog) -> RawLog:
    """Return the bytes of a native log, completed by default values of the conditions that a log without a wall may
    omit."""
    text = raw.data[0]
    head = [
        line for line in text[:20_000].decode("utf-8", "replace").splitlines() if line.lstrip("\ufeff").startswith("#")
    ]
    named = {line.lstrip("\ufeff# ").split(":")[0].strip() for line in head}
    more = {key: value for key, value in WITHOUT_WALL.items() if key not in named}
    if "sampling_period_s" not in named:
        more["sampling_period_s"] = repr(_period(text))
    # The lines are appended to the header, so that row numbers in messages about the header match the file.
    lines = "".join(f"# {key}: {value}\n" for key, value in more.items()).encode()
    start = text.find(b"time_s")
    return replace(raw, data=(text[:start] + lines + text[start:],)) if more and start >= 0 else raw


def _period(text: bytes) -> float:
    """Return the median time between the first rows of a log [s].

    Unreadable times are left out. With fewer than two times, the result is 1, and the reader then refuses the log with
    the row.
    """
    rows = [line.split(b",")[0] for line in text[:200_000].splitlines() if line[:1].isdigit() or line[:1] in b"-+."]
    times = []
    for cell in rows[:2000]:
        with suppress(ValueError):
            times.append(float(cell))
    steps = np.diff(times)
    period = float(np.median(steps)) if len(steps) else 1.0
    return float(f"{period:.9g}") if 0 < period < np.inf else 1.0


def _document(
    apart: _Found, recordings: list[Recording], motion: Motion, velocity: WallFilter | None, wall: WallSampling
) -> dict[str, Any]:
    """Return the document of an identification, without its entries on the recordings.

    ``motion`` is that of the command. A device that is identified from a measured force has the units of a force.
    """
    found = apart.device
    of_device: Motion = ("rotation" if is_rotation(motion) else "translation") if apart.by_force else motion
    own, period, delay = found.units.period, wall.period, wall.delay
    wall_period, walls = own if period is None else period, velocity is not None
    velocity = velocity.at(own, wall_period) if velocity else None
    loop = _loop_document(apart, DRIFT if walls else "", velocity)
    present = {
        "velocity": velocity is not None and velocity.left_out,
        "friction": loop["friction"] is not None and loop["friction"]["value"] > 0,
        "jitter": _jitters(loop),
        "gravity": bool(found.gravity),
    }
    document: dict[str, Any] = {
        "motion": motion,
        "trials": len(found.names),
        "rows": int(sum(len(each.time) for each in recordings)),
        "sampling_period_s": own,
        "source": sorted({each.name for each in recordings}),
        "parameters": [
            *(
                _parameter_document(found, name, motion if name == "force_limit" else of_device)
                for name in found.parameters
            ),
            *_gain_rows(apart.drive, motion),
        ],
        "parts": [{"name": name, "found": gain > 0, "gain": float(gain)} for name, gain in found.parts.items()],
        "assumed_none": [ESTIMATED[name].key for name in found.assumed],
        "unseen_lag_s": found.choice.bounds.get("actuator_lag_s", 0.0),
        "not_told_apart": [
            {
                "combination": each.code,
                "members": [ESTIMATED[name].key for name in each.members],
                **_numbers(each.interval, True),
                "unit": unit_of(each.unit, of_device) if each.unit in UNITS else each.unit,
                "record": each.record,
            }
            for each in found.combinations
        ],
        "drive": _with_units(found.drive, {"asymmetry": "", "curvature": ""}, _unit("mass", of_device)),
        "gravity": _with_units(found.gravity, {"angle": "rad"}, _unit("friction.coulomb", of_device)),
        "idle_starts": [asdict(each) for each in apart.idle],
        "measured_force": None if apart.drive is None else _force_document(apart.drive, apart.by_force),
        "scatter": {
            ESTIMATED[name].key: {"value": value * _factor(name, own), "unit": _unit(name, of_device)}
            for name, value in found.scatter.items()
        },
        "scatter_in_interval": bool(found.scatter),
        "noise": found.noise,
        "disturbance": found.disturbance,
        "replay": _replay_document(found) | {"behind_walls": walls},
        "loop": loop,
        "velocity_filter": velocity.sentence if velocity else None,
        "left_out": [name for name, is_present in present.items() if is_present],
    }
    drawn = _drawn_delays(loop) if wall_period == own and delay is None else ()
    document["wall"] = {"sampling_period_s": wall_period, "delay_samples": delay, "jitter_samples": list(drawn)}
    document["boundary"] = _boundary(document) if loop["adequate"] else None
    return document


def _parameter_document(found: Identification, name: str, motion: Motion) -> dict[str, Any]:
    is_identified = name not in found.unidentifiable
    return {
        "name": "inertia" if name == "mass" and is_rotation(motion) else ESTIMATED[name].key,
        **_numbers(_scaled(found.parameters[name], _factor(name, found.units.period)), is_identified),
        "unit": _unit(name, motion),
        "told": is_identified,
        "reason": found.reasons.get(name),
    }


def _gain_rows(drive: MeasuredDrive | None, motion: Motion) -> list[dict[str, Any]]:
    """Return the row of the force per unit of the command, if a force is measured."""
    if drive is None:
        return []
    force, command = UNITS["force"][is_rotation(motion)], unit_of("force", motion)
    numbers, unit = _numbers(drive.gain, not drive.reason), "" if force == command else f"{force}/{command}"
    about = {"unit": unit, "told": not drive.reason, "reason": drive.reason or None}
    return [{"name": "force_gain", **numbers, **about}]


def _force_document(drive: MeasuredDrive, is_used: bool) -> dict[str, Any]:
    """Return the entry of the document on a measured force: whether the device is identified from the force, the fit of
    the drive, and the reason if the drive is not identified."""
    fit = drive.fit_percent
    return {"used": is_used, "fit_percent": fit if np.isfinite(fit) else None, "reason": drive.reason or None}


def _factor(name: str, period: float) -> float:
    """Return the factor from the unit of a parameter to its unit in the document, where a delay is in seconds."""
    return period if name == "delay_samples" else 1.0


def _unit(name: str, motion: Motion) -> str:
    return "s" if name == "delay_samples" else PARAMETERS[name].unit(motion)


def _scaled(interval: Interval, factor: float) -> Interval:
    return Interval(*(factor * each for each in astuple(interval)))


def _numbers(interval: Interval, is_identified: bool) -> dict[str, float | None]:
    values = {"value": interval.value, "low": interval.low, "high": interval.high}
    return {name: value if is_identified and np.isfinite(value) else None for name, value in values.items()}


def _replay_document(found: Identification) -> dict[str, Any]:
    logs = [
        {
            "log": each.log,
            "fit_percent": None if np.isnan(each.fit_percent) else each.fit_percent,
            "naive_percent": None if np.isnan(each.naive_percent) else each.naive_percent,
        }
        for each in found.replay
    ]
    fit, naive = found.fit_percent, found.naive_percent
    return {"fit_percent": fit, "naive_percent": naive, "follows": follows(fit, naive), "logs": logs}


def _with_units(numbers: Mapping[str, Interval], units: dict[str, str], other: str) -> dict[str, Any] | None:
    """Return intervals with their units (``other`` if ``units`` has none), or None if there are no intervals."""
    return {name: {**_numbers(each, True), "unit": units.get(name, other)} for name, each in numbers.items()} or None


def _jitters(loop: dict[str, Any]) -> bool:
    """Return True if the delay of a loop jitters significantly."""
    return loop["jitter_samples"] is not None and loop["jitter_samples"]["low"] > 0


def _drawn_delays(loop: dict[str, Any]) -> tuple[int, ...]:
    """Return integer delays for which the applied command has the delay and the jitter of a loop, within their errors.

    The result is empty if the delay does not jitter.
    """
    delay, jitter = loop["delay_samples"], loop["jitter_samples"]
    if delay is None or not _jitters(loop):
        return ()
    drawn = delays_of(delay["value"], jitter["value"])
    if not drawn:
        return ()
    ages = zip((delay, jitter), applied_delay_moments(drawn), strict=True)
    return drawn if all(number["low"] <= age <= number["high"] for number, age in ages) else ()


def _loop_document(apart: _Found, drift: str, velocity: WallFilter | None) -> dict[str, Any]:
    """Return the loop in the format of `compare --json`, with the reason why free runs may drift.

    The numbers of the loop are per unit of the command, as a wall sees the device.
    """
    found = apart.by_command
    known = {name: each for name, each in found.parameters.items() if name not in found.unidentifiable}

    def number(name: str) -> dict[str, float] | None:
        if name not in known:
            return None
        return {"value": known[name].value, "low": known[name].low, "high": known[name].high}

    fit, naive, is_known = found.fit_percent, found.naive_percent, {"mass", "delay_samples"} <= known.keys()
    mode = {PARAMETERS[name].key: number(name) for name in ("mode.frequency_hz", "mode.damping_ratio", "mode.mass")}
    at_load = dict.fromkeys(("value", "low", "high"), float("mode at the load" in found.parts))
    of_load = {"load_damping": load} if (load := number("mode.load_damping")) else {}
    filtered = filter_quantities(velocity.velocity, velocity.of_logs) if velocity and velocity.velocity else {}
    noise = found.choice.fit.device.noise
    low, high = (max(noise.jitter + sign * NORMAL_95 * noise.jitter_error, 0.0) for sign in (-1, 1))
    return {
        "source": "estimated",
        "adequate": is_known and follows(fit, naive) and not (found.drive or found.departure),
        "reason": (
            "no log could be replayed"
            if fit is None
            else f"free runs fit {fit:.1f} % of the velocity of left-out logs (without the command {naive:.1f} %)"
        )
        + ("" if is_known else "; mass or delay cannot be identified from these logs")
        + ("; the gain of the drive differs by direction" if "asymmetry" in found.drive else "")
        + ("; the gain of the drive differs by size of the command" if "curvature" in found.drive else "")
        + (f"; {found.departure[:1].lower()}{found.departure[1:].rstrip('.')}" if found.departure else "")
        + (f"; {drift}" if drift else ""),
        "explained": None,
        **{name: number(name) for name in LINEAR},
        "jitter_samples": {"value": noise.jitter, "low": low, "high": high} if noise.jitter > 0 else None,
        "velocity": {name: quantity.model_dump() for name, quantity in filtered.items()} or None,
        "mode": {**mode, **of_load, "sensor_at_load": at_load} if all(mode.values()) else None,
        "operator": None,
        "friction": number("friction.coulomb"),
    }


def wall_loop(document: dict[str, Any], **other: float) -> LoopRecord | None:
    """Return the linear loop of a document for the wall that it would render.

    ``other`` replaces numbers of the document, with keys from `LINEAR`. The result is None if the mass or the delay is
    unknown.
    """
    loop, wall = document["loop"], document["wall"]
    value = {name: loop[name]["value"] if loop[name] else None for name in LINEAR} | other
    samples, late = wall["delay_samples"], value["delay_samples"]
    if samples is None and late is not None:
        samples = late * document["sampling_period_s"] / wall["sampling_period_s"]
    if value["mass"] is None or value["mass"] <= 0 or samples is None:
        return None
    drawn = wall["jitter_samples"]
    if drawn:
        # A device file states the mean of the drawn delays. The delay of the applied command is smaller, because later
        # commands overtake earlier ones.
        samples += sum(drawn) / len(drawn) - loop["delay_samples"]["value"]
    damping, stiffness, lag = (max(value[name] or 0.0, 0.0) for name in ("damping", "stiffness", "actuator_lag_s"))
    velocity = {name: number["value"] for name, number in (loop["velocity"] or {}).items()}
    mode = None
    if loop["mode"]:
        numbers = {name: number["value"] for name, number in loop["mode"].items()}
        sensor: Literal["motor", "load"] = "load" if numbers.pop("sensor_at_load") else "motor"
        # Both values are estimates. The load cannot have more damping than the complete device.
        mode = Mode(**numbers | {"load_damping": min(numbers.get("load_damping", 0.0), damping)}, sensor=sensor)
    return LoopRecord(
        value["mass"],
        damping,
        wall["sampling_period_s"],
        max(samples, 0.0),
        stiffness,
        motion=document["motion"],
        velocity=filter_of_numbers(velocity) if velocity else None,
        actuator_lag_s=lag,
        mode=mode,
        jitter_samples=tuple(drawn),
    )


LINEAR = ("mass", "damping", "stiffness", "delay_samples", "actuator_lag_s")
"""Names of the parameters of a linear loop in a document, except those of the vibration mode."""


def _border(loop: LoopRecord, points: int) -> dict[str, Any]:
    """Return the limit of stable walls of a linear loop, in SI."""
    found, units = outline(NormalisedLoop.of(loop), points), LoopUnits.of(loop)
    if not len(found.beta):
        return {"stiffness_max": 0.0, "damping_at_stiffness_max": 0.0, "stiffness": [], "damping": []}
    return {
        "stiffness_max": float(found.alpha_max * units.stiffness),
        "damping_at_stiffness_max": float(found.beta_at_alpha_max * units.damping),
        "stiffness": (found.alpha * units.stiffness).tolist(),
        "damping": (found.beta * units.damping).tolist(),
    }


def _boundary(document: dict[str, Any]) -> dict[str, Any] | None:
    """Return the limit of the walls that the device would render, with the stiffest wall and its interval."""
    loop = wall_loop(document)
    if loop is None:
        return None
    border = _border(loop, 100)
    stiffest, reach = border["stiffness_max"], 0.0
    for name in LINEAR:
        part = document["loop"][name]
        if part is None or (name == "delay_samples" and document["wall"]["delay_samples"] is not None):
            continue
        ends = [wall_loop(document, **{name: part[end]}) for end in ("low", "high")]
        if name == "delay_samples" and (lag := document["unseen_lag_s"]):
            # The actuator lag is not part of the delay.
            late = part["value"] - lag / document["sampling_period_s"]
            ends = [wall_loop(document, delay_samples=late, actuator_lag_s=lag), ends[1]]
        limits = [_border(each, 40)["stiffness_max"] for each in ends if each is not None]
        reach += max((abs(limit - stiffest) for limit in limits), default=0.0) ** 2
    return border | {
        "sampling_period_s": loop.sampling_period_s,
        "delay_samples": loop.delay_samples,
        "stiffness_max": {"value": stiffest, "low": max(stiffest - reach**0.5, 0.0), "high": stiffest + reach**0.5},
    }


def device_text(document: dict[str, Any], name: str) -> str:
    """Return a document as a device file in TOML. Intervals are written as comments.

    Raises
    ------
    ParameterError
        If mass or delay cannot be identified.
    """
    numbers, wall, motion = document["loop"], document["wall"], document["motion"]
    loop = wall_loop(document)
    if loop is None:
        missing = "mass" if numbers["mass"] is None else "delay"
        why = f"no device file can be written: the {missing} cannot be identified from these logs."
        raise ParameterError(" ".join([why, *_remedies(document)]))

    def line(key: str) -> str:
        number = numbers[key]
        if number is None:
            return f"{key} = 0.0  # not identifiable from the logs"
        ends = f"{number['low']:.6g} to {number['high']:.6g} {PARAMETERS[key].unit(motion)}"
        return f"{key} = {number['value']!r}  # {ends} (95 %)"

    delay, about_delay = numbers["delay_samples"], "stated by the user, or not identifiable from the logs"
    if delay is not None and wall["delay_samples"] is None:
        about_delay = f"at T = {document['sampling_period_s']:g} s: {delay['low']:.6g} to {delay['high']:.6g} (95 %)"
        about_delay = (
            f"mean of jitter_samples; delay of the applied command {about_delay}"
            if loop.jitter_samples
            else about_delay
        )
    lines = [
        f"# Identified from {document['trials']} logs, {document['rows']} rows. {numbers['reason']}.",
        *([f"# {document['velocity_filter']}"] if document["velocity_filter"] else []),
        *_gain_lines(document),
        *(f"# {path}" for path in document["source"][:20]),
        f'name = "{name}"',
        f'source = "identified from {document["trials"]} logs"',
        f'motion = "{motion}"',
        line("mass"),
        line("damping"),
        *([line("stiffness")] if numbers["stiffness"] else []),
        f"sampling_period_s = {loop.sampling_period_s!r}",
        f"delay_samples = {loop.delay_samples!r}  # {about_delay}",
        *_jitter_lines(document, loop),
        *_gravity_lines(document),
        f"sensor = {{ noise = {document['noise']!r} }}",
    ]
    parts = []
    if loop.velocity:
        entries = ", ".join(f"{key} = {_toml(value)}" for key, value in loop.velocity)
        parts.append(f"velocity = {{ {entries} }}")
    parts += [line("actuator_lag_s")] if numbers["actuator_lag_s"] else []
    if (friction := numbers["friction"]) and friction["value"] > 0:
        ends = f"{friction['low']:.6g} to {friction['high']:.6g}"
        parts.append(f"friction = {{ coulomb = {friction['value']!r} }}  # {ends}")
    if loop.mode:
        entries = ", ".join(f"{key} = {value!r}" for key, value in loop.mode)
        known = ((key, number) for key, number in numbers["mode"].items() if key in Mode.model_fields)
        ranges = ", ".join(f"{key} {number['low']:.4g} to {number['high']:.4g}" for key, number in known)
        parts.append(f"mode = {{ {entries} }}  # {ranges}")
    return "\n".join([*lines, *(["", "[loop]", *parts] if parts else []), ""])


def _gain_lines(document: dict[str, Any]) -> list[str]:
    """Return the line of a device file on the gain of the drive, if it is identified from a measured force."""
    rows = (row for row in document["parameters"] if row["name"] == "force_gain" and row["told"])
    return [
        "# All numbers are per unit of the command. Force per unit of the command, from the measured force: "
        f"{row['low']:.6g} to {row['high']:.6g} {row['unit']} (95 %)".replace("  ", " ")
        for row in rows
    ]


def _jitter_lines(document: dict[str, Any], loop: LoopRecord) -> list[str]:
    """Return the lines of a device file that describe the jitter of the delay, if there is any."""
    if "jitter" not in document["left_out"]:
        return []
    jitter = document["loop"]["jitter_samples"]
    about = (
        f"standard deviation of the delay of the applied command {jitter['low']:.4g} to {jitter['high']:.4g} samples "
        "(95 %)"
    )
    if loop.jitter_samples:
        return [f"jitter_samples = {list(loop.jitter_samples)}  # {about}"]
    return [f"# The delay jitters, {about}. Omitted: no set of integer delays reproduces this jitter."]


def _gravity_lines(document: dict[str, Any]) -> list[str]:
    """Return comment lines of a device file on gravity, because the loop of a device file does not include gravity."""
    if (gravity := document["gravity"]) is None:
        return []
    torque, angle = (gravity[name]["value"] for name in ("torque", "angle"))
    return [f"# Omitted: gravity of {torque:.4g} sin(q - {angle:.4g}) Nm, with the recorded angle q in rad."]


def _toml(value: str | float | tuple[float, ...]) -> str:
    """Return a value of a velocity filter as TOML."""
    return f'"{value}"' if isinstance(value, str) else repr(list(value) if isinstance(value, tuple) else value)


def _remedies(document: dict[str, Any]) -> list[str]:
    """Return recommendations for further recordings, one sentence each."""
    sentences = [f"Record {each['record']}." for each in document["not_told_apart"]]
    if document["loop"]["delay_samples"] is None:
        wanted = "a change of the command within a log"
        if "delay" not in document["assumed_none"]:  # there are some
            wanted = (
                "larger steps, or use a finer sensor, because noise, resolution or friction hide the start of the "
                "motion"
            )
        sentences.append(f"To identify the delay, record {wanted}. Alternatively, state it with --delay.")
    return list(dict.fromkeys(sentences))

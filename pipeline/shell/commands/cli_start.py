"""Command `start`, which makes a report from a folder of logs.

It asks only the questions that the data do not answer.
"""

from __future__ import annotations

import json
import shlex
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, LogError, UsageError
from pipeline.base.json_object import JsonObject
from pipeline.base.paths import check_output
from pipeline.base.wording import counted
from pipeline.shell import console
from pipeline.shell.commands.cli_storage import refusals, warnings_of
from pipeline.shell.commands.options import Store, reports_folder
from pipeline.shell.console import argument, option

if TYPE_CHECKING:
    from pipeline.profiles.profile_model import Profile
    from pipeline.shell.profile.roles import Answer
    from pipeline.shell.start import Folder, Proposal

TABLES = (
    *("trials", "trial_column", "kind", "columns", "name_pattern", "sheet", "attributes", "condition_columns", "units"),
    *("step_at", "constants", "decimal"),
)
"""Keys of a proposal in the order of display."""

LONGEST_VALUE = 40
"""Largest number of displayed characters of a value. A pattern may be longer."""

Yes = Annotated[bool, option("--yes", "Ask no questions, and use only settings that the data prove.", "-y")]


def start(
    path: Annotated[Path, argument("Folder with logs.", exists=True)],
    yes: Yes = False,
    processed: Store = "processed",
    open_report: Annotated[bool, option("--open/--no-open", "Open the report in a browser.")] = True,
    store_only: Annotated[bool, option("--store-only", "Store the logs without comparing or identifying.")] = False,
) -> int:
    """Make a report from a folder of logs, and print the commands.

    The command shows the contents of the folder and a picture of a log, proposes the meaning of each column with the
    evidence, and asks open questions (Enter accepts the proposal). Then it stores the logs, compares walls with theory
    or identifies the device, and opens the report. With --yes, or without a terminal, it asks no questions. If any are
    open, it lists them and ends.

    Example: pipeline start logs

    Example: pipeline start logs --yes
    """
    asks = not yes and console.is_answered()
    from pipeline.shell.start import look_at

    folder = look_at(path)
    for line in console.table(folder.rows(), ("kind", "files", "first", "endings")):
        console.step(line)
    if folder.native:
        console.step("The logs are native: they state their columns and conditions.")
        reading = Reading()
    else:
        reading = _reading_of(folder, asks, opens=asks and open_report)
    return _run(folder, reading, processed, opens=asks and open_report, compares=not store_only)


@dataclass(frozen=True)
class Reading:
    """Settings for reading the logs of a folder: the profile and its file (None for native logs), and the names of
    omitted files."""

    profile: Profile | None = None
    file: Path | None = None
    ignored: tuple[str, ...] = ()

    @property
    def options(self) -> str:
        """Command-line options that read the logs in the same way."""
        profile = [] if self.file is None else ["--profile", str(self.file)]
        words = [*profile, *(word for name in self.ignored for word in ("--ignore", name))]
        return "".join(f" {shlex.quote(word)}" for word in words)


def _reading_of(folder: Folder, asks: bool, *, opens: bool) -> Reading:
    """Return the settings for reading the logs of a folder, after asking the user. Write the profile."""
    from pipeline.base.disk import write_text
    from pipeline.profiles.profile_text import profile_toml
    from pipeline.shell.start import made_profile, propose, with_units

    proposal = propose(folder)
    for line in _proposal_lines(proposal, asks):
        console.step(line)
    if proposal.open:
        if not asks:
            listed = "\n".join(f"  {place}: {answer.question}" for place, answer in proposal.open.items())
            command = f"pipeline start {shlex.quote(str(folder.path))}"
            raise UsageError(
                f"{counted(len(proposal.open), 'open question')}:\n{listed}\nAnswer them in a terminal ({command}), or "
                "name the columns with their units: `pipeline ingest --help`."
            )
        _draw(folder.logs[0], None, opens)
        # The units of numbers in names and sheets follow from the units of the columns. Wrong units are detected below.
        of_columns = _asked({place: each for place, each in proposal.open.items() if place.startswith("columns.")})
        again = propose(with_units(proposal, of_columns)).answered(of_columns)
        # A wrong unit raises new questions. These are not asked, because the wrong unit is refused below with a remedy.
        settled = again if again.open.keys() <= proposal.open.keys() else proposal.answered(of_columns)
        proposal = settled.answered(_asked(settled.open))
    profile, ignored = _agreeing(made_profile(proposal), folder, asks)
    target = _free_name(profile.name)
    evidence = [f"{place}: {answer.evidence}" for place, answer in proposal.answers.items() if answer.evidence]
    write_text(target, profile_toml(profile, evidence))
    console.step(f"profile: {target}")
    _draw(folder.logs[0], profile, opens=False)
    return Reading(profile, target, ignored)


def _draw(log: Path, profile: Profile | None, opens: bool) -> None:
    """Draw a log, as recorded or in SI. A refused log is not drawn, because it is reported later, when logs are
    stored."""
    from pipeline.surface.log_picture import look

    picture = Path("look.html")
    check_output(picture, "")
    with suppress(LogError):
        look(log, profile).write(picture)
        console.step(f"picture of the first log, {'as recorded' if profile is None else 'in SI'}: {picture}")
        if opens:
            _open(picture)


def _open(page: Path) -> None:
    """Open a page in a browser."""
    import webbrowser

    webbrowser.open(page.resolve().as_uri())


def _agreeing(profile: Profile, folder: Folder, asks: bool) -> tuple[Profile, tuple[str, ...]]:
    """Return a profile that agrees with the commands of the logs, and patterns that match the omitted logs.

    Raises
    ------
    UsageError
        If so many logs contradict the profile that the profile must be wrong.
    """
    from pipeline.readers.gain_check import common_remedy
    from pipeline.shell.profile.conditions import MOST_AT_FAULT
    from pipeline.shell.start import contradictions, corrected

    off, looked = contradictions(profile, folder.logs)
    if len(off) > MOST_AT_FAULT * looked:
        counts = f"{len(off)} of {counted(looked, 'log')} faulty"
        raise UsageError(f"{off[0].path}: {common_remedy(off[0].reason)} ({counts}). Correct the answer or the sheet.")
    if not off:
        return profile, ()
    console.step("")
    for each in off:
        console.step(f"warning: {each.path}: {each.reason}.")
    known = [each for each in off if each.followed]
    if asks and known:
        logs = counted(len(known), "log")
        if typer.confirm(
            f"{logs} with a wrong number. Store the gains that the command follows? If not, the logs are omitted",
            err=True,
        ):
            profile = corrected(profile, known)
            off = [each for each in off if not each.followed]
    left = tuple(escape(each.path.name) for each in off)
    if left:
        console.step(f"omitted: {counted(len(left), 'log')}. Correct the errors above, and start again.")
    return profile, left


def _free_name(name: str) -> Path:
    """Return an unused file name for a profile."""
    numbers = ("", *(f"-{number}" for number in range(2, 1000)))
    return next(path for number in numbers if not (path := Path(f"{name}{number}.toml")).exists())


def _proposal_lines(proposal: Proposal, asks: bool) -> Iterator[str]:
    """Yield lines with the known keys and their evidence, then with the number of open questions."""
    rows = []
    for place, answer in sorted(proposal.answers.items(), key=lambda item: TABLES.index(item[0].partition(".")[0])):
        if not answer.question:
            value = json.dumps(answer.value, ensure_ascii=False)
            shown = value if len(value) <= LONGEST_VALUE else f"{value[: LONGEST_VALUE - 3]}..."
            rows.append({"key": place, "value": shown, "shown by": answer.evidence})
    yield from ("", *console.table(rows, ("key", "value", "shown by")), "")
    folder = proposal.folder
    if folder.other_layout:
        opened = len(folder.samples) + len(folder.other_layout)
        yield (
            f"warning: {len(folder.other_layout)} of {counted(opened, 'inspected log')} have a different layout, the "
            f"first of them {folder.other_layout[0]}. Only logs like {folder.samples[0].name} will be stored. Move the "
            "logs of each layout (columns, delimiter, decimal sign, encoding) to a separate folder, and run `pipeline "
            "start` on each folder. Folders with the same name, such as a/bench and b/bench, belong to the same "
            "device."
        )
        yield ""
    if proposal.open and asks:
        yield f"{counted(len(proposal.open), 'open question')}. Enter accepts the proposal in brackets."


def _asked(questions: Mapping[str, Answer]) -> dict[str, Any]:
    """Ask the user, and return the answers, keyed by the place in the profile."""
    return {place: _ask(place, question.question, question.value) for place, question in questions.items()}


def _ask(place: str, question: str, proposed: Any) -> Any:
    """Ask the user, and return the answer. An answer in TOML is parsed, and any other answer is returned as text."""
    text = typer.prompt(f"{place}: {question}", default=str(proposed), err=True)
    if isinstance(proposed, str):
        return text.strip()
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        return text.strip()


def _run(folder: Folder, reading: Reading, processed: str, *, opens: bool, compares: bool) -> int:
    """Store the logs of a folder, compare or identify, open the report, and print the commands that repeat this."""
    from pipeline.comparison.compare import run, write_report
    from pipeline.comparison.plan import ComparisonSelection, ReportOptions, plan_comparison
    from pipeline.intake.ingest import ingest
    from pipeline.store.names import report_of
    from pipeline.store.objects import opened, stored_by
    from pipeline.surface.identify import Reading, identified_device

    place, read, profile = shlex.quote(str(folder.path)), reading.options, reading.profile
    with console.progress("ingest", "logs") as advance:
        report = stored_by(
            processed,
            lambda store: ingest([folder.path], store, profile, progress=advance, ignore=reading.ignored),
        )
    found = report.model_dump(mode="json")
    for line in (*refusals(found["quarantined"]), *warnings_of(found)):
        console.step(line)
    console.step(f"stored: {report.ingested} new logs, {report.skipped} known, {len(report.quarantined)} refused")
    commands = [f"pipeline ingest {place}{read}"]
    names = _stored_devices(processed, report.ingested + report.skipped)
    status = EXIT_QUARANTINED if report.quarantined or reading.ignored else EXIT_OK
    device = profile.constants.device if profile is not None else next(iter(names), None)
    if device is None or not report.ingested + report.skipped:
        console.show({"commands": commands, "stored": found}, commands)
        return EXIT_ERROR
    document: JsonObject = {"device": device, "profile": reading.file and str(reading.file), "ingest": found}
    lines: list[str] = []
    if compares and _has_walls(processed, device):
        target = report_of(reports_folder(), device)
        check_output(target, "", document_beside=True)
        with console.progress("compare"), opened(processed, device) as store:
            finished = run(plan_comparison(ComparisonSelection(device, store), ReportOptions(target)))
            write_report(finished)
        commands.append(f"pipeline compare --device {shlex.quote(device)}")
        lines = [*finished.document.summary, *(f"Warning: {text}" for text in finished.document.warnings)]
        document["report"] = str(target)
        lines.append(f"report: {target}")
        if opens:
            _open(target)
    elif compares:
        from pipeline.shell.commands.cli_device import identified_lines

        target = Path(f"{device}-device.toml")
        with console.progress("identify", "logs") as advance:
            logs = Reading([folder.path], profile, reading.ignored, advance)
            identified = identified_device(logs).document
        lines = list(identified_lines(identified))
        commands.append(f"pipeline identify {place}{read} --out {shlex.quote(str(target))}")
        document["identified"] = identified
    if reading.ignored:
        lines.insert(0, f"Warning: {counted(len(reading.ignored), 'log')} omitted: {', '.join(reading.ignored)}")
    document |= {"commands": commands, "left_out": list(reading.ignored)}
    console.show(
        document, [*lines, "", "To repeat these steps without questions:", *(f"  {line}" for line in commands)]
    )
    return status


def _stored_devices(processed: str, count: int) -> list[str]:
    from pipeline.store.objects import opened
    from pipeline.store.storage import list_devices

    if not count:
        return []
    with opened(processed) as store:
        return list_devices(store)


def _has_walls(processed: str, device: str) -> bool:
    """Return True if a device has trials with a wall."""
    from pipeline.store.objects import opened
    from pipeline.store.storage import read_trials

    with opened(processed, device) as store:
        trials = read_trials(store, device, columns=["stiffness", "damping"])
    return any(value for name in ("stiffness", "damping") for value in trials.column(name).to_pylist())

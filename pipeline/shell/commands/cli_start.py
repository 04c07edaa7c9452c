"""`pipeline start`: from a folder to a report, with a question only where the data do not prove the answer."""

from __future__ import annotations

import json
import shlex
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, LogError, UsageError
from pipeline.base.paths import check_output
from pipeline.base.wording import counted
from pipeline.shell import console
from pipeline.shell.commands.cli_storage import refusals, warnings_of
from pipeline.shell.commands.options import Store, reports_folder
from pipeline.shell.console import argument, option

if TYPE_CHECKING:
    from pipeline.profiles.profile_model import Profile
    from pipeline.shell.start import Folder, Proposal

TABLES = ("kind", "columns", "name_pattern", "sheet", "units", "step_at", "attributes", "constants", "decimal")
"""Keys of a proposal in the order in which they are shown."""

LONGEST_VALUE = 40
"""Characters of a value that are shown; a pattern has more."""

Yes = Annotated[bool, option("--yes", "Ask nothing: take what the data prove.", "-y")]


def start(
    path: Annotated[Path, argument("Folder with logs.", exists=True)],
    yes: Yes = False,
    processed: Store = "processed",
    open_report: Annotated[bool, option("--open/--no-open", "Open the report in a browser.")] = True,
    store_only: Annotated[bool, option("--store-only", "Store the logs, and neither compare nor identify.")] = False,
) -> int:
    """Lead from a folder of logs to a report, and print the commands.

    Shows what the folder holds, proposes what each column is, with the evidence, and asks what is open (Enter accepts);
    then stores the logs, compares walls with theory or identifies the device, and opens the report. With --yes, or
    without a terminal, nothing is asked: where something is open, it is listed, and nothing is done.

    Example: pipeline start logs

    Example: pipeline start logs --yes
    """
    asks = not yes and console.is_answered()
    from pipeline.shell.start import look_at

    folder = look_at(path)
    for line in console.table(folder.rows(), ("kind", "files", "first", "endings")):
        console.step(line)
    profile_file = None
    if folder.native:
        console.step("The logs are native: they bring columns and conditions themselves.")
        profile = None
    else:
        profile, profile_file = _profile_of(folder, asks)
    return _run(folder, profile, profile_file, processed, (asks and open_report, store_only))


def _profile_of(folder: Folder, asks: bool) -> tuple[Profile, Path]:
    """Return the profile of a folder, and the file that it was written to."""
    from pipeline.base.disk import write_text
    from pipeline.profiles.profile_text import profile_toml
    from pipeline.shell.profile.check import look, page
    from pipeline.shell.start import faults, made_profile, propose

    proposal = propose(folder)
    for line in _proposal_lines(proposal):
        console.step(line)
    if proposal.open:
        if not asks:
            listed = "\n".join(f"  {place}: {answer.question}" for place, answer in proposal.open.items())
            command = f"pipeline start {shlex.quote(str(folder.path))}"
            raise UsageError(
                f"{counted(len(proposal.open), 'question')} open:\n{listed}\nAnswer them in a terminal ({command}), or "
                "name the columns with their units: `pipeline ingest --help`."
            )
        answers = {place: _ask(place, answer.question, answer.value) for place, answer in proposal.open.items()}
        proposal = proposal.answered(answers)
    profile = made_profile(proposal)
    target = _free_name(profile.name)
    _, off = faults(profile, folder.logs)
    if off:
        raise UsageError(f"{off[0]} ({counted(len(off), 'log')} at fault). Correct the answer, or the sheet.")
    evidence = [f"{place}: {answer.evidence}" for place, answer in proposal.answers.items() if answer.evidence]
    write_text(target, profile_toml(profile, evidence))
    console.step(f"profile: {target}")
    picture = Path("look.html")
    check_output(picture, "")
    with suppress(LogError):  # it is refused with its reason where it is stored
        write_text(picture, page(look(folder.logs[0], profile)))
        console.step(f"picture of the first log: {picture}")
    return profile, target


def _free_name(name: str) -> Path:
    """Return a name for a profile that no file has."""
    numbers = ("", *(f"-{number}" for number in range(2, 1000)))
    return next(path for number in numbers if not (path := Path(f"{name}{number}.toml")).exists())


def _proposal_lines(proposal: Proposal) -> Iterator[str]:
    """Yield the keys that are known with their evidence, then the number of questions."""
    rows = []
    for place, answer in sorted(proposal.answers.items(), key=lambda item: TABLES.index(item[0].partition(".")[0])):
        if not answer.question:
            value = json.dumps(answer.value, ensure_ascii=False)
            shown = value if len(value) <= LONGEST_VALUE else f"{value[: LONGEST_VALUE - 3]}..."
            rows.append({"key": place, "value": shown, "shown by": answer.evidence})
    yield from ("", *console.table(rows, ("key", "value", "shown by")), "")
    if proposal.open:
        yield f"{counted(len(proposal.open), 'question')} open; Enter accepts the proposal in brackets."


def _ask(place: str, question: str, proposed: Any) -> Any:
    """Return the answer to a question: as TOML where it is, else as text."""
    text = typer.prompt(f"{place}: {question}", default=str(proposed), err=True)
    if isinstance(proposed, str):
        return text.strip()
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        return text.strip()


def _run(folder: Folder, profile: Profile | None, file: Path | None, processed: str, how: tuple[bool, bool]) -> int:
    """Store the logs of a folder, compare or identify, and say how to repeat it.

    ``how`` says whether to open the report, and whether to store alone.
    """
    from pipeline.comparison.compare import compare
    from pipeline.intake.ingest import ingest
    from pipeline.store.names import report_of
    from pipeline.store.objects import opened, stored_by
    from pipeline.surface.identify import identified_device

    opens, only_store = how
    place = shlex.quote(str(folder.path))
    read = "" if file is None else f" --profile {shlex.quote(str(file))}"
    with console.progress("ingest", "logs") as advance:
        report = stored_by(processed, lambda store: ingest([folder.path], store, profile, progress=advance))
    found = report.model_dump(mode="json")
    for line in (*refusals(found["quarantined"]), *warnings_of(found)):
        console.step(line)
    console.step(f"stored: {report.ingested} new logs, {report.skipped} known, {len(report.quarantined)} refused")
    commands = [f"pipeline ingest {place}{read}"]
    names = _stored_devices(processed, report.ingested + report.skipped)
    status = EXIT_QUARANTINED if report.quarantined else EXIT_OK
    device = profile.constants.device if profile is not None else next(iter(names), None)
    if device is None or not report.ingested + report.skipped:
        console.tell({"commands": commands, "stored": found}, commands)
        return EXIT_ERROR
    document: dict[str, Any] = {"device": device, "profile": file and str(file), "ingest": found}
    lines: list[str] = []
    if only_store:
        pass
    elif _has_walls(processed, device):
        target = report_of(reports_folder(), device)
        check_output(target, "", document_beside=True)
        with console.progress("compare"), opened(processed, device) as store:
            outcome = compare(device, store, report=target)
        commands.append(f"pipeline compare --device {shlex.quote(device)}")
        if outcome.result is not None:
            lines = [*outcome.result.summary, *(f"Warning: {text}" for text in outcome.result.warnings)]
        document["report"] = str(outcome.report)
        lines.append(f"report: {outcome.report}")
        if opens and outcome.report is not None:
            import webbrowser

            webbrowser.open(Path(outcome.report).resolve().as_uri())
    else:
        from pipeline.shell.commands.cli_device import identified_lines

        target = Path(f"{device}-device.toml")
        with console.progress("identify", "logs") as advance:
            identified = identified_device([folder.path], profile, advance=advance)
        lines = list(identified_lines(identified))
        commands.append(f"pipeline identify {place}{read} --out {shlex.quote(str(target))}")
        document["identified"] = identified
    document["commands"] = commands
    console.tell(document, [*lines, "", "To repeat it without questions:", *(f"  {line}" for line in commands)])
    return status


def _stored_devices(processed: str, count: int) -> list[str]:
    from pipeline.store.objects import opened
    from pipeline.store.storage import list_devices

    if not count:
        return []
    with opened(processed) as store:
        return list_devices(store)


def _has_walls(processed: str, device: str) -> bool:
    """Return whether a device has trials with a wall."""
    from pipeline.store.objects import opened
    from pipeline.store.storage import read_trials

    with opened(processed, device) as store:
        trials = read_trials(store, device, columns=["stiffness", "damping"])
    return any(value for name in ("stiffness", "damping") for value in trials.column(name).to_pylist())

"""Commands of foreign logs: `profile`, `look` and `quarantine`: parse, call, print."""

from __future__ import annotations

import os
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pipeline.base.errors import EXIT_ERROR, EXIT_QUARANTINED, OTHER_COLUMNS, UsageError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import Json, Processed, ProfileFile


class Deed(StrEnum):
    """What is done with profiles."""

    check = "check"
    draft = "draft"


def profile(
    deed: Annotated[Deed, typer.Argument(help="What to do.", metavar="check|draft")],
    files: Annotated[
        list[Path],
        typer.Argument(help="check: a profile file (.toml) or name, and sample logs; draft: logs, the first drafted."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="New file for a draft; printed where not given.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Draft a profile from sample logs, or show what a profile reads.

    A draft marks open questions: lines "# QUESTION: key: ..." stand where units, signs and conditions must not be
    guessed. Set the key below and remove the line; `check` lists what is open.

    A check stores nothing. Exit status 3 where a sample would be refused, 1 where the profile itself is wrong (each
    mistake with its line) or a command obeys another K, B or step than the conditions say.

    Example: pipeline profile draft run_*.csv --out lab.toml

    Example: pipeline profile check lab.toml run_01.csv
    """
    if deed is Deed.draft:
        _draft(files, out, as_json)
    elif len(files) < 2 or out is not None:
        raise UsageError("expected check PROFILE LOGS, without --out, or draft LOGS.")
    else:
        _check(str(files[0]), files[1:], as_json)


def _check(name: str, samples: Sequence[Path], as_json: bool) -> None:
    from pipeline.profiles.profile_files import load_profile
    from pipeline.shell.profile.check import check_lines, check_samples

    loaded = load_profile(name)
    checked = check_samples(loaded, samples)
    if as_json:
        refused = sum(sample["reason"] is not None for sample in checked)
        console.print_json({"profile": loaded.name, "samples": checked, "refused": refused})
    else:
        for line in check_lines(checked):
            console.say(line)
    if any(trial["other_gains"] for sample in checked for trial in sample["trials"]):
        raise typer.Exit(EXIT_ERROR)
    if any(sample["reason"] is not None for sample in checked):
        raise typer.Exit(EXIT_QUARANTINED)


def _draft(samples: Sequence[Path], out: Path | None, as_json: bool) -> None:
    from pipeline.base.disk import write_text
    from pipeline.profiles.profile_files import find_questions
    from pipeline.shell.profile.draft import draft_profile

    if out is not None:
        check_output(out, "--out")
        if out.exists():
            raise UsageError(f"{out}: exists. Give another file, or remove it.")
    text = draft_profile(*samples)
    questions = find_questions(text)
    if out is not None:
        write_text(out, text)
    if as_json:
        asked = [{"line": q.line, "key": ".".join(map(str, q.place)), "question": q.text} for q in questions]
        document = {"sample": str(samples[0]), "out": None if out is None else str(out), "profile": text}
        console.print_json({**document, "questions": asked})
    elif out is None:
        console.say(text.rstrip("\n"))
    else:
        console.say(f"{out}: {len(questions)} questions are open")


def look(
    log: Annotated[Path, typer.Argument(help="A log in any format, or the folder of a bag.")],
    profile: ProfileFile = None,
    out: Annotated[Path, typer.Option("--out", help="HTML file.")] = Path("look.html"),
    as_json: Json = False,
) -> None:
    """Draw a log as recorded: columns, step, jumps, rests, missing rows.

    By a profile, or where a shipped one fits, columns are in SI over time; all others stand as they are in the file,
    over the number of the row. Nothing is stored.

    Example: pipeline look run_01.csv
    """
    from pipeline.base.disk import write_text
    from pipeline.profiles.profile_files import load_profile
    from pipeline.shell.profile.picture import document, page
    from pipeline.shell.profile.picture import look as look_at

    check_output(out, "--out")
    picture = look_at(log, None if profile is None else load_profile(profile))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text(out, page([picture]))
    if as_json:
        console.print_json({**document(picture), "page": str(out)})
        return
    for line in picture.notes:
        console.say(line)
    console.say(f"picture: {out}")


def _see_folder(processed: Path) -> None:
    """Refuse a folder that is not there: a mistyped one must not look like one without refusals."""
    if not processed.is_dir():
        raise UsageError(f"{processed}: no such folder. Give the folder of the stored tables (--processed).")


def quarantine(
    logs: Annotated[
        list[str] | None, typer.Argument(help="Ids or paths of logs in quarantine; all where none is given.")
    ] = None,
    again: Annotated[bool, typer.Option("--retry", help="Ingest them again, after they were corrected.")] = False,
    profile: ProfileFile = None,
    processed: Processed = Path("processed"),
    as_json: Json = False,
) -> None:
    """List refused logs, show why, or ingest them again.

    Codes are explained in docs/logs.md. Exit status 3 where --retry leaves some refused, or some are gone.

    Example: pipeline quarantine

    Example: pipeline quarantine logs/run_01.csv

    Example: pipeline quarantine --retry --profile lab.toml
    """
    if profile is not None and not again:
        raise UsageError("--profile reads logs again: give --retry, too.")
    _see_folder(processed)
    if again:
        _retry(logs, profile, processed, as_json)
    elif logs:
        for log in logs:
            _show(log, processed, as_json)
    else:
        _list(processed, as_json)


def _list(processed: Path, as_json: bool) -> None:
    """Print the logs in quarantine with id, path, row, code and reason, and a line of a profile that might help."""
    from pipeline.intake.quarantine import list_quarantine, record_id

    records = list_quarantine(processed)
    if as_json:
        console.print_json([{"id": record_id(record), **record.model_dump(mode="json")} for record in records])
        return
    told = []
    for record in records:
        row = "" if record.row is None else f", row {record.row}"
        code = "" if record.code is None else f" [{record.code}]"
        more = "" if record.profile_line is None else "\n" + " " * 18 + "profile: "
        more += "; ".join((record.profile_line or "").splitlines())
        told.append((f"{record_id(record)}  {record.path}{row}{code}", record.reason + more))
    for line in console.grouped(told):
        console.say(line)
    other = [record.path for record in records if record.code in OTHER_COLUMNS]
    if other:
        console.say(console.draft_hint(other[0]))
    console.say(f"{len(records)} in quarantine")


def _show(wanted: str, processed: Path, as_json: bool) -> None:
    """Print why a log was refused, with the lines around the row at fault."""
    from pipeline.intake.quarantine import excerpt_of, find_record, record_id

    record = find_record(processed, wanted)
    excerpt = excerpt_of(record)
    if as_json:
        console.print_json({"id": record_id(record), **record.model_dump(mode="json"), "excerpt": excerpt})
        return
    for key in ("path", "profile", "size", "row", "code", "reason"):
        value = getattr(record, key)
        console.say(f"{key:<8} {'–' if value is None else value}")
    if record.profile_line is not None:
        console.say("this might help in the profile:")
        for line in record.profile_line.splitlines():
            console.say(f"    {line}")
    if not excerpt:
        console.say("no excerpt: the log has no lines, or is no longer as it was")
    for number, line in excerpt:
        console.say(f"{'>' if number == record.row else ' '} {number:>6}  {line}")


def _retry(paths: Sequence[str] | None, profile: str | None, processed: Path, as_json: bool) -> None:
    """Ingest logs in quarantine again."""
    from pipeline.base.paths import path_of_text
    from pipeline.intake.ingest import ingest
    from pipeline.intake.quarantine import find_record, list_quarantine, quarantine_folder, record_id

    records = [find_record(processed, path) for path in paths] if paths else list_quarantine(processed)
    sources = {record.path: path_of_text(record.path) for record in records}
    ids = {record.path: record_id(record) for record in records}
    gone = [path for path, source in sources.items() if not os.path.exists(source)]
    present = [source for path, source in sources.items() if path not in gone]
    report = ingest(present, processed, profile, rehash=True)
    if as_json:
        console.print_json({**report.model_dump(mode="json"), "gone": gone})
    else:
        accepted = report.ingested + report.skipped
        console.say(f"{len(records)} tried, {accepted} accepted, {len(report.quarantined)} refused, {len(gone)} gone")
        rows = ["" if refusal.row is None else f", row {refusal.row}" for refusal in report.quarantined]
        refused = zip(report.quarantined, rows, strict=True)
        for line in console.grouped((f"{refusal.path}{row}", refusal.reason) for refusal, row in refused):
            console.say(line)
        for path in gone:
            folder = quarantine_folder(processed) / ids[path]
            console.say(f"{path}: is no longer there, or may not be looked at. Put it back, or remove {folder}.")
    if report.quarantined or gone:
        raise typer.Exit(EXIT_QUARANTINED)

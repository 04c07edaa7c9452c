"""Commands of foreign logs: `look`, `profile` and `quarantine`: parse, call, print."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, HELPS, OTHER_COLUMNS, UsageError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import Out, Processed, ProfileFile
from pipeline.shell.console import argument, option


def look(
    log: Annotated[Path, argument("A log in any format, or the folder of a bag.")],
    profile: ProfileFile = None,
    out: Annotated[Path, option("--out", "HTML file.")] = Path("look.html"),
) -> None:
    """Draw a log as recorded: columns, step, jumps, rests, missing rows.

    By a profile, or where a shipped one fits, columns are in SI over time; all others stand as they are in the file,
    over the number of the row. Nothing is stored.

    Example: pipeline look run_01.csv
    """
    from pipeline.base.disk import write_text
    from pipeline.profiles.profile_files import load_profile
    from pipeline.shell.profile.check import document, page
    from pipeline.shell.profile.check import look as look_at

    check_output(out, "--out")
    picture = look_at(log, None if profile is None else load_profile(profile))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text(out, page(picture))
    console.tell({**document(picture), "page": str(out)}, [*picture.notes, f"picture: {out}"])


def profile(
    deed: Annotated[Literal["check", "draft"], argument("What to do.", metavar="check|draft")],
    files: Annotated[list[Path], argument("check: profile, then logs. draft: logs, the first drafted.")],
    out: Out = None,
) -> int:
    """Draft a profile from sample logs, or show what a profile reads.

    A draft marks open questions: lines "# QUESTION: key: ..." stand where units, signs and conditions must not be
    guessed. Set the key below and remove the line; `check` lists what is open.

    A check stores nothing. Exit status 3 where a sample would be refused, 1 where the profile itself is wrong (each
    mistake with its line) or a command obeys another K, B or step than the conditions say.

    Example: pipeline profile draft run_*.csv --out lab.toml

    Example: pipeline profile check lab.toml run_01.csv
    """
    if deed == "draft":
        return _draft(files, out)
    if len(files) < 2 or out is not None:
        raise UsageError("expected check PROFILE LOGS, without --out, or draft LOGS.")
    return _check(str(files[0]), files[1:])


def _check(name: str, samples: Sequence[Path]) -> int:
    from pipeline.profiles.profile_files import load_profile
    from pipeline.shell.profile.check import check_lines, check_samples

    loaded = load_profile(name)
    checked = check_samples(loaded, samples)
    refused = sum(sample["reason"] is not None for sample in checked)
    console.tell({"profile": loaded.name, "samples": checked, "refused": refused}, check_lines(checked))
    if any(trial["other_gains"] for sample in checked for trial in sample["trials"]):
        return EXIT_ERROR
    return EXIT_QUARANTINED if refused else EXIT_OK


def _draft(samples: Sequence[Path], out: Path | None) -> int:
    from pipeline.base.disk import write_text
    from pipeline.profiles.profile_files import find_questions
    from pipeline.shell.profile.draft import draft_profile

    if out is not None:
        check_output(out, "--out")
        if out.exists():
            raise UsageError(f"{out}: exists. Give another file, or remove it.")
    text = draft_profile(*samples)
    asked = [{"line": q.line, "key": ".".join(map(str, q.place)), "question": q.text} for q in find_questions(text)]
    if out is not None:
        write_text(out, text)
    document = {"sample": str(samples[0]), "out": out and str(out), "profile": text, "questions": asked}
    console.tell(document, [f"{out}: {len(asked)} questions are open" if out else text.rstrip("\n")])
    return EXIT_OK


def quarantine(
    logs: Annotated[list[str] | None, argument("Ids or paths of refused logs (default: all).")] = None,
    processed: Processed = Path("processed"),
) -> None:
    """List refused logs, or show why they were refused.

    Codes are explained in docs/logs.md. `pipeline ingest` tries them again, with --profile by another profile.

    Example: pipeline quarantine

    Example: pipeline quarantine logs/run_01.csv
    """
    from pipeline.intake.kept import find_record, list_quarantine, record_id

    if not processed.is_dir():  # a mistyped one must not look like one without refusals
        raise UsageError(f"{processed}: no such folder. Give the folder of the stored tables (--processed).")
    records = [find_record(processed, log) for log in logs or ()] or list_quarantine(processed)
    found = [{"id": record_id(record), **record.model_dump(mode="json")} for record in records]
    if not logs:
        console.tell(found, _list_lines(found))
        return
    console.tell(found[0] if len(found) == 1 else found, (line for one in found for line in _reason_lines(one)))


def _list_lines(records: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    """Yield the logs in quarantine with id, path, row, code and reason, which ends with the line that might help."""
    told = []
    for one in records:
        row = "" if one["row"] is None else f", row {one['row']}"
        code = "" if one["code"] is None else f" [{one['code']}]"
        told.append((f"{one['id']}  {one['path']}{row}{code}", one["reason"]))
    yield from console.grouped(told)
    other = [one["path"] for one in records if one["code"] in OTHER_COLUMNS]
    yield from (console.draft_hint(path) for path in other[:1])
    yield f"{len(records)} in quarantine"


def _reason_lines(record: Mapping[str, Any]) -> Iterable[str]:
    """Yield why a log was refused, line by line; lines of a profile as they are to be copied."""
    for key in ("path", "profile", "size", "row", "code"):
        yield f"{key:<8} {'–' if record[key] is None else record[key]}"
    yield f"reason   {record['reason'].partition(HELPS)[0].rstrip()}"
    if record["profile_line"] is not None:
        yield from (HELPS, *(f"    {line}" for line in record["profile_line"].splitlines()))

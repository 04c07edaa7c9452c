"""Commands for logs and stored data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, HELPS, OTHER_COLUMNS, UsageError, draft_hint
from pipeline.base.paths import check_output
from pipeline.base.wording import counted
from pipeline.shell import console
from pipeline.shell.commands.log_columns import reads_logs
from pipeline.shell.commands.options import Ignore, LogProfile, Out, Processed, Store
from pipeline.shell.console import argument, option

if TYPE_CHECKING:
    from pipeline.intake.check import CheckReport
    from pipeline.store.storage import Exclusion

Result = TypeVar("Result")

LISTED = 10
"""Largest number of printed lines of one kind. The output of `--json` has all lines."""

Trials = Annotated[str, argument("DEVICE, DEVICE/EXPERIMENT, path of a log, or the first characters of a trial id.")]


@reads_logs("paths")
def ingest(
    paths: Annotated[list[Path], argument("Logs, and folders to search for logs.")],
    profile: LogProfile = None,
    processed: Store = "processed",
    jobs: Annotated[int | None, option("--jobs", "Threads (default: one per processor).")] = None,
    rehash: Annotated[bool, option("--rehash", "Also read logs whose size and time are unchanged.")] = False,
    replace: Annotated[bool, option("--replace", "Replace logs stored with a different profile or device.")] = False,
    dry_run: Annotated[bool, option("--dry-run", "Check and report without storing.")] = False,
    ignore: Ignore = None,
) -> int:
    """Check and store new logs. Refused logs go into quarantine.

    Log files are never changed. The next ingest completes an interrupted one. The exit status is 3 if a log is in
    quarantine, and 1 if a stored file is damaged. Damaged files are listed, and all other logs are stored.

    Example: pipeline ingest raw --processed processed

    Example: pipeline ingest raw --dry-run

    Example: pipeline ingest raw --profile lab.toml

    Example: pipeline ingest logs --command F:N --position x:mm --stiffness K:N/mm --damping B:Ns/m --step '4 N'
    --device bench
    """
    from pipeline.intake.ingest import ingest as ingest_logs
    from pipeline.store.objects import stored_by

    with console.progress("ingest", "logs") as advance:
        report = stored_by(
            processed,
            lambda folder: ingest_logs(
                paths, folder, profile, progress=advance, ignore=ignore or (), jobs=jobs, dry_run=dry_run,
                rehash=rehash, replace=replace, say=console.step,
            ),
        )  # fmt: skip
    document = report.model_dump(mode="json")
    if document["plan"] is None:
        del document["plan"]
    console.show(document, _ingest_lines(document, hint=profile is None))
    return EXIT_ERROR if document["damaged"] else EXIT_QUARANTINED if document["quarantined"] else EXIT_OK


def counts_of(report: Mapping[str, Any]) -> list[str]:
    """Return a table of the numbers of logs that were found, stored, skipped and refused."""
    counts = {key: report[key] for key in ("found", "ingested", "skipped")}
    counts["quarantined"] = len(report["quarantined"])
    return console.table([counts], tuple(counts))


def refusals(refused: Iterable[Mapping[str, Any]]) -> Iterable[str]:
    """Yield the refused logs with their reasons. Equal reasons are grouped."""
    rows = ((one, "" if one["row"] is None else f", row {one['row']}") for one in refused)
    return console.grouped((f"{one['path']}{row}", one["reason"]) for one, row in rows)


def warnings_of(report: Mapping[str, Any]) -> Iterable[str]:
    """Yield the warnings of an ingest, one line for each kind, then the logs whose stored trials changed."""
    warnings = ((each["path"], each["warning"], each.get("code")) for each in report["warnings"])
    yield from (f"warning: {line}" for line in console.warned(warnings))
    yield from (f"changed: {source['path']}: {source['outcome']}" for source in report["changed"])


def _ingest_lines(report: Mapping[str, Any], hint: bool) -> Iterable[str]:
    yield from counts_of(report)
    plan: dict[tuple[str, str], list[str]] = {}
    for source in report.get("plan", ()):
        if source["action"] != "refuse":  # refused logs are listed below
            plan.setdefault((source["action"], source["reason"]), []).append(source["path"])
    for (action, reason), paths in sorted(plan.items(), key=lambda group: -len(group[1])):
        yield from _listed(f"{action} ({reason})", paths)
    yield from refusals(report["quarantined"])
    yield from warnings_of(report)
    yield from _listed("no longer found (their trials stay stored)", report["removed"])
    yield from _listed("waiting (modified recently)", report["waiting"])
    yield from _listed("ignored (not logs)", report["ignored"])
    yield from _listed("damaged", report["damaged"])
    other = [refusal["path"] for refusal in report["quarantined"] if refusal["code"] in OTHER_COLUMNS]
    if other and hint:
        yield draft_hint(other[0])


def _listed(title: str, paths: list[str]) -> Iterable[str]:
    """Yield the number of paths, then one line for each of the first `LISTED` paths."""
    if len(paths) == 1:
        yield f"{title}: {paths[0]}"
    elif paths:
        yield f"{title}: {len(paths)}"
        yield from (f"  {path}" for path in paths[:LISTED])
        if len(paths) > LISTED:
            yield f"  and {len(paths) - LISTED} more"


def check(
    repair: Annotated[bool, option("--repair", "Repair; unrecoverable files go to PROCESSED/damaged.")] = False,
    processed: Processed = Path("processed"),
) -> int:
    """Verify the checksums of stored files, and repair them on request.

    The exit status is 1 if a file is damaged or missing. With --repair, the exit status is 1 if data could not be
    recovered.

    Example: pipeline check --processed processed

    Example: pipeline check --repair --json
    """
    from pipeline.intake.check import check as check_store

    _must_exist(processed)
    with console.progress("check", "files") as advance:
        found = check_store(processed, repair, progress=advance, say=console.step)
    console.show(found.model_dump(mode="json"), _check_lines(found))
    bad = found.gone or any(not (repair and damage.mended) for damage in found.damage)
    return EXIT_ERROR if bad else EXIT_OK


def _check_lines(found: CheckReport) -> Iterable[str]:
    yield f"{found.files} files, {found.bytes / 1e6:.3g} MB: {len(found.damage) or 'none'} damaged"
    for damage in found.damage:
        yield f"{damage.file}: {damage.fault}"
        counts = f": {damage.kept} trials kept, {damage.read_again} read again from their logs" if damage.trials else ""
        yield f"  {damage.remedy} ({'done' if found.repaired else 'by --repair'}){counts}"
        yield from _listed("  lost", [f"{one['trial_id']} of {one['source_path']}" for one in damage.lost])
    yield from found.gone


def status(processed: Processed = Path("processed")) -> int:
    """Show stored experiments, exclusions, deletions and refused logs.

    `pipeline compare --dry-run` lists outdated results, and `pipeline ingest --dry-run` lists new and changed logs.

    Example: pipeline status --processed processed
    """
    from pipeline.intake.quarantine import list_quarantine
    from pipeline.store import corrections as correct
    from pipeline.store.storage import read_exclusions, read_trials

    _must_exist(processed)
    damaged: dict[Path, str] = {}
    stored = read_trials(processed, columns=["device", "experiment", "rows"], damaged=damaged)
    trials, samples = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    for device, experiment, count in zip(*(column.to_pylist() for column in stored.columns), strict=True):
        trials[device, experiment] += 1
        samples[device, experiment] += count
    rows = [
        {"device": place[0], "experiment": place[1], "trials": trials[place], "rows": samples[place]}
        for place in sorted(trials)
    ]
    excluded = [one.model_dump(mode="json") for one in read_exclusions(processed).values()]
    refused = Counter(record.code for record in list_quarantine(processed, damaged))
    document = {
        "experiments": rows,
        "excluded": excluded,
        "bin": len(correct.in_bin(processed)),
        "quarantined": dict(sorted(refused.items())),
        "damaged": sorted(damaged.values()),
    }
    console.show(document, _status_lines(document))
    return EXIT_ERROR if damaged else EXIT_OK


def _status_lines(found: Mapping[str, Any]) -> Iterable[str]:
    if found["experiments"]:
        yield from console.table(found["experiments"], ("device", "experiment", "trials", "rows"))
    yield f"{sum(row['trials'] for row in found['experiments'])} trials, {found['bin']} in the bin"
    yield from _listed("excluded", [f"{_trial(one)}: {one['exclusion_reason']}" for one in found["excluded"]])
    yield from (f"in quarantine, {code}: {count}" for code, count in found["quarantined"].items())
    yield from _listed("damaged", found["damaged"])


def exclude(
    trial: Trials,
    reason: Annotated[str | None, option("--reason", "Reason, shown in every report.")] = None,
    undo: Annotated[bool, option("--undo", "Use the trial again.")] = False,
    processed: Store = "processed",
) -> None:
    """Exclude trials from all results. Reports list them.

    The trials stay stored. They stay excluded if their logs are ingested again or renamed, and if the store is merged
    or repaired. `pipeline compare` updates the reports. `pipeline status` lists the excluded trials.

    Example: pipeline exclude 3f9a12c07be41d55 --reason "gripper slipped"

    Example: pipeline exclude raw/bench/K400_B2.csv --reason "cable pulled during the step"

    Example: pipeline exclude 3f9a --undo
    """
    from pipeline.store import corrections as correct

    if undo == (reason is not None):
        raise UsageError(f'{trial}: expected either --reason "<words>" or --undo, found {"both" if undo else "none"}.')

    def work(folder: Path) -> list[Exclusion]:
        if reason is None:
            return correct.use_again(folder, trial, say=console.step)
        return correct.exclude(folder, trial, reason, say=console.step)

    found = [one.model_dump(mode="json") for one in _changed(processed, work)]
    done = "used again; it had been excluded" if undo else "excluded"
    lines = (f"{_trial(one)}: {done}: {one['exclusion_reason']}" for one in found)
    console.show({"excluded": not undo, "trials": found}, lines)


def move(
    trial: Trials,
    to: Annotated[str, argument("DEVICE or DEVICE/EXPERIMENT; a slash in a name is %2F.")],
    processed: Store = "processed",
) -> None:
    """Rename or move a device, an experiment or a trial.

    The change is kept if logs are ingested again. Move the trials back to undo it.

    Example: pipeline move falcn falcon

    Example: pipeline move falcon/2 falcon/without-grip
    """
    from pipeline.store import corrections as correct

    count = _changed(processed, lambda folder: correct.move(folder, trial, to, say=console.step))
    console.show({"trials": count}, [f"trials now {to}: {count}"])


def delete(
    trial: Annotated[str | None, argument("Trials, named as for `exclude` (default: list the bin).")] = None,
    undo: Annotated[bool, option("--undo", "Take the trials out of the bin.")] = False,
    empty: Annotated[bool, option("--empty", "Remove the trials in the bin from the store.")] = False,
    processed: Store = "processed",
) -> None:
    """Move trials to the bin, list the bin, or empty it.

    Log files are not changed. Deleted trials stay deleted if their logs are ingested again, until --undo is used.

    Example: pipeline delete falcon/2

    Example: pipeline delete falcon/2 --undo

    Example: pipeline delete --empty
    """
    from pipeline.store import corrections as correct

    if (trial is None and undo) or (empty and trial is not None):
        raise UsageError("name the trials to delete (or to restore, with --undo), or use --empty without a name.")
    if trial is None and not empty:
        found = [one.model_dump(mode="json") for one in _changed(processed, correct.in_bin)]
        console.show({"bin": found}, _listed("in the bin", [_trial(one) for one in found]))
        return

    def work(folder: Path) -> int:
        if trial is None:
            return correct.empty_bin(folder, say=console.step)
        return (correct.restore if undo else correct.delete)(folder, trial, say=console.step)

    count = _changed(processed, work)
    done = "removed from the store" if empty else "restored" if undo else "in the bin"
    console.show({"trials": count}, [f"trials {done}: {count}"])


def _changed(processed: str, work: Callable[[Path], Result]) -> Result:
    from pipeline.store.objects import stored_by

    _must_exist(processed)
    return stored_by(processed, work)


def _trial(one: Mapping[str, Any]) -> str:
    label = f", {one['label']}" if one["label"] else ""
    return f"{one['trial_id']} of {one['device']}, experiment {one['experiment']} ({one['source_path']}{label})"


def _must_exist(processed: str | Path) -> None:
    from pipeline.store.objects import is_url

    if not is_url(processed) and not Path(processed).is_dir():
        raise UsageError(f"{processed}: folder not found. Give the folder of the stored tables (--processed).")


@reads_logs("log", walls=False)
def look(
    log: Annotated[Path, argument("A log in any format, or the folder of a bag.")],
    profile: LogProfile = None,
    out: Annotated[Path, option("--out", "HTML file.")] = Path("look.html"),
) -> None:
    """Draw a log as recorded: columns, step, jumps, rests, missing rows.

    If a given or shipped profile reads the log, its columns are drawn in SI over time. Otherwise, the columns are drawn
    as recorded over the row number. Nothing is stored.

    Example: pipeline look run_01.csv
    """
    from pipeline.surface.log_picture import look as picture_of

    check_output(out, "--out")
    picture = picture_of(log, profile)
    picture.write(out)
    console.show({**picture.document, "page": str(out)}, [*picture.notes, f"picture: {out}"])


def profile(
    action: Annotated[Literal["check", "draft"], argument("What to do.", metavar="check|draft")],
    files: Annotated[list[Path], argument("check: profile, then logs. draft: logs.")],
    out: Out = None,
) -> int:
    """Draft a profile from sample logs, or show what a profile reads.

    A draft marks open questions. Lines "# QUESTION: key: ..." ask for units, signs and conditions that must not be
    guessed. Set the key below such a line, and remove the line. `check` lists the open questions.

    A check stores nothing. The exit status is 3 if a sample would be refused. It is 1 if the profile is invalid (each
    error is shown with its line), or if a command follows a different K, B or step than the conditions state.

    Example: pipeline profile draft run_*.csv --out lab.toml

    Example: pipeline profile check lab.toml run_01.csv
    """
    if action == "draft":
        return _draft(files, out)
    if len(files) < 2 or out is not None:
        raise UsageError("expected `check PROFILE LOGS` without --out, or `draft LOGS`.")
    return _check(str(files[0]), files[1:])


def _check(name: str, samples: Sequence[Path]) -> int:
    from pipeline.profiles.profile_files import load_profile
    from pipeline.shell.profile.check import check_lines, check_samples

    loaded = load_profile(name)
    checked = check_samples(loaded, samples)
    refused = sum(sample["reason"] is not None for sample in checked)
    console.show({"profile": loaded.name, "samples": checked, "refused": refused}, check_lines(checked))
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
            raise UsageError(f"{out}: already exists. Name another file, or remove this one.")
    text = draft_profile(*samples)
    questions = [{"line": q.line, "key": ".".join(map(str, q.place)), "question": q.text} for q in find_questions(text)]
    if out is not None:
        write_text(out, text)
    document = {"sample": str(samples[0]), "out": out and str(out), "profile": text, "questions": questions}
    count = f"{counted(len(questions), 'question')} {'is' if len(questions) == 1 else 'are'} open"
    console.show(document, [f"{out}: {count}" if out else text.rstrip("\n")])
    return EXIT_OK


def quarantine(
    logs: Annotated[list[str] | None, argument("Ids or paths of refused logs (default: all).")] = None,
    processed: Processed = Path("processed"),
) -> None:
    """List refused logs, or show why they were refused.

    docs/logs.md explains the codes. `pipeline ingest` tries refused logs again. Its option --profile selects a
    different profile.

    Example: pipeline quarantine

    Example: pipeline quarantine logs/run_01.csv
    """
    from pipeline.intake.quarantine import find_record, list_quarantine, record_id

    _must_exist(processed)  # a mistyped folder must not look like a folder without refused logs
    records = [find_record(processed, log) for log in logs or ()] or list_quarantine(processed)
    found = [{"id": record_id(record), **record.model_dump(mode="json")} for record in records]
    if not logs:
        console.show(found, _list_lines(found))
        return
    console.show(found[0] if len(found) == 1 else found, (line for one in found for line in _reason_lines(one)))


def _list_lines(records: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    """Yield the logs in quarantine with the id, path, row, code and reason, and with a profile line that may help."""
    refusals = []
    for one in records:
        row = "" if one["row"] is None else f", row {one['row']}"
        refusals.append((f"{one['id']}  {one['path']}{row} [{one['code']}]", one["reason"]))
    yield from console.grouped(refusals)
    other = [one["path"] for one in records if one["code"] in OTHER_COLUMNS]
    yield from (draft_hint(path) for path in other[:1])
    yield f"{len(records)} in quarantine"


def _reason_lines(record: Mapping[str, Any]) -> Iterable[str]:
    """Yield the reason why a log was refused, and profile lines that can be copied."""
    for key in ("path", "profile", "size", "row", "code"):
        yield f"{key:<8} {'–' if record[key] is None else record[key]}"
    yield f"reason   {record['reason'].partition(HELPS)[0].rstrip()}"
    if record["profile_line"] is not None:
        yield from (HELPS, *(f"    {line}" for line in record["profile_line"].splitlines()))

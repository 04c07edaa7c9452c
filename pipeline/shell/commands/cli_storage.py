"""Commands that store logs and look after what is stored: parse, call, print."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from pipeline.base.errors import EXIT_ERROR, EXIT_OK, EXIT_QUARANTINED, OTHER_COLUMNS, UsageError
from pipeline.shell import console
from pipeline.shell.commands.options import Json, Processed, ProfileFile, Reports, Store

if TYPE_CHECKING:
    from pipeline.intake.check import CheckReport
    from pipeline.store.corrections import Exclusion

Result = TypeVar("Result")

LISTED = 10
"""Lines of one kind that are printed; `--json` has all."""


def ingest(
    paths: Annotated[list[Path], typer.Argument(help="Folders with logs (searched below, too), and logs.")],
    profile: ProfileFile = None,
    processed: Store = "processed",
    jobs: Annotated[int | None, typer.Option("--jobs", help="Threads; one per processor where not given.")] = None,
    rehash: Annotated[
        bool, typer.Option("--rehash", help="Look at the content even where size and time are unchanged.")
    ] = False,
    replace: Annotated[
        bool,
        typer.Option("--replace", help="Let trials give way where another profile or device claims their log now."),
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Read and check, write nothing; say for each log what would be done.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check and store new logs; refused ones go into quarantine.

    Logs are only read. An interrupted ingest is finished by the next one. Exit status 3 where a log is in quarantine, 1
    where a stored file is damaged: it is named, and all other logs are stored.

    Example: pipeline ingest raw --processed processed

    Example: pipeline ingest raw --dry-run

    Example: pipeline ingest raw --profile lab.toml
    """
    from pipeline.intake.ingest import ingest as ingest_logs
    from pipeline.store.objects import stored_by

    if jobs is not None and jobs < 1:
        raise UsageError(f"jobs must be at least 1, found {jobs}. Leave it out for one per processor.")
    with console.progress("ingest", "logs", as_json) as advance:
        note = None if as_json else console.note
        how: dict[str, Any] = {"jobs": jobs, "dry_run": dry_run, "rehash": rehash, "replace": replace}
        how |= {"progress": advance, "say": note}
        report = stored_by(processed, lambda folder: ingest_logs(paths, folder, profile, **how))
    document = report.model_dump(mode="json")
    if document["plan"] is None:
        del document["plan"]
    if as_json:
        console.print_json(document)
    else:
        for line in _ingest_lines(document):
            console.say(line)
        other = [refusal["path"] for refusal in document["quarantined"] if refusal["code"] in OTHER_COLUMNS]
        if other and profile is None:
            console.say(console.draft_hint(other[0]))
    if document["damaged"] or document["quarantined"]:
        raise typer.Exit(EXIT_ERROR if document["damaged"] else EXIT_QUARANTINED)


def _ingest_lines(report: Mapping[str, Any]) -> Iterable[str]:
    counts = {key: report[key] for key in ("found", "ingested", "skipped")}
    counts["quarantined"] = len(report["quarantined"])
    yield from console.table([counts], tuple(counts))
    if "plan" in report:
        yield from _plan_lines(report["plan"])
    yield from console.grouped((_place(refusal), refusal["reason"]) for refusal in report["quarantined"])
    for warning in report["warnings"]:
        yield f"warning: {warning['path']}: {warning['warning']}"
    for source in report["changed"]:
        yield f"changed: {source['path']}: {source['outcome']}"
    yield from _listed("removed, its trials stay stored", report["removed"])
    yield from _listed("waiting, modified a moment ago", report["waiting"])
    yield from _listed("damaged", report["damaged"])


def _place(refusal: Mapping[str, Any]) -> str:
    return f"{refusal['path']}{'' if refusal['row'] is None else ', row ' + str(refusal['row'])}"


def _plan_lines(plan: Iterable[Mapping[str, str]]) -> Iterable[str]:
    """Return what a dry run would do, grouped by action and reason."""
    groups: dict[tuple[str, str], list[str]] = {}
    for source in plan:
        if source["action"] != "refuse":  # told one by one below
            groups.setdefault((source["action"], source["reason"]), []).append(source["path"])
    for (action, reason), paths in sorted(groups.items(), key=lambda group: -len(group[1])):
        yield from _listed(f"{action} ({reason})", paths)


def _listed(title: str, paths: list[str]) -> Iterable[str]:
    """Return one line a path, at most `LISTED` of them, under their number."""
    if not paths:
        return
    if len(paths) == 1:
        yield f"{title}: {paths[0]}"
        return
    yield f"{title}: {len(paths)}"
    yield from (f"  {path}" for path in paths[:LISTED])
    if len(paths) > LISTED:
        yield f"  and {len(paths) - LISTED} more"


def check(
    repair: Annotated[
        bool, typer.Option("--repair", help="Save what can be saved; what cannot is kept in PROCESSED/damaged.")
    ] = False,
    processed: Processed = Path("processed"),
    as_json: Json = False,
) -> None:
    """Check installation and checksums; repair damaged files on request.

    Named are damaged files, what this machine lacks (packages, a disk that can be locked), and files of devices and
    profiles that cannot be read. Exit status 1 where something is damaged, gone or wrong; with --repair where it could
    not be saved.

    Example: pipeline check --processed processed

    Example: pipeline check --repair --json
    """
    from pipeline.intake.check import check as check_store
    from pipeline.shell.installation import examine

    installation = examine(processed)
    faults = [f"{c.name} {c.state}: {c.found}. {c.help}" for c in installation if c.state != "good"]
    if not processed.is_dir():
        for line in () if as_json else (f"pipeline {installation[0].found}", *faults):
            console.say(line)
    _must_exist(processed)
    with console.progress("check", "files", as_json) as advance:
        found = check_store(processed, repair, progress=advance, say=None if as_json else console.note)
    if as_json:
        console.print_json({**found.model_dump(mode="json"), "installation": [c.model_dump() for c in installation]})
    else:
        for line in (*_check_lines(found), *faults):
            console.say(line)
    wrong = any(c.state == "wrong" for c in installation)
    if wrong or found.gone or any(not (repair and damage.mended) for damage in found.damage):
        raise typer.Exit(EXIT_ERROR)


def _check_lines(found: CheckReport) -> Iterable[str]:
    yield f"{found.files} files, {_mb(found.bytes)}: {len(found.damage) or 'none'} damaged"
    for damage in found.damage:
        yield f"{damage.file}: {damage.fault}"
        counts = f": {damage.kept} trials kept, {damage.read_again} read again from their logs" if damage.trials else ""
        yield f"  {damage.remedy} ({'done' if found.repaired else 'by --repair'}){counts}"
        yield from _listed("  lost", [f"{one.trial_id} of {one.source_path}" for one in damage.lost])
    yield from (one.sentence for one in found.gone)


def status(
    processed: Processed = Path("processed"),
    reports: Reports = Path("reports"),
    as_json: Json = False,
) -> None:
    """Show what is stored, out of date, changed or in quarantine.

    Nothing is changed.

    Example: pipeline status --processed processed
    """
    from pipeline.shell.status import status as status_of

    _must_exist(processed)
    found = status_of(processed, reports)
    if as_json:
        console.print_json(found.model_dump(mode="json"))
        raise typer.Exit(EXIT_ERROR if found.damaged else EXIT_OK)
    console.say(f"{processed}: {found.trials} trials, {found.rows} samples, {found.files} tables, {_mb(found.bytes)}")
    rows = [{**e.model_dump(), "stale": ", ".join(e.stale) or "nothing"} for e in found.experiments]
    columns = ("device", "experiment", "trials", "rows", "batches", "stale")
    for line in console.table(rows, columns) if rows else ():
        console.say(line)
    for report in found.reports:
        console.say(f"{report.report}: {'out of date' if report.stale else 'up to date'}")
        for reason in report.stale[:LISTED]:
            console.say(f"  {reason}")
    changed = _listed("changed or touched since ingested", list(found.changed))
    for line in (*changed, *_listed("gone", list(found.removed))):
        console.say(line)
    excluded = [
        f"{_excluded_words(one.model_dump())}{'' if one.stored else ', no longer stored'}: {one.exclusion_reason}"
        for one in found.excluded
    ]
    for line in _listed("excluded by hand", excluded):
        console.say(line)
    for code, count in found.quarantined.items():
        console.say(f"in quarantine, {code}: {count}")
    if found.lock is not None:
        console.say(f"process {found.lock.pid} on {found.lock.host} writes there since {found.lock.since}")
    for line in _listed("damaged", list(found.damaged)):
        console.say(line)
    if found.damaged:
        raise typer.Exit(EXIT_ERROR)


Trials = Annotated[
    str, typer.Argument(help="DEVICE, DEVICE/EXPERIMENT, trial id or the beginning of one, or path of a log.")
]


def exclude(
    trial: Trials,
    reason: Annotated[str | None, typer.Option("--reason", help="Why; every report shows it.")] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Use the trial again.")] = False,
    processed: Store = "processed",
    as_json: Json = False,
) -> None:
    """Exclude trials from all results; they stay stored, and are reported.

    They stay excluded when their logs are ingested again or renamed, and when the store is merged or repaired. Reports
    are made anew by `pipeline compare`. `pipeline status` lists what is excluded.

    Example: pipeline exclude 3f9a12c07be41d55 --reason "gripper slipped"

    Example: pipeline exclude raw/bench/K400_B2.csv --reason "cable pulled during the step"

    Example: pipeline exclude 3f9a --undo
    """
    from pipeline.intake import correct

    if undo == (reason is not None):
        raise UsageError(f'{trial}: expected either --reason "<words>" or --undo, found {"both" if undo else "none"}.')
    say = None if as_json else console.note

    def work(folder: Path) -> list[Exclusion]:
        if reason is None:
            return correct.use_again(folder, trial, say=say)
        return correct.exclude(folder, trial, reason, say=say)

    found = _stored_by(processed, work)
    if as_json:
        console.print_json({"excluded": not undo, "trials": [one.model_dump(mode="json") for one in found]})
        return
    done = "used again; it was excluded" if undo else "excluded"
    for one in found:
        console.say(f"{_excluded_words(one.model_dump())}: {done}: {one.exclusion_reason}")


def move(
    trial: Trials,
    to: Annotated[str, typer.Argument(help="DEVICE or DEVICE/EXPERIMENT; a slash in a name is %2F.")],
    processed: Store = "processed",
    as_json: Json = False,
) -> None:
    """Rename or move a device, an experiment or a trial.

    It holds when logs are ingested again. Moving back undoes it.

    Example: pipeline move falcn falcon

    Example: pipeline move falcon/2 falcon/without-grip
    """
    from pipeline.intake import correct

    note = None if as_json else console.note
    _tell_count(_stored_by(processed, lambda f: correct.move(f, trial, to, say=note)), f"now {to}", as_json)


def delete(
    trial: Annotated[str | None, typer.Argument(help="As for `exclude`; not given: list the bin.")] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Take them out of the bin.")] = False,
    empty: Annotated[bool, typer.Option("--empty", help="Remove what is in the bin from the store.")] = False,
    processed: Store = "processed",
    as_json: Json = False,
) -> None:
    """Move trials to the bin, list it, or empty it. Logs stay untouched.

    What was deleted stays so when its logs are ingested again, until --undo.

    Example: pipeline delete falcon/2

    Example: pipeline delete falcon/2 --undo

    Example: pipeline delete --empty
    """
    from pipeline.intake import correct

    if (trial is None and undo) or (empty and trial is not None):
        raise UsageError("give what to delete, with --undo to take it out of the bin, or --empty alone.")
    note = None if as_json else console.note
    if trial is not None:
        act = correct.restore if undo else correct.delete
        count = _stored_by(processed, lambda folder: act(folder, trial, say=note))
        _tell_count(count, "restored" if undo else "in the bin", as_json)
    elif empty:
        count = _stored_by(processed, lambda folder: correct.empty_bin(folder, say=note))
        _tell_count(count, "removed from the store", as_json)
    else:
        found = [one.model_dump(mode="json") for one in _stored_by(processed, correct.in_bin)]
        if as_json:
            console.print_json({"bin": found})
        for line in () if as_json else _listed("in the bin", [_excluded_words(one) for one in found]):
            console.say(line)


def _stored_by(processed: str, work: Callable[[Path], Result]) -> Result:
    from pipeline.store.objects import stored_by

    _must_exist(processed)
    return stored_by(processed, work)


def _tell_count(trials: int, done: str, as_json: bool) -> None:
    if as_json:
        console.print_json({"trials": trials})
    else:
        console.say(f"{trials} {'trial' if trials == 1 else 'trials'} {done}")


def _excluded_words(one: Mapping[str, Any]) -> str:
    label = f", {one['label']}" if one["label"] else ""
    return f"{one['trial_id']} of {one['device']}, experiment {one['experiment']} ({one['source_path']}{label})"


def _mb(size: int) -> str:
    return f"{size / 1e6:.3g} MB"


def _must_exist(processed: str | Path) -> None:
    from pipeline.store.objects import is_url

    if not is_url(processed) and not Path(processed).is_dir():
        raise UsageError(f"{processed}: no such folder. Give the folder of the stored tables (--processed).")

"""Ingest logs into Parquet files.

Logs are found and read in batches. Each log is then checked, and stored or refused. Known logs are skipped.

A log is identified by its content. A source whose size and modification time are unchanged is not opened. Only one
ingest writes at a time. The results become visible batch by batch. An interrupted ingest is completed by the next one.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from pipeline.base.disk import WAIT_S, writing
from pipeline.base.errors import LogError, StoreError, UsageError
from pipeline.base.paths import is_gone, path_of_text, path_text, storable
from pipeline.base.provenance import digest
from pipeline.intake.decide import Decision, Evidence, Twin, decide, decide_unread
from pipeline.intake.quarantine import (
    QuarantineRecord,
    Refused,
    list_quarantine,
    quarantine_sources,
    record_of,
    remove_from_quarantine,
)
from pipeline.intake.sources import (
    Notices,
    Read,
    Source,
    check_places,
    find_sources,
    is_settled,
    reads_of,
    requested_profiles,
)
from pipeline.intake.stored_sources import (
    Accepted,
    Periods,
    StoredSource,
    StoredSources,
    accepted_logs,
    batches_of,
    trial_id,
)
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log
from pipeline.recording.signals import same_samples
from pipeline.records.findings import Finding, Motion, Record
from pipeline.store.batch_files import Key, merge_small, remove_incomplete, remove_superseded, store
from pipeline.store.corrections import copy_corrections
from pipeline.store.objects import publish, renewed
from pipeline.store.storage import check_version, read_corrections

Action = Literal["ingest", "skip", "refuse", "wait"]
"""Action stated in the report for each rule of a decision (`pipeline.intake.decide`)."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A source in quarantine: path, reason, faulty row (counted from 1), and other fields of `errors.LogError`."""

    path: str
    reason: str
    row: int | None
    code: str
    profile_line: str | None = None


@dataclass(frozen=True, slots=True)
class LogWarning:
    """An irregularity that was accepted in a source. For a fault of the recording, the warning also has a code and a
    severity."""

    path: str
    warning: str
    code: str | None = None
    severity: str | None = None


@dataclass(frozen=True, slots=True)
class ChangedSource:
    """A source whose content differs from the stored content, and the outcome for the stored trials."""

    path: str
    outcome: str


@dataclass(frozen=True, slots=True)
class PlannedSource:
    """Action for a source, and the reason. In a dry run, the action is only planned."""

    path: str
    action: Action
    reason: str


class IngestReport(Record):
    """Number of logs by result, with ``found = ingested + skipped + len(quarantined)``.

    A log is a source file (or pair of files), which may contain several trials.

    Parameters
    ----------
    found, ingested, skipped : int
    quarantined : tuple of Refusal
    warnings : tuple of LogWarning
        Irregularities of the ingested logs.
    removed : tuple of str
        Stored sources that no longer exist below the searched folders. Their trials stay stored.
    changed : tuple of ChangedSource
        Sources whose content differs from the stored content.
    waiting : tuple of str
        Sources that were modified recently and are left for the next ingest. These are not counted in ``found``.
    plan : tuple of PlannedSource or None
        Planned action for each source of a dry run, including waiting sources. None otherwise.
    damaged : tuple of str
        Damaged stored files with their remedies. The logs in these files count as new. Other logs are not affected.
    ignored : tuple of str
        Files in searched folders that are not logs: papers, scripts, settings, pictures, sheets. They are not counted.
    """

    found: int
    ingested: int
    skipped: int
    quarantined: tuple[Refusal, ...]
    warnings: tuple[LogWarning, ...] = ()
    removed: tuple[str, ...] = ()
    changed: tuple[ChangedSource, ...] = ()
    waiting: tuple[str, ...] = ()
    plan: tuple[PlannedSource, ...] | None = None
    damaged: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()


PENDING_BYTES = 64 << 20
"""Memory for logs that are collected before they are stored [byte].

A file then has 2,300 logs of 1,000 rows. An interruption loses the work of about a second.
"""


def ingest(
    paths: Sequence[Path],
    processed: Path,
    profile: str | Path | Profile | None = None,
    *,
    jobs: int | None = None,
    dry_run: bool = False,
    rehash: bool = False,
    replace: bool = False,
    progress: Callable[[int, int], None] | None = None,
    settle_s: float = 0.0,
    growing: Collection[str] = (),
    wait_s: float = WAIT_S,
    say: Callable[[str], None] | None = None,
    damaged: dict[Path, str] | None = None,
    ignore: Sequence[str] = (),
) -> IngestReport:
    """Store all new logs in the given files and folders.

    Parameters
    ----------
    paths : sequence of Path
        Files, and folders that are searched recursively.
    processed : Path
        Folder of the stored tables. It is created if it does not exist.
    profile : str, Path or Profile, optional
        Name of a shipped profile, a TOML file, or a loaded profile. By default, a shipped profile is chosen for each
        file.
    jobs : int, optional
        Number of threads that read and parse logs. By default, the number of processors, but at most four.
    dry_run : bool
        True to read and check without writing, and to report the planned action for each source.
    rehash : bool
        True to compare the content of a log even if its size and modification time are unchanged.
    replace : bool
        True to replace trials whose log is now claimed by a different profile or for a different device. By default,
        such logs are refused.
    progress : callable, optional
        Function that is called with the number of logs done and the number of logs found.
    settle_s : float
        Age [s] below which a modified source is skipped, because it may still be recorded. A source that changes while
        it is read is always refused.
    growing : collection of str
        Absolute paths of files that are known to grow. They are skipped regardless of their time stamps.
    wait_s : float
        Longest wait for another command that writes to `processed` [s].
    say : callable, optional
        Function that is called with a message when waiting begins.
    damaged : dict of Path to str, optional
        Stored files that are known to be damaged, with their faults. The logs in these files count as new.
    ignore : sequence of str
        Patterns for the names of files in searched folders that are not logs.

    Raises
    ------
    UsageError
        If a path does not exist, or `jobs` is less than 1.
    ProfileError
        If the profile is invalid, or two profiles claim the same file.
    StoreError
        If `processed` is damaged or cannot be written, or another command is writing to it. Data that are already
        stored remain valid.
    """
    if jobs is not None and jobs < 1:
        raise UsageError(f"jobs must be at least 1, but is {jobs}. Omit this argument for one thread per processor.")
    check_version(processed)
    folders = [Path(path) for path in paths]
    check_places(folders, processed)  # this check precedes all writing
    asked = requested_profiles(profile, folders)
    ignored = (*ignore, *asked.ignore)
    with nullcontext() if dry_run else writing(processed, wait_s, say):
        run = _Run(processed, asked.profiles, dict(damaged or {}), dry_run, rehash, replace, progress, ignored)
        run.warnings += [LogWarning(path_text(sheet), text) for sheet, text in asked.notices]
        run.look(folders, settle_s, growing)
        run.work(jobs or min(4, os.cpu_count() or 1))
        return run.report(folders)


@dataclass
class _Run:
    """State of an ingest: the stored sources, the decisions so far, and the trials that wait to be stored.

    Parameters
    ----------
    processed, profiles, damaged, dry_run, rehash, replace, progress, ignore
        As for `ingest`.
    """

    processed: Path
    profiles: tuple[Profile, ...]
    damaged: dict[Path, str]
    dry_run: bool
    rehash: bool
    replace: bool
    progress: Callable[[int, int], None] | None
    ignore: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.claims = digest(sorted(profile.digest for profile in self.profiles))
        self.stored = StoredSources(self.processed, self.claims, self.damaged)
        if not self.dry_run:
            remove_incomplete(self.processed)
            if self.stored.rows.replaced or self.stored.doubled:
                remove_superseded(self.processed, self.damaged)
                self.stored = StoredSources(self.processed, self.claims, self.damaged)
        self.refused = {record.path: record for record in list_quarantine(self.processed, self.damaged)}
        self.periods = Periods(self.processed)
        self.sources = list[Source]()
        self.unread = 0
        """Number of sources that were skipped without reading, because size, modification time and profile are
        unchanged."""
        self.missing = set[str]()
        """Paths of the stored sources that were not found or not searched for."""
        self.places = dict[str, str]()
        """Path of the log of each stored trial, keyed by trial id."""
        self.renamed = dict[str, str]()
        """Former and new id of each trial whose log was renamed."""
        self.pending, self.pending_bytes, self.dropped, self.outdated = list[Accepted](), 0, set[Key](), set[Key]()
        """Trials to store, stored trials that they replace, and the replaced trials whose content is older."""
        self.seen = dict[str, str]()
        """Path of the first source with each hash of samples."""
        self.folders = set[Path]()
        self.refusals, self.warnings, self.changed = list[Refusal](), list[LogWarning](), list[ChangedSource]()
        self.waiting, self.plan = list[PlannedSource](), list[PlannedSource]()
        self.ignored: tuple[str, ...] = ()

    @cached_property
    def _motions(self) -> dict[str, Motion]:
        # This import takes longer than an ingest without new logs.
        from pipeline.device_data.devices import known_devices

        return {name: device.motion for name, device in known_devices().items()}

    @cached_property
    def _deleted(self) -> set[str]:
        with suppress(StoreError):  # commands that compute report the error
            return {one.trial_id for one in read_corrections(self.processed).values() if one.deleted}
        return set()

    @cached_property
    def _gone(self) -> dict[tuple[str, str], list[tuple[str, StoredSource]]]:
        """Stored sources that no longer exist, keyed by content and profile."""
        found: dict[tuple[str, str], list[tuple[str, StoredSource]]] = {}
        for path in sorted(self.missing):
            if is_gone(path_of_text(path)) and (one := self.stored.get(path)) is not None:
                found.setdefault((one.sha256, one.profile_sha256), []).append((path, one))
        return found

    def look(self, folders: Sequence[Path], settle_s: float, growing: Collection[str]) -> None:
        """Find the sources. Unchanged sources are only counted."""
        known = {} if self.dry_run or self.rehash else self.stored.states
        for path in (*self.refused, *growing):
            known.pop(path, None)
        if settle_s:
            known = {path: state for path, state in known.items() if is_settled(state[1], settle_s)}
        left = dict(known)
        notices = Notices()
        found = find_sources(folders, self.profiles, self.processed, notices, left, self.ignore)
        self.warnings += [LogWarning(path_text(folder), text) for folder, text in notices.folders]
        self.ignored = tuple(sorted({path_text(file) for file in notices.ignored}))
        self.unread = len(known) - len(left)
        present = {source.key for source in found}
        self.missing = (self.stored.paths - known.keys() | left.keys()) - present
        restless = frozenset(growing)
        for source in found:
            if source.key in known and source.key not in left:
                continue  # the path was given twice
            if is_settled(source.mtime_ns, settle_s) and restless.isdisjoint(map(os.path.abspath, source.files)):
                self.sources.append(source)
            else:
                self.waiting.append(PlannedSource(source.shown, "wait", f"modified less than {settle_s:g} s ago"))

    def work(self, jobs: int) -> None:
        """Decide on every source, and store the new sources."""
        unsettled = [source for source in self.sources if not self._settled_unread(source)]
        if unsettled:
            # A source that must be checked again is added after this line.
            self.places = self.stored.places({source.key for source in unsettled})
        # Stored sources are read first, so that a log that was copied and then touched is recognised under its original
        # path.
        unsettled.sort(key=lambda source: (source.key not in self.stored.paths, source.key))
        for batch in reads_of(unsettled, self._is_known, jobs):
            refused = [record for done in batch if (record := self._settle(done)) is not None]
            if not self.dry_run:
                quarantine_sources(self.processed, refused)
        self._flush()
        if self.dry_run:
            return
        if self.renamed:
            copy_corrections(self.processed, self.renamed)
        if renewed(self.processed, "trials"):
            remove_superseded(self.processed, self.damaged)
        for folder in sorted(self.folders):
            try:
                merge_small(self.processed, folder)
            except StoreError as error:  # a damaged file affects only its own experiment
                self.damaged[folder] = str(error)

    def report(self, folders: Sequence[Path]) -> IngestReport:
        """Return the report on all sources, and on the stored sources that are missing from the searched folders."""
        roots = tuple(os.path.join(path_text(os.path.abspath(folder)), "") for folder in folders if folder.is_dir())
        missing = [key for key in self.missing if key.startswith(roots)]
        # Unreadable files are reported elsewhere, and count as existing. A folder at the path of a log does not count
        # as the log.
        removed = [key for key in missing if is_gone(path := path_of_text(key)) or path.is_dir()]
        counts = Counter(one.action for one in self.plan)
        return IngestReport(
            found=len(self.plan) + self.unread,
            ingested=counts["ingest"],
            skipped=counts["skip"] + self.unread,
            quarantined=tuple(sorted(self.refusals, key=lambda refusal: refusal.path)),
            warnings=tuple(sorted(self.warnings, key=lambda warning: warning.path)),
            removed=tuple(sorted(removed)),
            changed=tuple(sorted(self.changed, key=lambda source: source.path)),
            waiting=tuple(sorted(one.path for one in self.waiting)),
            plan=tuple(sorted(self.plan + self.waiting, key=lambda one: one.path)) if self.dry_run else None,
            damaged=tuple(sorted(set(self.damaged.values()))),
            ignored=self.ignored,
        )

    def _note(self, source: Source, action: Action, reason: str) -> None:
        """Add the action for a source to the report."""
        self.plan.append(PlannedSource(source.shown, action, reason))
        if self.progress:
            self.progress(len(self.plan) + self.unread, len(self.sources) + self.unread)

    def _skip(self, source: Source, reason: str) -> None:
        self._release(source)
        self._note(source, "skip", reason)

    def _settled_unread(self, source: Source) -> bool:
        stored, refused = self.stored.get(source.key), self.refused.get(source.key)
        decision = None if self.rehash else decide_unread(source, stored, refused, replace=self.replace)
        if decision is None:
            return False
        if decision.rule == "refused before":
            assert refused is not None, "a refused source has a record"
            self._report_refused(source, refused)
        else:
            self._skip(source, decision.reason)
        return True

    def _is_known(self, source: Source, sha256: str) -> bool:
        """Return True if a content is completely stored under any path and was read with the same profile."""
        former = self.stored.get(source.key)
        if former is not None and former.whole and former.sha256 == sha256:
            return former.profile_sha256 == source.profile_sha256
        twin = self.stored.get(self._find(source, sha256) or "")
        return twin is not None and twin.profile_sha256 == source.profile_sha256

    def _find(self, source: Source, sha256: str) -> str | None:
        """Return the path of a stored log with the same content and the same conditions in its name, or None."""
        return self.places.get(trial_id(sha256, None, source.named_conditions))

    def _settle(self, read: Read) -> Refused | None:
        """Decide on a source that was read. Return the record for the quarantine if the source is refused, or None if
        it is accepted or its record is already in quarantine.
        """
        source = read.source
        try:
            if isinstance(read.result, LogError):
                raise read.result
            assert read.sha256 is not None, "a source that was read has a hash"
            self._accept(source, read.sha256, read.result)
        except LogError as error:
            if (other := self._other_reader(source, read.sha256)) and error.code != "profile-wrong":
                self._skip(source, f"already stored by profile {other!r}, and cannot be read by the given profile")
                return None
            record, former = record_of(source, read.sha256, error), self.refused.get(source.key)
            self._report_refused(source, record)
            if record != former and not record.is_less_specific(former):
                return source, record
        return None

    def _other_reader(self, source: Source, sha256: str | None) -> str | None:
        """Return the name of another profile with which the same content was stored completely, or None."""
        stored, profile = self.stored.get(source.key), source.profile
        if stored is None or profile is None or self.replace or not stored.whole or stored.sha256 != sha256:
            return None
        return stored.profile if stored.profile != profile.name else None

    def _accept(self, source: Source, sha256: str, logs: tuple[Log, ...] | None) -> None:
        """Store a log. `logs` is None for a known log that was not parsed. Such a log is skipped.

        Raises
        ------
        LogError
            If the log cannot be stored.
        """
        accepted: list[Accepted] = []
        if logs is not None:
            parted = [self._noted(source, self.periods.assign(log)) for log in logs]
            accepted = accepted_logs(source, sha256, parted, self._motions, self.claims)
        evidence = self._evidence(source, sha256, accepted if logs is not None else None)
        decision = decide(evidence, replace=self.replace)
        if decision.stores:
            self._take(evidence, decision, accepted)
        else:
            self._skip(source, decision.reason)
            if evidence.twin is None and evidence.former is not None:
                self.places |= dict.fromkeys(evidence.former.trials, source.key)
        if decision.warning is not None:
            self.warnings.append(LogWarning(source.shown, decision.warning))
        for drop in decision.drops:
            if drop.outcome is not None:
                self.changed.append(ChangedSource(path=drop.shown, outcome=drop.outcome))
            keys = self.outdated if drop.late else self.dropped
            keys |= drop.stored.keys(drop.path)
        if decision.stores:
            self._queue(accepted, evidence.former.trials if decision.rule == "completed" and evidence.former else ())

    def _noted(self, source: Source, log: Log) -> Log:
        """Return a log, with an additional finding if an earlier source has the same samples."""
        other = self.seen.setdefault(log.samples_sha256, source.shown)
        return log if other == source.shown else replace(log, noted=(*log.noted, same_samples(len(log.time), other)))

    def _evidence(self, source: Source, sha256: str, accepted: Sequence[Accepted] | None) -> Evidence:
        """Return the input of a decision: a source, and the stored sources that have the same path or content."""
        former, path = self.stored.get(source.key), self._find(source, sha256)
        if accepted:
            paths = {self.places.get(one.trial) for one in accepted}
            again = former is not None and former.sha256 == sha256
            path = None if again else (paths.pop() if len(paths) == 1 else None) or path
        stored = None if path is None else self.stored.get(path)
        twin = Twin(path, stored, not is_gone(path_of_text(path))) if path is not None and stored is not None else None
        lost = None
        if accepted and former is None and source.profile is not None and source.profile.reads_names:
            lost = next(iter(self._gone.get((sha256, accepted[0].row["profile_sha256"]), [])), None)
        devices = None if accepted is None else tuple(one.place.device for one in accepted)
        return Evidence(source, sha256, devices, former, twin, lost)

    def _take(self, evidence: Evidence, decision: Decision, accepted: Sequence[Accepted]) -> None:
        """Add the trials of a log to those that will be stored, and report its warnings."""
        source, row, ids = evidence.source, accepted[0].row, tuple(one.trial for one in accepted)
        read_by = (row["source_sha256"], row["profile_sha256"], row["profile"])
        self.stored.taken[source.key] = StoredSource(
            *read_by, source.size, source.mtime_ns, evidence.devices or (), ids
        )
        self.places |= dict.fromkeys(ids, source.key)
        if decision.rule == "renamed" and evidence.lost is not None:
            path, renamed = evidence.lost
            self._gone[read_by[:2]].remove(evidence.lost)
            self.missing.discard(path)
            self.renamed |= dict(zip(renamed.trials, ids, strict=False))
        texts: dict[str, Finding | None] = dict.fromkeys(text for one in accepted for text in one.log.warnings)
        texts |= {finding.sentence: finding for one in accepted for finding in one.log.findings}
        if not self._deleted.isdisjoint(ids):
            texts["was deleted manually and is in the bin. `pipeline delete ... --undo` restores it."] = None
        self.warnings += [
            LogWarning(source.shown, storable(text), *((found.code, found.severity) if found else (None, None)))
            for text, found in texts.items()
        ]
        self._note(source, "ingest", decision.reason)

    def _queue(self, accepted: Sequence[Accepted], present: Collection[str]) -> None:
        """Add trials to the next batch, except trials that are already stored."""
        if self.dry_run:
            return
        new = [one for one in accepted if one.trial not in present]
        self.pending += new
        self.pending_bytes += sum(one.bytes for one in new)
        if self.pending_bytes >= PENDING_BYTES:
            self._flush()

    def _flush(self) -> None:
        """Store all pending trials, and drop the trials that they replace.

        After an error, all stored data are valid.
        """
        if self.dry_run or not (self.pending or self.dropped):
            return
        self.folders |= store(self.processed, batches_of(self.pending), self.dropped, self.outdated, self.damaged)
        publish(self.processed)
        for source in {one.source.key: one.source for one in self.pending}.values():
            self._release(source)
        self.pending, self.pending_bytes, self.dropped, self.outdated = [], 0, set(), set()

    def _release(self, source: Source) -> None:
        if self.refused and not self.dry_run:
            keys = {source.key, *(path_text(os.path.abspath(file)) for file in source.files)}
            for key in keys & self.refused.keys():
                remove_from_quarantine(self.processed, key)

    def _report_refused(self, source: Source, record: QuarantineRecord) -> None:
        refusal = Refusal(source.shown, record.reason, record.row, record.code, record.profile_line)
        self.refusals.append(refusal)
        former = self.stored.get(source.key)
        # Without a hash, no changed content was read, unless the file is now too large to be read.
        seen = record.sha256 is not None or record.code == "too-large"
        if former is not None and former.sha256 != record.sha256 and seen:
            outcome = "its new content is refused; the trials of the former content stay stored"
            self.changed.append(ChangedSource(path=source.shown, outcome=outcome))
        self._note(source, "refuse", refusal.reason)

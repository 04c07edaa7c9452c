"""Logs to Parquet: find, recognise what is known, read in batches, validate, store, and refuse with a reason.

A log is known by its content; a source whose size and modification time are unchanged is not even opened. One ingest
writes at a time (`lock`); what it stores becomes visible batch by batch; the next one finishes an interrupted one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from pipeline.base.errors import LogError, StoreError, UsageError
from pipeline.base.file_names import path_of_text, path_text, storable
from pipeline.base.lock import WAIT_S, writing
from pipeline.base.process import Ended
from pipeline.device_data.devices import known_devices
from pipeline.intake.compaction import merge_small
from pipeline.intake.ingest_report import (
    Action,
    ChangedSource,
    IngestReport,
    LogWarning,
    PlannedSource,
    Refusal,
    refusal_of,
    repeated,
    when_stopped,
)
from pipeline.intake.known import Known, outcome_for
from pipeline.intake.periods import Periods
from pipeline.intake.quarantine import Keeper, QuarantineRecord, list_quarantine, record_of, release
from pipeline.intake.reading import Read, batches_of, in_order, read_and_check
from pipeline.intake.rerun import Look, Search
from pipeline.intake.sources import Source, by_rest, find_sources, is_settled, removed_below
from pipeline.intake.trialstore import TrialWriter, accepted_logs
from pipeline.intake.versions import StoredSource, StoredSources, drop_superseded, repair, why_ingested
from pipeline.profiles.profile_files import load_profile, shipped_profiles
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log
from pipeline.store.storage import trials_folder

PENDING_BYTES = 64 << 20
"""Samples that are collected before they become visible: a course of 2,300 logs with 1,000 rows makes one file, and an
interruption costs about a second's work."""


def ingest(
    paths: Sequence[Path],
    processed: Path,
    profile: str | Path | None = None,
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
    search: Search | None = None,
) -> IngestReport:
    """Store all new logs below some folders.

    Parameters
    ----------
    paths : sequence of Path
        Folders (searched with those below) and files.
    processed : Path
        Folder of the stored tables; made if needed.
    profile : str or Path, optional
        Shipped profile by name, or a TOML file; by default each file is claimed by a shipped profile.
    jobs : int, optional
        Threads that read and parse; by default one per processor, at most four.
    dry_run : bool
        Read and validate, write nothing, and say for each source what would be done.
    rehash : bool
        Look at the content also where size and modification time are unchanged.
    replace : bool
        Whether trials of another device give way where their log is read as one of this device now; by default such a
        log is refused.
    progress : callable, optional
        Called with (logs done, logs found).
    settle_s : float
        Leave sources alone that were modified less than this time ago [s]: they may still be recorded. A source that
        changes while it is read is refused in any case.
    growing : collection of str
        Absolute paths of files that somebody saw change a moment ago, whatever their times say; left alone, too.
    wait_s : float
        How long to wait for another command that writes to `processed` [s].
    say : callable, optional
        Gets a line when waiting begins.
    search : Search, optional
        The same search, with what `rerun.recall` has listed for it a moment ago.

    Returns
    -------
    IngestReport

    Raises
    ------
    UsageError
        If a path does not exist or `jobs` is below 1.
    ProfileError
        If the profile is wrong, or two profiles claim one file.
    StoreError
        If `processed` is damaged, cannot be written, or another command writes there; what was stored stays valid.
    """
    if jobs is not None and jobs < 1:
        raise UsageError(f"jobs must be at least 1, found {jobs}. Leave it out for one per processor.")
    profiles = shipped_profiles() if profile is None else (load_profile(profile),)
    folders = [Path(path) for path in paths]
    search = search or Search(tuple(map(str, paths)), str(processed), None if profile is None else str(profile))
    notices: list[LogWarning] = []

    def at_rest(path: str, mtime_ns: int) -> bool:
        return is_settled(mtime_ns, settle_s) and path not in growing

    def looked(believe: bool) -> tuple[Look, list[Source]]:
        look = Look(search, believe, at_rest if settle_s or growing else None)
        notices.clear()

        def noticed(folder: Path, text: str) -> None:
            notices.append(LogWarning(path=path_text(folder), warning=text))

        return look, find_sources(folders, profiles, processed, noticed, look.files)

    look, sources = looked(not (dry_run or rehash))
    run: _Ingest | None = None
    try:
        with nullcontext(False) if dry_run else writing(processed, wait_s, say) as waited:
            if waited or not look.holds():
                look, sources = looked(not (dry_run or rehash))
            if not dry_run:
                repair(processed, superseded=look.store is None)
            digests = {p: p.digest() for p in profiles}
            run = _Ingest(processed, dry_run, rehash, replace, digests, look, progress)
            if run.damaged and look.store is not None:  # the note passes logs of damaged batches, too
                look, sources = looked(False)
                run = _Ingest(processed, dry_run, rehash, replace, digests, look, progress)
            settled, waiting = by_rest(sources, settle_s, frozenset(growing))
            run.found += len(settled)
            present = look.passed.union(source.key for source in sources)
            run.process(settled, jobs or min(4, os.cpu_count() or 1), present)
            run.wait_for(waiting, settle_s)
            run.find_removed(folders, present)
            report = run.report(notices)
            if not dry_run:
                run.remember(report, notices)
    except (KeyboardInterrupt, Ended) as error:
        stored, kept = (0, 0) if run is None else (len(run.writer.visible), run.keeper.kept)
        error.add_note(when_stopped(processed, stored, kept))
        raise
    except OSError as error:
        raise StoreError(
            f"{processed}: cannot be written ({error}). Logs stored so far are complete; "
            "make room or correct the permissions and run the command again."
        ) from error
    return report


class _Ingest:
    """One run: what is stored already, what was decided so far."""

    def __init__(
        self,
        processed: Path,
        dry_run: bool,
        rehash: bool,
        replace: bool,
        digests: dict[Profile, str],
        look: Look,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.processed, self.dry_run, self.rehash, self.digests = processed, dry_run, rehash, digests
        self.replace = replace
        self.look, self.found, self.progress = look, len(look.passed), progress
        self.ingested, self.skipped = 0, len(look.passed)
        self.refusals: list[Refusal] = []
        self.keeper = Keeper(processed)
        self.warnings: list[LogWarning] = []
        self.changed, self.removed, self.waiting = list[ChangedSource](), list[str](), list[str]()
        self.plan, self.kept = list[PlannedSource](), list[Source]()
        self.unread = False
        self.writer = TrialWriter(processed, PENDING_BYTES)
        self.motions = {name: device.motion for name, device in known_devices().items()}
        self.damaged: dict[Path, str] = {}
        self.stored = StoredSources(processed, self.damaged)
        self.refused = {record.path: record for record in list_quarantine(processed, self.damaged)}
        self.replaced: set[tuple[str, str, str]] = set()
        self.known = Known(digests)
        self.periods = Periods(processed)
        self.renamed = set[str]()

    def process(self, sources: list[Source], jobs: int, present: Set[str]) -> None:
        """Decide on every source and store what is new; `present` are the paths of all that was found."""
        unsettled = [source for source in sources if not self._settled_unread(source)]
        # a source that is looked at again enters after that
        self.known.fill(self.stored, {source.key for source in unsettled}, present)
        # stored sources come first: a log that was copied and touched is recognised at its old place
        unsettled.sort(key=lambda source: (source.key not in self.stored, source.key))
        read = partial(self._read, use_threads=jobs > 2)
        # one pool reads and writes: more threads than processors only take the interpreter from each other
        with ThreadPoolExecutor(jobs) if jobs > 1 else nullcontext() as pool:
            self.writer.executor = pool
            try:
                for batch in in_order(read, batches_of(unsettled), pool, jobs):
                    for done in batch:
                        self._settle(done)
                    self.keeper.flush()
                self._written(self.writer.flush())
            except BaseException:
                self.writer.discard()
                raise
        if not self.dry_run:
            drop_superseded(self.processed, self.replaced)
            for device, experiment in sorted(self.writer.experiments):
                try:
                    merge_small(self.processed, device, experiment)
                except StoreError as error:  # a damaged batch stays with its experiment
                    self.damaged[trials_folder(self.processed, device, experiment)] = str(error)

    def wait_for(self, sources: Sequence[Source], settle_s: float) -> None:
        """List sources that are left for later."""
        for source in sources:
            self.waiting.append(source.shown)
            self._plan(source, "wait", f"modified less than {settle_s:g} s ago")

    def find_removed(self, folders: Sequence[Path], present: Set[str]) -> None:
        """List stored sources below the searched folders that are not there any more."""
        gone = removed_below(folders, self.stored, present)
        self.removed = sorted(key for key in gone if key not in self.renamed)

    def report(self, notices: Sequence[LogWarning]) -> IngestReport:
        """Return the counts."""
        warnings = [*self.warnings, *notices]
        return IngestReport(
            found=self.found,
            ingested=self.ingested,
            skipped=self.skipped,
            quarantined=tuple(sorted(self.refusals, key=lambda refusal: refusal.path)),
            warnings=tuple(sorted(warnings, key=lambda warning: warning.path)),
            removed=tuple(self.removed),
            changed=tuple(sorted(self.changed, key=lambda source: source.path)),
            waiting=tuple(sorted(self.waiting)),
            plan=tuple(sorted(self.plan, key=lambda source: source.path)) if self.dry_run else None,
            damaged=tuple(sorted(set(self.damaged.values()))),
        )

    def remember(self, report: IngestReport, notices: Sequence[LogWarning]) -> None:
        """Leave a note for the next run of the same command, which says nothing if that has to read a source again."""
        stored = ((source.key, source.size, source.mtime_ns) for source in self.kept if source.stands_alone)
        again = None if self.waiting or self.unread or self.damaged else repeated(report, tuple(notices))
        self.look.remember(stored, None if again is None else again.model_dump(mode="json"))

    def _plan(self, source: Source, action: Action, reason: str) -> None:
        if self.dry_run:
            self.plan.append(PlannedSource(path=source.shown, action=action, reason=reason))

    def _settled_unread(self, source: Source) -> bool:
        if self.rehash:
            return False
        sign = (source.size, source.mtime_ns, self._digest(source))
        stored, refused = self.stored.get(source.key), self.refused.get(source.key)
        # what could not be read may be readable now: permissions leave size and time alone; old records have no code
        readable = refused is not None and refused.sha256 is not None and refused.code is not None
        if (
            refused
            and readable
            and not self.replace
            and sign == (refused.size, refused.mtime_ns, refused.profile_sha256)
        ):
            self._refused(source, refused)
        elif stored and stored.whole and sign == (stored.size, stored.mtime_ns, stored.profile_sha256):
            self._skip(source, "unchanged: size and modification time")
            self.kept.append(source)
        else:
            return False
        self._advance()
        return True

    def _digest(self, source: Source) -> str | None:
        return self.digests[source.profile] if source.profile else None

    def _read(self, sources: list[Source], use_threads: bool) -> list[Read]:
        known = self.known.unread(sources[0].profile)
        return read_and_check(sources, known, self._digest(sources[0]), use_threads)[0]

    def _settle(self, read: Read) -> None:
        try:
            if isinstance(read.result, LogError):
                raise read.result
            self._accept(read, read.result)
        except LogError as error:
            self._refuse(read, error)
        self._advance()

    def _accept(self, read: Read, logs: tuple[Log, ...] | None) -> None:
        source, profile, sha256 = read.source, read.source.profile, read.sha256
        assert profile is not None, "a source without a profile has a problem, which is a LogError"
        assert sha256 is not None, "what was read has a hash"
        profile_sha256 = self.digests[profile]
        former = self.stored.get(source.key)
        same = former is not None and (former.sha256, former.profile_sha256) == (sha256, profile_sha256)
        stored_here = same and former is not None and former.whole
        reprofiled = former is not None and former.sha256 == sha256
        one = self.known.identity(sha256, profile_sha256, source.key)
        known, other = self.known.find(sha256, one)
        gone = self.known.gone.get(sha256) if logs is not None and profile.reads_names else None
        if gone is not None:
            # another name may state other conditions: a corrected name is no copy
            known = other = None
        if logs is None or stored_here or known == profile_sha256 or (known and not reprofiled):
            if known is None:
                self.known.add(one, profile_sha256, source.key)
            self._skip(source, "unchanged content" if other in (None, source.key) else f"same content as {other}")
            if profile.reads_names and other is not None and path_of_text(other).name != source.path.name:
                text = f"has the content of {other} under another name; left out. Remove the one that is wrong."
                self.warnings.append(LogWarning(path=source.shown, warning=text))
            if former is not None and not (same and other in (None, source.key)):
                # what stands here now is stored at another place, by this run where it stood here before
                moved = f"its content is now that of {other}; its former trials were removed"
                if same:
                    moved = f"{other} now has the same content; its trials are stored as those of that log"
                self._replace(source, former, moved)
            return
        outcome = None if former is None else outcome_for(former, source, sha256, logs, self.replace)
        accepted = accepted_logs(source, sha256, self.periods.apart(logs), profile, profile_sha256, self.motions, gone)
        # from here on nothing is refused
        self.kept.append(source)
        self.known.add(one, profile_sha256, source.key)
        self.ingested += 1
        if gone is not None:
            self._rename(source, self.known.gone.pop(sha256))
        texts = dict.fromkeys(text for one in accepted for text in one.warnings)
        self.warnings += [LogWarning(path=source.shown, warning=storable(text)) for text in texts]
        reason = why_ingested(former, sha256, profile_sha256) if gone is None else f"its name was {gone}"
        self._plan(source, "ingest", reason)
        if former is not None and not same:
            self._replace(source, former, outcome)
        if not self.dry_run:
            # an interrupted run may have stored some trials of this source
            present = former.trials if former is not None and same else frozenset[str]()
            self._written(self.writer.add([a for a in accepted if a.trial_id not in present]))

    def _replace(self, source: Source, former: StoredSource, outcome: str | None) -> None:
        """Note that the stored trials of a source give way to others; without an outcome its content is the same."""
        if outcome is not None:
            self.changed.append(ChangedSource(path=source.shown, outcome=outcome))
        if not self.dry_run:
            self.replaced |= former.keys(source.key)

    def _rename(self, source: Source, gone: str) -> None:
        """Note that the trials of a log that bore another name give way to those that are read by its present one."""
        self.renamed.add(gone)
        self.changed.append(ChangedSource(path=gone, outcome=f"is now {source.shown}; its trials were read anew"))
        if not self.dry_run:
            self.replaced |= self.stored[gone].keys(gone)

    def _skip(self, source: Source, reason: str) -> None:
        self.skipped += 1
        self._plan(source, "skip", reason)
        self._release(source)

    def _refuse(self, read: Read, error: LogError) -> None:
        source = read.source
        record = record_of(source, read.sha256, error, self._digest(source))
        self.unread |= read.sha256 is None
        self._refused(source, record)
        former = self.refused.get(source.key)
        if not self.dry_run and not record.same_refusal(former) and not record.knows_less(former):
            self.keeper.add(source, record)

    def _refused(self, source: Source, record: QuarantineRecord) -> None:
        refusal = refusal_of(source, record)
        self.refusals.append(refusal)
        self._plan(source, "refuse", refusal.reason)
        former = self.stored.get(source.key)
        # without a hash nobody has seen other bytes, but for a file that has become too long to be read
        if former is not None and former.sha256 != record.sha256 and (record.sha256 or record.code == "too-large"):
            outcome = "its new content is refused; the trials of the former one stay stored"
            self.changed.append(ChangedSource(path=source.shown, outcome=outcome))

    def _written(self, written: Sequence[Source]) -> None:
        for source in written:
            self._release(source)

    def _release(self, source: Source) -> None:
        if not self.refused or self.dry_run:
            return
        for key in {source.key, *(path_text(os.path.abspath(file)) for file in source.files)} & self.refused.keys():
            release(self.processed, key)

    def _advance(self) -> None:
        if self.progress:
            self.progress(self.ingested + self.skipped + len(self.refusals), self.found)

"""Logs to Parquet: find, recognise what is known, read in batches, validate, store, and refuse with a reason.

A log is known by its content; a source whose size and modification time are unchanged is not even opened. One ingest
writes at a time (`lock`); what it stores becomes visible batch by batch; the next one finishes an interrupted one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path

from pipeline.base.errors import LogError, StoreError, UsageError
from pipeline.base.file_names import path_of_text, path_text, storable
from pipeline.base.lock import WAIT_S, writing
from pipeline.base.process import Ended
from pipeline.base.provenance import digest
from pipeline.device_data.devices import known_devices
from pipeline.intake.ingest_report import (
    ChangedSource,
    IngestReport,
    LogWarning,
)
from pipeline.intake.known import Places, StoredSource, StoredSources, gone_of, stored_source
from pipeline.intake.periods import Periods
from pipeline.intake.quarantine import list_quarantine
from pipeline.intake.reading import Read, batches_of, in_order, read_and_check
from pipeline.intake.sources import Source, by_rest, find_sources, is_settled, removed_below
from pipeline.intake.tally import Tally
from pipeline.intake.trialstore import Accepted, TrialWriter, accepted_logs
from pipeline.profiles.profile_files import load_profile, shipped_profiles
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log
from pipeline.store.batch_files import merge_small, tidy
from pipeline.store.corrections import carry, read_corrections
from pipeline.store.mirror import renewed
from pipeline.store.storage import check_version

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
        Whether trials give way where another profile or device claims their log now; by default that is refused.
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
    check_version(processed)
    profiles = shipped_profiles() if profile is None else (load_profile(profile),)
    folders = [Path(path) for path in paths]
    digests = {each: each.digest() for each in profiles}
    run: _Ingest | None = None
    try:
        with nullcontext() if dry_run else writing(processed, wait_s, say):
            run = _Ingest(processed, dry_run, rehash, replace, digests, progress)

            def noticed(folder: Path, text: str) -> None:
                assert run is not None, "it is made above"
                run.warnings.append(LogWarning(path=path_text(folder), warning=text))

            unchanged = {} if dry_run or rehash else run.unchanged(settle_s, growing)
            sources = find_sources(folders, profiles, processed, noticed, unchanged, run.present)
            run.found = run.skipped = len(run.present)
            settled, waiting = by_rest(sources, settle_s, frozenset(growing))
            run.found += len(settled)
            run.present |= {source.key for source in sources}
            run.process(settled, jobs or min(4, os.cpu_count() or 1))
            run.wait_for(waiting, settle_s)
            run.find_removed(folders)
            return run.report()
    except (KeyboardInterrupt, Ended) as error:
        stored, kept = (0, 0) if run is None else (len(run.writer.visible), run.kept)
        error.add_note(
            f"{stored} new logs are stored in {processed} and {kept} more are in quarantine. The same command finds "
            "the rest again."
        )
        raise
    except OSError as error:
        raise StoreError(
            f"{processed}: cannot be written ({error}). Logs stored so far are complete; "
            "make room or correct the permissions and run the command again."
        ) from error


class _Ingest(Tally):
    """One run: what is stored already, what was decided so far."""

    def __init__(
        self,
        processed: Path,
        dry_run: bool,
        rehash: bool,
        replace: bool,
        digests: dict[Profile, str],
        progress: Callable[[int, int], None] | None,
    ) -> None:
        super().__init__(processed, dry_run, progress)
        self.rehash, self.replace, self.digests = rehash, replace, digests
        self.motions = {name: device.motion for name, device in known_devices().items()}
        claims = digest(sorted(digests.values()))
        self.stored = StoredSources(processed, claims, self.damaged)
        self.writer = TrialWriter(processed, PENDING_BYTES, claims, self.stored.latest)
        if not dry_run:
            tidy(processed, read=(self.stored.table, self.stored.files, self.stored.replaced))
        self.refused = {record.path: record for record in list_quarantine(processed, self.damaged)}
        self.replaced: set[tuple[str, str, str]] = set()
        self.present: set[str] = set()
        self.renamed: set[str] = set()
        self.places = Places({}, {})
        self.gone: dict[tuple[str, str], list[str]] = {}
        self.taken: dict[str, StoredSource] = {}
        self.deleted = set[str]()
        with suppress(StoreError):  # told by whoever computes
            self.deleted = {one.trial_id for one in read_corrections(processed).values() if one.deleted}
        self.carried: dict[str, str] = {}
        """Id of each trial that was renamed, and the one that it has now."""

    def unchanged(self, settle_s: float, growing: Collection[str]) -> dict[str, tuple[int, int]]:
        """Return size and time of the files that need no look while they have these."""
        states = self.stored.states
        for path in (*self.refused, *growing):
            states.pop(path, None)
        if settle_s:
            states = {path: state for path, state in states.items() if is_settled(state[1], settle_s)}
        return states

    def process(self, sources: list[Source], jobs: int) -> None:
        """Decide on every source and store what is new."""
        unsettled = [source for source in sources if not self._settled_unread(source)]
        if unsettled:
            # a source that is looked at again enters after that
            self.places = self.stored.places({source.key for source in unsettled})
            self.gone = gone_of(self.stored, self.present)
            self.periods = Periods(self.stored.table)
        # stored sources come first: a log that was copied and touched is recognised at its old place
        unsettled.sort(key=lambda source: (source.key not in self.stored, source.key))
        read = partial(self._read, use_threads=jobs > 2)
        with ThreadPoolExecutor(jobs) if jobs > 1 and unsettled else nullcontext() as pool:
            try:
                for batch in in_order(read, batches_of(unsettled), pool, jobs):
                    for done in batch:
                        self._settle(done)
                    self._keep()
                self._written(self.writer.flush())
            except BaseException:
                self.writer.discard()
                raise
        if self.dry_run:
            return
        if self.carried:
            carry(self.processed, self.carried)
        if self.replaced or renewed(self.processed, "trials"):
            tidy(self.processed, self.replaced)
        for folder in sorted(self.writer.folders):
            try:
                merge_small(self.processed, folder)
            except StoreError as error:  # a damaged file stays with its experiment
                self.damaged[folder] = str(error)

    def find_removed(self, folders: Sequence[Path]) -> None:
        """List stored sources below the searched folders that are not there any more."""
        gone = removed_below(folders, self.stored, self.present)
        self.removed = sorted(key for key in gone if key not in self.renamed)

    def _settled_unread(self, source: Source) -> bool:
        if self.rehash:
            return False
        sign = (source.size, source.mtime_ns, self._digest(source))
        stored, refused = self.stored.get(source.key), self.refused.get(source.key)
        # what could not be read may be readable now: permissions leave size and time alone
        readable = refused is not None and refused.sha256 is not None and not self.replace
        if refused and readable and sign == (refused.size, refused.mtime_ns, refused.profile_sha256):
            self._refused(source, refused)
        elif stored and stored.whole and sign == (stored.size, stored.mtime_ns, stored.profile_sha256):
            self._skip(source, "unchanged: size and modification time")
        else:
            return False
        self._advance()
        return True

    def _read(self, sources: list[Source], use_threads: bool) -> list[Read]:
        return read_and_check(sources, self._is_known, use_threads)

    def _is_known(self, source: Source, sha256: str) -> bool:
        """Return whether a content was read by the same profile and is stored as a whole, here or elsewhere."""
        former = self.stored.get(source.key)
        if former is not None and former.whole and former.sha256 == sha256:
            return former.profile_sha256 == self._digest(source)
        return self._same_profile(self.places.find(source, sha256), source)

    def _same_profile(self, path: str | None, source: Source) -> bool:
        """Return whether what is stored under a path was read by the profile that reads a source."""
        stored = self._at(path)
        return stored is not None and stored.profile_sha256 == self._digest(source)

    def _at(self, path: str | None) -> StoredSource | None:
        """Return what is stored under a path, by this run or before."""
        return None if path is None else self.taken.get(path) or self.stored.get(path)

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
        former = self.stored.get(source.key)
        other = self.places.find(source, sha256)
        if logs is None:
            self._known(source, sha256, former, other)
            return
        accepted = accepted_logs(source, sha256, self.periods.apart(logs), profile, self.digests[profile], self.motions)
        ids = [one.row["trial_id"] for one in accepted]
        places = {self.places.trials.get(trial) for trial in ids}
        other = (next(iter(places)) if len(places) == 1 else None) or other
        if former is not None and former.sha256 == sha256:
            other = None
        if self._same_profile(other, source):
            self._known(source, sha256, former, other)
            return
        rival = former if former is not None and former.sha256 == sha256 else self._at(other)
        outcome = self._outcome(source, rival, accepted)
        if outcome is None and rival is not None and rival is not former:
            self._known(source, sha256, former, other)  # another version of the profile read the other one
            return
        self._take(source, sha256, accepted, former, outcome)
        if rival is not None and rival is not former:
            self._replace(source, str(other), rival, outcome)

    def _outcome(self, source: Source, rival: StoredSource | None, accepted: Sequence[Accepted]) -> str | None:
        """Return what becomes of trials of the same content that another profile or device has; None where none has.

        Raises
        ------
        LogError
            If it was not asked that they give way.
        """
        now = sorted({one.log.header.device for one in accepted})
        if rival is None or (rival.profile, sorted(set(rival.devices))) == (accepted[0].row["profile"], now):
            return None
        before = f"device {', '.join(map(repr, sorted(set(rival.devices))))} by profile {rival.profile!r}"
        if not self.replace:
            raise LogError(
                f"is stored as a log of {before}; profile {accepted[0].row['profile']!r} claims it now for device "
                f"{', '.join(map(repr, now))}. Its trials stay as they are. Give --replace to read it as that now, or "
                "--profile to name the right one.",
                code="profile-wrong",
            )
        count = len(rival.trials)
        return f"{count} trial{'' if count == 1 else 's'} of {before} {'was' if count == 1 else 'were'} replaced"

    def _take(
        self,
        source: Source,
        sha256: str,
        accepted: Sequence[Accepted],
        former: StoredSource | None,
        outcome: str | None,
    ) -> None:
        """Store a log."""
        profile_sha256 = accepted[0].row["profile_sha256"]
        gone = None
        if source.profile is not None and source.profile.reads_names and former is None:
            paths = self.gone.get((sha256, profile_sha256), [])
            gone = paths.pop(0) if paths else None
        self.taken[source.key] = stored_source(accepted)
        self.places.add(source.key, sha256, self.taken[source.key].trials)
        self.ingested += 1
        texts = dict.fromkeys(text for one in accepted for text in one.log.warnings)
        if not self.deleted.isdisjoint(self.taken[source.key].trials):
            texts["was deleted by hand, and is in the bin: `pipeline delete ... --undo` takes it out."] = None
        self.warnings += [LogWarning(path=source.shown, warning=storable(text)) for text in texts]
        if gone is not None:
            # a corrected name is no copy: its trials give way to those that are read by the present one
            self.renamed.add(gone)
            for one, trial in zip(accepted, self.stored[gone].trials, strict=False):
                one.row["formerly"] = gone
                self.carried[trial] = one.row["trial_id"]
            told = f"is now {source.shown}; its trials were read anew"
            self._replace(source, gone, self.stored[gone], told, shown=gone)
        reason = _why(former, sha256, profile_sha256) if gone is None else f"its name was {gone}"
        self._plan(source, "ingest", reason)
        same = former is not None and (former.sha256, former.profile_sha256) == (sha256, profile_sha256)
        if former is not None and not same:
            changed = former.sha256 != sha256
            text = "its trials were replaced by those of the new content" if changed else outcome
            self._replace(source, source.key, former, text)
        if not self.dry_run:
            # an interrupted run may have stored some trials of this source
            present = former.trials if former is not None and same else ()
            self._written(self.writer.add([one for one in accepted if one.row["trial_id"] not in present]))

    def _known(self, source: Source, sha256: str, former: StoredSource | None, other: str | None) -> None:
        """Skip a log that is stored, here or under another path; what stood here before goes."""
        assert source.profile is not None, "it was read"
        same = former is not None and former.sha256 == sha256
        if other is None and not same:
            raise AssertionError("it is known by some path")
        if other is None:
            self.places.add(source.key, sha256, former.trials if former else ())
        self._skip(source, "unchanged content" if other in (None, source.key) else f"same content as {other}")
        if source.profile.reads_names and other is not None and path_of_text(other).name != source.path.name:
            text = f"has the content of {other} under another name; left out. Remove the one that is wrong."
            self.warnings.append(LogWarning(path=source.shown, warning=text))
        if former is not None and other not in (None, source.key):
            # what stands here now is stored at another place, by this run where it stood here before
            outcome = f"its content is now that of {other}; its former trials were removed"
            if same:
                outcome = f"{other} now has the same content; its trials are stored as those of that log"
            self._replace(source, source.key, former, outcome)

    def _replace(
        self, source: Source, path: str, former: StoredSource, outcome: str | None, shown: str | None = None
    ) -> None:
        """Drop the trials of a source, and say so where that is more than another version of its profile."""
        if outcome is not None:
            self.changed.append(ChangedSource(path=shown or source.shown, outcome=outcome))
        if not self.dry_run:
            self.replaced |= former.keys(path)


def _why(former: StoredSource | None, sha256: str, profile_sha256: str) -> str:
    """Return why a source with this content and profile is stored anew, by what was stored of it before."""
    if former is None:
        return "new"
    if former.sha256 != sha256:
        return "content changed"
    return "profile changed" if former.profile_sha256 != profile_sha256 else "stored in part, by an interrupted run"

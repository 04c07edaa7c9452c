"""Logs to Parquet: find, recognise what is known, read in batches, validate, store, and refuse with a reason.

A log is known by its content; a source whose size and modification time are unchanged is not even opened.
Every source ends as ingested, skipped or quarantined, and is never written, moved or locked.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

from pipeline.devices import known_devices
from pipeline.errors import LogError, StoreError, UsageError
from pipeline.models import Motion, Record
from pipeline.profiles import Profile, load_profile, shipped_profiles
from pipeline.quarantine import QuarantineRecord, list_quarantine, refuse, release
from pipeline.readers import Log, RawLog, reader_of
from pipeline.sources import Source, find_sources
from pipeline.storage import folder_name
from pipeline.trialstore import Accepted, TrialWriter, drop_superseded, stored_sources, trial_id

BATCH_LOGS = 256
BATCH_BYTES = 16 << 20
"""Logs and bytes of text parsed at once: enough to hide the cost per call, little memory."""

PENDING_BYTES = 64 << 20
"""Samples kept in memory before they are written; a course of 2,300 logs with 1,000 rows makes one file."""

LARGEST_LOG = 256 << 20
"""Bytes above which a file is not read: 10^6 times a usual log, so it is something else."""

LONGEST_FOLDER = 200
"""Longest folder name made of a device or experiment; file systems allow 255 bytes."""


class Refusal(Record):
    """A source in quarantine: path as found, why, and the line at fault, counted from 1."""

    path: str
    reason: str
    row: int | None


class LogWarning(Record):
    """What was accepted in a source and should be known."""

    path: str
    warning: str


class IngestReport(Record):
    """Number of logs by what became of them; ``found = ingested + skipped + len(quarantined)``.

    A log is a source file (or pair of files), also where it holds several trials. ``warnings`` tell of logs that were
    ingested now although something in them is not as it should be.
    """

    found: int
    ingested: int
    skipped: int
    quarantined: tuple[Refusal, ...]
    warnings: tuple[LogWarning, ...] = ()


@dataclass(frozen=True, eq=False)
class _Read:
    """A source after reading: its logs, a refusal, or neither where its content is stored already."""

    source: Source
    sha256: str | None
    result: tuple[Log, ...] | LogError | None


def ingest(
    paths: Sequence[Path],
    processed: Path,
    profile: str | Path | None = None,
    jobs: int | None = None,
    dry_run: bool = False,
    rehash: bool = False,
    progress: Callable[[int, int], None] | None = None,
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
        Read and validate, write nothing.
    rehash : bool
        Look at the content also where size and modification time are unchanged.
    progress : callable, optional
        Called with (logs done, logs found).

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
        If `processed` is damaged or cannot be written; what was stored before stays valid.
    """
    if jobs is not None and jobs < 1:
        raise UsageError(f"jobs must be at least 1, found {jobs}. Leave it out for one per processor.")
    profiles = shipped_profiles() if profile is None else (load_profile(profile),)
    sources = find_sources([Path(path) for path in paths], profiles, processed)
    run = _Ingest(processed, dry_run, rehash, {p: p.digest() for p in profiles}, len(sources), progress)
    try:
        run.process(sources, jobs or min(4, os.cpu_count() or 1))
    except OSError as error:
        raise StoreError(
            f"{processed}: cannot be written ({error}). Logs stored so far are complete; "
            "make room or correct the permissions and run the command again."
        ) from error
    return run.report()


class _Ingest:
    """One run: what is stored already, what was decided so far."""

    def __init__(
        self,
        processed: Path,
        dry_run: bool,
        rehash: bool,
        digests: dict[Profile, str],
        found: int,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.processed, self.dry_run, self.rehash, self.digests = processed, dry_run, rehash, digests
        self.found, self.progress = found, progress
        self.ingested = self.skipped = 0
        self.refusals: list[Refusal] = []
        self.warnings: list[LogWarning] = []
        self.writer = TrialWriter(processed, PENDING_BYTES)
        self.motions = {name: device.motion for name, device in known_devices().items()}
        self.stored = stored_sources(processed)
        self.refused = {record.path: record for record in list_quarantine(processed)}
        self.replaced: set[tuple[str, str, str]] = set()
        # hash of a content -> hash of the profile that read it; a source that is looked at again enters after that
        self.known: dict[str, str] = {}

    def process(self, sources: list[Source], jobs: int) -> None:
        """Decide on every source and store what is new."""
        waiting = []
        for source in sources:
            if not self._settled_unread(source):
                waiting.append(source)
        again = {source.key for source in waiting}
        self.known = {s.sha256: s.profile_sha256 for path, s in self.stored.items() if path not in again and s.whole}
        # stored sources come first: a log that was copied and touched is recognised at its old place
        waiting.sort(key=lambda source: (source.key not in self.stored, source.key))
        for batch in _in_order(partial(self._read_batch, use_threads=jobs > 1), _batches(waiting), jobs):
            for read in batch:
                self._settle(read)
        self._written(self.writer.flush())
        drop_superseded(self.processed, self.replaced)

    def report(self) -> IngestReport:
        """Return the counts."""
        refusals = tuple(sorted(self.refusals, key=lambda refusal: refusal.path))
        return IngestReport(
            found=self.found,
            ingested=self.ingested,
            skipped=self.skipped,
            quarantined=refusals,
            warnings=tuple(sorted(self.warnings, key=lambda warning: warning.path)),
        )

    def _settled_unread(self, source: Source) -> bool:
        if self.rehash:
            return False
        sign = (source.size, source.mtime_ns, self._digest(source))
        stored, refused = self.stored.get(source.key), self.refused.get(source.key)
        # what could not be read may be readable now: permissions leave size and time alone
        readable = refused is not None and refused.sha256 is not None
        if refused and readable and sign == (refused.size, refused.mtime_ns, refused.profile_sha256):
            self.refusals.append(Refusal(path=str(source.path), reason=refused.reason, row=refused.row))
        elif stored and stored.whole and sign == (stored.size, stored.mtime_ns, stored.profile_sha256):
            self.skipped += 1
            self._release(source)
        else:
            return False
        self._advance()
        return True

    def _digest(self, source: Source) -> str | None:
        return self.digests[source.profile] if source.profile else None

    def _read_batch(self, sources: list[Source], use_threads: bool) -> list[_Read]:
        """Read, hash and parse sources of one profile; runs in a thread, so it changes nothing."""
        reads: list[_Read | None] = [None] * len(sources)
        raws: dict[int, tuple[RawLog, str]] = {}
        for index, source in enumerate(sources):
            sha256 = None
            try:
                raw, sha256 = load_source(source)
            except LogError as error:
                reads[index] = _Read(source, sha256, error)
                continue
            if self.known.get(sha256) == self._digest(source):
                reads[index] = _Read(source, sha256, None)
            else:
                raws[index] = (raw, sha256)
        profile = sources[0].profile
        if raws and profile:
            outcomes = reader_of(profile)(profile, [raw for raw, _ in raws.values()], use_threads)
            for (index, (_, sha256)), outcome in zip(raws.items(), outcomes, strict=True):
                reads[index] = _Read(sources[index], sha256, outcome)
        return [read for read in reads if read is not None]

    def _settle(self, read: _Read) -> None:
        source, profile = read.source, read.source.profile
        try:
            if isinstance(read.result, LogError):
                raise read.result
            assert profile is not None, "a source without a profile has a problem, which is a LogError"
            assert read.sha256 is not None, "what was read has a hash"
            self._accept(source, profile, read.sha256, read.result)
        except LogError as error:
            self._refuse(read, error)
        self._advance()

    def _accept(self, source: Source, profile: Profile, sha256: str, logs: tuple[Log, ...] | None) -> None:
        profile_sha256 = self.digests[profile]
        former = self.stored.get(source.key)
        same = former is not None and (former.sha256, former.profile_sha256) == (sha256, profile_sha256)
        stored_here = same and former is not None and former.whole
        known = self.known.get(sha256)
        if logs is None or stored_here or known == profile_sha256 or (known and not self._reprofiled(source, sha256)):
            self.known.setdefault(sha256, profile_sha256)
            self.skipped += 1
            self._release(source)
            if former is not None and not same and not self.dry_run:
                # the content that stood here is gone, what stands here now is stored at another place
                self.replaced |= former.keys(source.key)
            return
        accepted = [
            Accepted(trial_id(sha256, log.label), sha256, source, log, motion, profile.name, profile_sha256, len(logs))
            for log, motion in [(log, motion_of(log, self.motions)) for log in logs]
        ]
        self.known[sha256] = profile_sha256
        self.ingested += 1
        texts = dict.fromkeys(text for log in logs for text in log.warnings)
        self.warnings += [LogWarning(path=str(source.path), warning=text) for text in texts]
        if self.dry_run:
            return
        if former is not None and not same:
            self.replaced |= former.keys(source.key)
        # an interrupted run may have stored some trials of this source
        present = former.trials if former is not None and same else frozenset[str]()
        self._written(self.writer.add([a for a in accepted if a.trial_id not in present]))

    def _reprofiled(self, source: Source, sha256: str) -> bool:
        """Return whether this is the stored source of a content, now read by another profile, or stored in part."""
        former = self.stored.get(source.key)
        return former is not None and former.sha256 == sha256

    def _refuse(self, read: _Read, error: LogError) -> None:
        source = read.source
        self.refusals.append(Refusal(path=str(source.path), reason=error.reason, row=error.row))
        if self.dry_run:
            return
        record = QuarantineRecord(
            path=source.key,
            size=source.size,
            mtime_ns=source.mtime_ns,
            sha256=read.sha256,
            row=error.row,
            reason=error.reason,
            profile=source.profile.name if source.profile else None,
            profile_sha256=self._digest(source),
        )
        if record != self.refused.get(source.key):
            refuse(self.processed, record, source.files)

    def _written(self, written: list[Accepted]) -> None:
        for accepted in written:
            self._release(accepted.source)

    def _release(self, source: Source) -> None:
        for key in {source.key, *(os.path.abspath(file) for file in source.files)} & self.refused.keys():
            if not self.dry_run:
                release(self.processed, key)

    def _advance(self) -> None:
        if self.progress:
            self.progress(self.ingested + self.skipped + len(self.refusals), self.found)


def motion_of(log: Log, known: Mapping[str, Motion]) -> Motion:
    """Return the motion of a log whose names can be stored.

    Parameters
    ----------
    log : Log
    known : mapping of str to {"translation", "rotation"}
        Motion of each device that has a device file.

    Raises
    ------
    LogError
        If a name is too long for a folder, or the log contradicts the device file.
    """
    header = log.header
    for key in ("device", "experiment"):
        name = getattr(header, key)
        if len(folder_name(name)) > LONGEST_FOLDER:
            raise LogError(f"{key} {name!r} is too long for a folder name; shorten it or use ASCII letters.")
    device = known.get(header.device)
    if device and header.motion and device != header.motion:
        raise LogError(
            f"motion is {header.motion}, but the device {header.device!r} has {device}. "
            "Correct the log, or give its device another name."
        )
    return header.motion or device or "translation"


def load_source(source: Source) -> tuple[RawLog, str]:
    """Return the bytes and the SHA-256 of a source.

    Raises
    ------
    LogError
        If it is too large, cannot be read, or no profile claims it.
    """
    if source.size > LARGEST_LOG:
        raise LogError(
            f"file has {source.size} bytes; expected a log of one step response, at most {LARGEST_LOG}. "
            "Split the recording into single responses."
        )
    if source.problem:
        raise LogError(source.problem)
    try:
        data = tuple(file.read_bytes() for file in source.files)
    except OSError as error:
        raise LogError(f"file cannot be read ({error.strerror}). Correct its permissions.") from error
    if sum(len(part) for part in data) != source.size:
        raise LogError("file changed while it was read; expected a finished recording. Run the command again.")
    hashes = [hashlib.sha256(part).hexdigest() for part in data]
    sha256 = hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()
    return RawLog(tuple(file.name for file in source.files), data), sha256


def _batches(sources: list[Source]) -> Iterator[list[Source]]:
    """Cut sources into runs of one profile, at most `BATCH_LOGS` logs or `BATCH_BYTES` bytes (or one log)."""
    batch: list[Source] = []
    size = 0
    for source in sources:
        full = len(batch) >= BATCH_LOGS or size + source.size > BATCH_BYTES
        if batch and (full or batch[0].profile is not source.profile):
            yield batch
            batch, size = [], 0
        batch.append(source)
        size += source.size
    if batch:
        yield batch


def _in_order(
    work: Callable[[list[Source]], list[_Read]], batches: Iterator[list[Source]], jobs: int
) -> Iterator[list[_Read]]:
    """Work on batches in threads and yield the results in order, at most `jobs` ahead: memory is bounded."""
    if jobs == 1:
        yield from map(work, batches)
        return
    with ThreadPoolExecutor(jobs) as pool:
        running: list[Future[list[_Read]]] = [pool.submit(work, batch) for batch in islice(batches, jobs)]
        while running:
            done = running.pop(0).result()
            running += [pool.submit(work, batch) for batch in islice(batches, 1)]
            yield done

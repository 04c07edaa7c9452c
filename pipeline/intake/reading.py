"""The part of an ingest that changes nothing: sources to checked logs, in batches that share a profile."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from itertools import islice

from pipeline.base.errors import LogError, refusal
from pipeline.base.paths import open_regular, storable
from pipeline.intake.sources import Source
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log, RawLog, reader_of
from pipeline.readers.limits import LARGEST_LOG
from pipeline.records.findings import Motion
from pipeline.store.names import folder_name

BATCH_LOGS = 256
BATCH_BYTES = 6 << 20
"""Logs and bytes of text parsed at once: enough to hide the cost per call, little memory."""

LONGEST_FOLDER = 200
"""Longest folder name made of a device or experiment; file systems allow 255 bytes."""

SHORT_NAME = LONGEST_FOLDER // 12
"""Characters of a name that is not too long, whatever they are: each makes twelve at most."""


@dataclass(frozen=True, eq=False)
class Read:
    """A source after reading: its logs, a refusal, or neither where its content is stored already.

    ``source`` bears the size and time that the files had while they were read.
    """

    source: Source
    sha256: str | None
    result: tuple[Log, ...] | LogError | None


def read_and_check(
    sources: Sequence[Source], known: Callable[[Source, str], bool], use_threads: bool = False
) -> list[Read]:
    """Read, hash, parse and check sources of one profile, in the order given.

    It writes and keeps nothing, so that it may run in a thread.

    Parameters
    ----------
    sources : sequence of Source
        All claimed by the same profile, or by none; at most some MB together, which are held in memory.
    known : callable
        Whether a source with a content (its SHA-256) is stored already; such a source is not parsed.
    use_threads : bool
        Whether parsing may use several processors.
    """
    reads: dict[int, Read] = {}
    raws: dict[int, RawLog] = {}
    for index, source in enumerate(sources):
        try:
            raw, sha256, seen = load_source(source)
        except LogError as error:
            reads[index] = Read(source, None, error)
            continue
        reads[index] = Read(seen, sha256, None)
        if not known(source, sha256):
            raws[index] = raw
    profile = sources[0].profile if sources else None
    if raws and profile:
        outcomes = reader_of(profile)(profile, list(raws.values()), use_threads)
        for index, outcome in zip(raws, outcomes, strict=True):
            reads[index] = replace(reads[index], result=outcome)
    for read in reads.values():
        if isinstance(read.result, LogError):
            _forget_frames(read.result)
    return list(reads.values())


def logs_of(source: Source) -> tuple[Profile, RawLog, tuple[Log, ...]]:
    """Read one source: the profile that claims it, the log as it stands, and the logs that the profile makes of it.

    Raises
    ------
    LogError
        If it is refused, with the row at fault.
    """
    raw, _, _ = load_source(source)
    assert source.profile is not None, "a source that no profile claims is refused by load_source"
    (outcome,) = reader_of(source.profile)(source.profile, [raw], False)
    if isinstance(outcome, LogError):
        raise outcome
    return source.profile, raw, outcome


def _forget_frames(error: BaseException) -> None:
    """Let go of the frames in which an error was raised: they hold the bytes of logs until cycles are collected."""
    error.__traceback__ = error.__cause__ = error.__context__ = None


def load_source(source: Source) -> tuple[RawLog, str, Source]:
    """Return the bytes and the SHA-256 of a source, and the source with the size and time that it had meanwhile.

    Raises
    ------
    LogError
        If it is too large, cannot be read, changes while it is read, or no profile claims it.
    """
    if source.size > LARGEST_LOG:
        expected = f"a log of one step response, at most {LARGEST_LOG}"
        raise refusal("too-large", "", f"file has {source.size} bytes", expected)
    if source.problem:
        raise source.problem
    data = []
    size, mtime_ns = 0, 0
    for file in source.files:
        try:
            with open_regular(file) as stream:
                before = os.fstat(stream.fileno())
                data.append(stream.read(min(before.st_size, LARGEST_LOG) + 1))
                after = os.fstat(stream.fileno())
        except OSError as error:
            raise refusal("unreadable", "", f"file cannot be read ({error.strerror})") from error
        if (before.st_size, before.st_mtime_ns) != (len(data[-1]), after.st_mtime_ns):
            raise refusal("changed-while-read", "", "file changed while it was read", "a finished recording")
        size, mtime_ns = size + after.st_size, max(mtime_ns, after.st_mtime_ns)
    hashes = [hashlib.sha256(part).hexdigest() for part in data]
    sha256 = hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()
    raw = RawLog(tuple(storable(file.name) for file in source.files), tuple(data))
    if (size, mtime_ns) != (source.size, source.mtime_ns):
        source = replace(source, size=size, mtime_ns=mtime_ns)
    return raw, sha256, source


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
        if len(name) > SHORT_NAME and len(folder_name(name)) > LONGEST_FOLDER:
            cure = "Shorten it, or use ASCII letters."
            raise refusal("condition-wrong", "", f"{key} {name!r} is too long for a folder name", cure=cure)
    device = known.get(header.device)
    if device and header.motion and device != header.motion:
        found = f"motion is {header.motion}, but the device {header.device!r} has {device}"
        raise refusal("condition-wrong", "", found, cure="Correct the log, or give its device another name.")
    return header.motion or device or "translation"


def batches_of(sources: Sequence[Source]) -> Iterator[list[Source]]:
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


def in_order(
    work: Callable[[list[Source]], list[Read]], batches: Iterator[list[Source]], pool: Executor | None, ahead: int
) -> Iterator[list[Read]]:
    """Work on batches in the threads of a pool, by default in the caller's, and yield the results in order.

    At most so many batches are ahead, so that memory is bounded.
    """
    if pool is None:
        yield from map(work, batches)
        return
    running: list[Future[list[Read]]] = [pool.submit(work, batch) for batch in islice(batches, ahead)]
    while running:
        done = running.pop(0).result()
        running += [pool.submit(work, batch) for batch in islice(batches, 1)]
        yield done

"""What an ingest tells: what became of each log, which were refused, and what is not as it was."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipeline.records.findings import Record

Action = Literal["ingest", "skip", "refuse", "wait"]


@dataclass(frozen=True, slots=True)
class Refusal:
    """A source in quarantine: path as found, why, the row at fault, counted from 1, and what `errors.LogError` adds."""

    path: str
    reason: str
    row: int | None
    code: str | None = None
    profile_line: str | None = None


@dataclass(frozen=True, slots=True)
class LogWarning:
    """What was accepted in a source and should be known."""

    path: str
    warning: str


@dataclass(frozen=True, slots=True)
class ChangedSource:
    """A source whose content is not the one that is stored, and what became of the stored trials."""

    path: str
    outcome: str


@dataclass(frozen=True, slots=True)
class PlannedSource:
    """What is done with a source, or would be by a dry run, and why."""

    path: str
    action: Action
    reason: str


class IngestReport(Record):
    """Number of logs by what became of them; ``found = ingested + skipped + len(quarantined)``.

    A log is a source file (or pair of files), also where it holds several trials.

    Parameters
    ----------
    found, ingested, skipped : int
    quarantined : tuple of Refusal
    warnings : tuple of LogWarning
        Logs that were ingested now although something in them is not as it should be.
    removed : tuple of str
        Sources that are stored and stand no more below the searched folders; their trials stay stored.
    changed : tuple of ChangedSource
        Sources whose content differs from the stored one.
    waiting : tuple of str
        Sources that changed a moment ago and were left for later; they do not count as found.
    plan : tuple of PlannedSource or None
        With a dry run: what would be done with each source, those that wait included.
    damaged : tuple of str
        Stored files that are damaged, with what to do; their logs count as new, all others are as ever.
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

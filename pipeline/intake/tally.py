"""What an ingest counts and tells of each source: taken, skipped, refused, changed, or left for later."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pipeline.base.errors import LogError
from pipeline.base.file_names import path_text
from pipeline.intake.ingest_report import (
    Action,
    ChangedSource,
    IngestReport,
    LogWarning,
    PlannedSource,
    Refusal,
    refusal_of,
)
from pipeline.intake.known import StoredSources
from pipeline.intake.quarantine import REFUSED_TOGETHER, QuarantineRecord, keep, record_of, release
from pipeline.intake.reading import Read
from pipeline.intake.sources import Source
from pipeline.profiles.profile_model import Profile


class Tally:
    """What became of each source so far, and the quarantine."""

    stored: StoredSources
    refused: Mapping[str, QuarantineRecord]
    digests: Mapping[Profile, str]

    def __init__(self, processed: Path, dry_run: bool, progress: Callable[[int, int], None] | None) -> None:
        self.processed, self.dry_run, self.progress = processed, dry_run, progress
        self.found = self.ingested = self.skipped = 0
        self.refusals: list[Refusal] = []
        self.kept, self._keeping = 0, list[tuple[Source, QuarantineRecord]]()
        self.warnings: list[LogWarning] = []
        self.changed: list[ChangedSource] = []
        self.removed, self.waiting = list[str](), list[str]()
        self.plan: list[PlannedSource] = []
        self.damaged: dict[Path, str] = {}

    def wait_for(self, sources: Sequence[Source], settle_s: float) -> None:
        """List sources that are left for later."""
        for source in sources:
            self.waiting.append(source.shown)
            self._plan(source, "wait", f"modified less than {settle_s:g} s ago")

    def report(self) -> IngestReport:
        """Return the counts."""
        return IngestReport(
            found=self.found,
            ingested=self.ingested,
            skipped=self.skipped,
            quarantined=tuple(sorted(self.refusals, key=lambda refusal: refusal.path)),
            warnings=tuple(sorted(self.warnings, key=lambda warning: warning.path)),
            removed=tuple(self.removed),
            changed=tuple(sorted(self.changed, key=lambda source: source.path)),
            waiting=tuple(sorted(self.waiting)),
            plan=tuple(sorted(self.plan, key=lambda source: source.path)) if self.dry_run else None,
            damaged=tuple(sorted(set(self.damaged.values()))),
        )

    def _plan(self, source: Source, action: Action, reason: str) -> None:
        if self.dry_run:
            self.plan.append(PlannedSource(path=source.shown, action=action, reason=reason))

    def _skip(self, source: Source, reason: str) -> None:
        self.skipped += 1
        self._plan(source, "skip", reason)
        self._release(source)

    def _refuse(self, read: Read, error: LogError) -> None:
        source = read.source
        record = record_of(source, read.sha256, error, self._digest(source))
        self._refused(source, record)
        former = self.refused.get(source.key)
        if not self.dry_run and record != former and not record.knows_less(former):
            self._keeping.append((source, record))
            if len(self._keeping) >= REFUSED_TOGETHER:
                self._keep()

    def _keep(self) -> None:
        """Put into quarantine what was refused."""
        keep(self.processed, self._keeping)
        self.kept += len(self._keeping)
        self._keeping.clear()

    def _refused(self, source: Source, record: QuarantineRecord) -> None:
        refusal = refusal_of(source, record)
        self.refusals.append(refusal)
        self._plan(source, "refuse", refusal.reason)
        former = self.stored.get(source.key)
        # without a hash nobody has seen other bytes, but for a file that has become too long to be read
        seen = record.sha256 is not None or record.code == "too-large"
        if former is not None and former.sha256 != record.sha256 and seen:
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

    def _digest(self, source: Source) -> str | None:
        return self.digests[source.profile] if source.profile else None

"""Trials of a damaged batch that are read again from their logs, where these are still what was stored."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import pyarrow as pa

from pipeline.base.errors import LogError, ProfileError, UsageError
from pipeline.base.file_names import path_of_text
from pipeline.base.regular_files import is_gone
from pipeline.device_data.devices import known_devices
from pipeline.intake.reading import batches_of, load_source, read_and_check
from pipeline.intake.sources import Source, find_sources
from pipeline.intake.trialstore import TrialWriter, accepted_logs
from pipeline.profiles.profile_model import Profile

_PENDING_BYTES = 64 << 20
"""Samples that are collected before they become visible, as by an ingest."""


def same_logs(trials: pa.Table, profiles: Sequence[Profile]) -> dict[str, Source]:
    """Return the logs of trials that are where they were, with the content and the profile of then, by path."""
    digests = {profile: profile.digest() for profile in profiles}
    columns = ("source_path", "source_sha256", "profile_sha256")
    found = {}
    for path, sha256, profile in sorted(set(zip(*(trials.column(name).to_pylist() for name in columns), strict=True))):
        source = _source_at(path, tuple(profiles))
        if source is None or source.profile is None or digests[source.profile] != profile:
            continue
        try:
            if load_source(source)[1] == sha256:
                found[path] = source
        except LogError:  # it can no longer be read
            continue
    return found


def _source_at(path: str, profiles: tuple[Profile, ...]) -> Source | None:
    file = path_of_text(path)
    if is_gone(file):
        return None
    try:
        return next((source for source in find_sources([file], profiles) if source.key == path), None)
    except (UsageError, ProfileError):
        return None


def read_again(processed: Path, sources: Collection[Source], wanted: Collection[str]) -> set[str]:
    """Store trials of logs anew; return the ids of those that were. The caller holds the lock."""
    motions = {name: device.motion for name, device in known_devices().items()}
    writer = TrialWriter(processed, _PENDING_BYTES)
    stored: set[str] = set()
    try:
        for batch in batches_of(sorted(sources, key=lambda source: source.profile.name if source.profile else "")):
            profile = batch[0].profile
            assert profile is not None, "`same_logs` returns no other"
            for read in read_and_check(batch, {}, profile.digest())[0]:
                if not isinstance(read.result, tuple) or read.sha256 is None:
                    continue
                try:
                    trials = accepted_logs(read.source, read.sha256, read.result, profile, profile.digest(), motions)
                except LogError:  # a device file contradicts it by now
                    continue
                again = [trial for trial in trials if trial.trial_id in wanted]
                writer.add(again)
                stored |= {trial.trial_id for trial in again}
        writer.flush()
    except BaseException:
        writer.discard()
        raise
    return stored

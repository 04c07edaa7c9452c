"""Readers: one small module per file format, and one that converts their columns to SI.

A format module turns bytes into `FileColumns` (`pipeline.readers.file_columns`), `pipeline.readers.mapping` turns these
columns into logs. The native log has a separate reader, which parses many files at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from pipeline.base.errors import LogError
from pipeline.profiles.profile_model import Profile
from pipeline.readers.log import Log, RawLog, check_samples, find_together

__all__ = ["Log", "Outcome", "RawLog", "Reader", "check_samples", "find_together", "reader_of"]

Outcome = tuple[Log, ...] | LogError
"""The logs in a raw log (one or several), or the reason why it is refused."""

Reader = Callable[[Profile, Sequence[RawLog]], list[Outcome]]
"""Function ``read(profile, raws)`` that gives one outcome for each raw log, in the order given."""


def reader_of(profile: Profile) -> Reader:
    """Return the reader of a profile's format."""
    module: Any = import_module(f"pipeline.readers.{'formats.native' if profile.format == 'native' else 'mapping'}")
    read: Reader = module.read
    return read

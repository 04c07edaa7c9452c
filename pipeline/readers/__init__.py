"""Readers of log files. Each file format has a module, and one module converts columns to SI.

A format module converts bytes to `FileColumns` (`pipeline.readers.file_columns`), and `pipeline.readers.mapping`
converts these columns to logs. A separate reader for native logs parses many files together.
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
"""The logs read from a raw log, or the error with which the raw log is refused."""

Reader = Callable[[Profile, Sequence[RawLog]], list[Outcome]]
"""Function ``read(profile, raws)`` that returns one outcome for each raw log, in the same order."""


def reader_of(profile: Profile) -> Reader:
    """Return the reader for the format of a profile."""
    module: Any = import_module(f"pipeline.readers.{'formats.native' if profile.format == 'native' else 'mapping'}")
    read: Reader = module.read
    return read

"""Errors that a user can act on, and the exit status of each.

Every message says what is wrong, where, what was expected and found, and what to do.
"""

from __future__ import annotations

from typing import Literal, Self

Code = Literal[
    "empty",
    "too-short",
    "encoding",
    "header-missing",
    "column-missing",
    "row-length",
    "not-a-number",
    "no-value",
    "not-finite",
    "out-of-range",
    "time-backwards",
    "time-wrong",
    "condition-missing",
    "condition-wrong",
    "profile-wrong",
    "no-profile",
    "lengths-differ",
    "partner-missing",
    "too-large",
    "too-long-line",
    "too-many-columns",
    "too-deep",
    "unpacks-too-large",
    "unreadable",
    "not-regular",
    "link-outside",
    "changed-while-read",
    "syntax",
    "damaged",
    "unsupported",
    "library-missing",
    "invalid",
]
"""Why a log is refused, for programs: a closed list, explained in docs/logs.md. The words of reasons may change."""

OTHER_COLUMNS: frozenset[Code] = frozenset({"no-profile", "header-missing", "column-missing"})
"""Codes of a log that is of another form than its profile describes."""

EXIT_OK = 0
EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_QUARANTINED = 3


REMEDY = "`pipeline check` tells what can be saved, `pipeline check --repair` saves it."
"""What to do about a damaged file below `processed`."""


class PipelineError(Exception):
    """Base of all errors that `pipeline` raises on purpose; the command line turns it into exit status 1."""

    exit_status = EXIT_ERROR


class UsageError(PipelineError):
    """A command was called with values that do not fit together."""

    exit_status = EXIT_USAGE


class LogError(PipelineError):
    """A log cannot be accepted; it goes into quarantine with this reason.

    Parameters
    ----------
    reason : str
        What is wrong, expected, found and what to do.
    row : int, optional
        Row of the source file, counted from 1: its line, where the format has lines, else record, sample or message.
    code : str
        One of `Code`.
    profile_line : str, optional
        Line (or lines) of a profile by which the log might be read.
    """

    def __init__(
        self, reason: str, row: int | None = None, *, code: Code = "invalid", profile_line: str | None = None
    ) -> None:
        super().__init__(reason)
        self.reason = reason
        self.row = row
        self.code = code
        self.profile_line = profile_line

    def reworded(self, reason: str) -> Self:
        """Return the same refusal in other words, such as with the file in front."""
        return type(self)(reason, self.row, code=self.code, profile_line=self.profile_line)


class ProfileError(PipelineError):
    """A log profile (TOML) is wrong or does not fit the files."""


class SceneError(PipelineError):
    """A scene file (TOML) is wrong."""


class DeviceError(PipelineError):
    """A device file (TOML) is wrong, or a device or experiment is not known."""


class StoreError(PipelineError):
    """A file in `processed/` is missing, of another layout or damaged."""


class ParameterError(PipelineError, ValueError):
    """A number lies outside the range for which a quantity is defined."""

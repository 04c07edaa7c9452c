"""Errors that a user can act on, with the exit status of each class.

Every message states the fault, its place, the expected value, the actual value and the remedy.
"""

from __future__ import annotations

import shlex
from typing import Self

CURES: dict[str, str] = {
    "empty": "Record the log again.",
    "too-short": "Was the recording cut off? Record it again.",
    "encoding": 'Save the file as UTF-8, or state its encoding in the profile, such as encoding = "latin-1".',
    "header-missing": "Correct the layout in the profile, or export the file again.",
    "column-missing": "Correct the name in the profile, or the file.",
    "row-length": "Repair the row, or leave this log out.",
    "not-a-number": "Repair the row, or leave this log out.",
    "no-value": "Fill in or drop these rows, or use a different column.",
    "not-finite": "Repair the row, or leave this log out.",
    "out-of-range": "Repair the row, or leave this log out.",
    "time-backwards": "Correct duplicate or swapped rows, or leave this log out.",
    "time-wrong": "Correct [columns.time] of the profile, or repair the rows.",
    "condition-missing": "Correct the profile, or the file.",
    "condition-wrong": "Correct the profile (name_pattern, attributes, condition_columns, [[file]]) or the file.",
    "profile-wrong": "Correct the profile.",
    "no-profile": "Remove the file, correct `files` of the profile, or select a profile with --profile.",
    "lengths-differ": "Choose signals that were recorded together, with their common time stamps.",
    "partner-missing": "Put all files of the log into one folder.",
    "too-large": "Split the recording into single responses, or export the columns that are needed.",
    "unpacks-too-large": (
        "The file is damaged, or is not a log of a single step response. Export it again with only the required "
        "columns."
    ),
    "unreadable": "Correct the permissions of the file.",
    "not-regular": "Copy the content of the log to a regular file.",
    "changed-while-read": "Run the command again.",
    "syntax": "The file is truncated or damaged. Record the log again.",
    "damaged": (
        "The file is truncated, damaged or in a different format. Copy or export it again, or correct `format` in the "
        "profile."
    ),
    "unsupported": "Correct `format` in the profile, or export the file again.",
    "library-missing": "Install the library.",
}
"""Default remedy for each machine-readable reason to refuse a log. The set of reasons is closed and explained in
docs/logs.md. The wording of messages may change."""

HELPS = "This might help in the profile:"
"""Text before the suggested profile line at the end of a reason."""

OTHER_COLUMNS = frozenset({"no-profile", "header-missing", "column-missing"})
"""Codes of a log whose layout differs from its profile."""


def draft_hint(log: str) -> str:
    """Return a hint for a log whose columns match no profile."""
    return f"Other columns? pipeline profile draft {shlex.quote(log)}"


EXIT_OK = 0
EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_QUARANTINED = 3


REMEDY = "`pipeline check` lists the data that can be recovered, and `pipeline check --repair` recovers them."
"""Remedy for a damaged file in the folder `processed`."""


class PipelineError(Exception):
    """Base class of all errors that `pipeline` raises deliberately. The command line then exits with status 1."""

    exit_status = EXIT_ERROR


class UsageError(PipelineError):
    """A command was called with values that are invalid or contradict each other."""

    exit_status = EXIT_USAGE


class LogError(PipelineError):
    """A log cannot be accepted and is quarantined.

    Parameters
    ----------
    reason : str
        The fault, the expected value, the actual value and the remedy.
    row : int, optional
        Row of the source file, counted from 1. A row is a line of a text file, otherwise a record, sample or message.
    code : str
        A key of `CURES`.
    profile_line : str, optional
        One or more profile lines with which the log might be readable.
    """

    def __init__(
        self, reason: str, row: int | None = None, *, code: str = "damaged", profile_line: str | None = None
    ) -> None:
        super().__init__(reason)
        self.reason = reason
        self.row = row
        self.code = code
        self.profile_line = profile_line

    def reworded(self, reason: str) -> Self:
        """Return the same refusal with a new message, for example with the file name prepended."""
        return type(self)(reason, self.row, code=self.code, profile_line=self.profile_line)


def refusal(
    code: str, where: str, found: str, expected: str = "", cure: str = "", row: int | None = None, line: str = ""
) -> LogError:
    """Return the error for a log that is refused.

    Parameters
    ----------
    code : str
        A key of `CURES`.
    where : str
        File and, if applicable, trial or column in it. Empty if the place is shown next to the message.
    found, expected : str
        The fault and the expected value. ``expected`` may be empty if it follows from ``found``.
    cure : str
        Remedy that replaces the default remedy of the code in `CURES`.
    row : int, optional
        Row of the file, counted from 1.
    line : str
        One or more profile lines with which the log might be readable. They are appended to the message.
    """
    text = f"{where}: {found}" if where else found
    text += f"; expected {expected}." if expected else "" if text.endswith((".", "?")) else "."
    helps = f" {HELPS} {'; '.join(line.splitlines())}" if line else ""
    return LogError(f"{text} {cure or CURES[code]}{helps}", row, code=code, profile_line=line or None)


class ProfileError(PipelineError):
    """A log profile (TOML) is invalid or does not match the files."""


class SceneError(PipelineError):
    """A scene file (TOML) is invalid."""


class DeviceError(PipelineError):
    """A device file (TOML) is invalid, or a device or experiment is unknown."""


class StoreError(PipelineError):
    """A file in `processed/` is missing, is damaged or has an unknown layout."""


class ParameterError(PipelineError, ValueError):
    """A number is outside the range for which its quantity is defined."""

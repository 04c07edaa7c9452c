"""Errors that a user can act on, and the exit status of each.

Every message says what is wrong, where, what was expected and found, and what to do.
"""

from __future__ import annotations

EXIT_OK = 0
EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_QUARANTINED = 3


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
        Line number in the source file, counted from 1.
    """

    def __init__(self, reason: str, row: int | None = None) -> None:
        super().__init__(reason)
        self.reason = reason
        self.row = row


class ProfileError(PipelineError):
    """A log profile (TOML) is wrong or does not fit the files."""


class DeviceError(PipelineError):
    """A device file (TOML) is wrong, or a device or experiment is not known."""


class StoreError(PipelineError):
    """A file in `processed/` is missing, of another layout or damaged."""


class ParameterError(PipelineError, ValueError):
    """A number lies outside the range for which a quantity is defined."""

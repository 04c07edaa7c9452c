"""Words of a refusal: what is wrong and where, what was expected, and what to do, by the code of the refusal."""

from __future__ import annotations

from pipeline.base.errors import Code, LogError

CURES: dict[Code, str] = {
    "empty": "Record the log again.",
    "too-short": "Was the recording cut off? Record it again.",
    "encoding": 'Save it as UTF-8, or state its encoding in the profile, such as encoding = "latin-1".',
    "header-missing": "Correct the layout in the profile, or export the file again.",
    "column-missing": "Correct the name in the profile, or the file.",
    "row-length": "Repair the row, or leave this log out.",
    "not-a-number": "Repair the row, or leave this log out.",
    "no-value": "Fill in or drop these rows, or take another column.",
    "not-finite": "Repair the row, or leave this log out.",
    "out-of-range": "Repair the row, or leave this log out.",
    "time-backwards": "Sort out doubled or swapped rows, or leave this log out.",
    "time-wrong": "Correct [columns.time] of the profile, or repair the rows.",
    "condition-missing": "Correct the profile, or the file.",
    "condition-wrong": "Correct the profile (name_pattern, attributes, condition_columns, [[file]]) or the file.",
    "profile-wrong": "Correct the profile.",
    "lengths-differ": "Choose signals that were recorded together, with the time that belongs to them.",
    "too-large": "Export the columns that are needed, as CSV or Parquet.",
    "too-long-line": "If it is no text, correct `format` in the profile; otherwise export it with line ends.",
    "too-many-columns": "Export the columns that are needed.",
    "too-deep": "Export the samples as a table.",
    "unpacks-too-large": "It is damaged or no log of one step response. Export it again, with the columns needed.",
    "syntax": "The file is cut or damaged; record it again.",
    "damaged": "It is cut, damaged or of another format. Copy or export it again, or correct `format` in the profile.",
    "unsupported": "Correct `format` in the profile, or export the file again.",
}
"""What to do, where nothing more special is known."""


def refusal(
    code: Code, where: str, found: str, expected: str = "", cure: str = "", row: int | None = None, line: str = ""
) -> LogError:
    """Return the refusal of a log.

    Parameters
    ----------
    code : str
        One of `Code`.
    where : str
        File, and trial or column in it; empty where the reader of the message sees it beside the message.
    found, expected : str
        What is wrong and what should be there; expected may be empty where the first says it.
    cure : str
        What to do, in place of what `CURES` says for the code.
    row : int, optional
        Row of the file, counted from 1.
    line : str
        Line (or lines) of a profile by which the log might be read; the message ends with it.
    """
    text = f"{where}: {found}" if where else found
    text += f"; expected {expected}." if expected else "" if text.endswith((".", "?")) else "."
    helps = f" This might help in the profile: {'; '.join(line.splitlines())}" if line else ""
    return LogError(f"{text} {cure or CURES[code]}{helps}", row, code=code, profile_line=line or None)

"""Reader of native logs. The bodies of many logs are parsed as one text, which saves the overhead for each file.

If the common parser fails for a body, or its number of rows differs from its number of lines, the body is read
separately, line by line, to find the faulty row.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from io import BytesIO

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from pipeline.base.errors import LogError, refusal
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import LONGEST_HEADER
from pipeline.readers.formats import refuse_other_kind
from pipeline.readers.log import Log, RawLog, check_samples
from pipeline.records.native import COLUMN_LINE, NativeHeader, parse_header
from pipeline.records.trials import Floats

_NAMES = COLUMN_LINE.split(",")
_BLANK = b"\r\n\t "
_LINE_FEED = 10
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)

Columns = tuple[Floats, Floats, Floats]


class _Body:
    """The samples of a log as text, and the line number of the first sample."""

    def __init__(self, raw: RawLog) -> None:
        self.data = data = raw.data[0]
        if not data.startswith(b"#"):
            refuse_other_kind(raw.names[0], "native", data)
        self.header, start, self.first_row = _split(data)
        if data.endswith(b"\n") and data[-2:-1] not in _BLANK:
            # usual case, without a copy
            self.view = memoryview(data)[start:]
            # three times as fast as `bytes.count`
            self.lines = int(np.count_nonzero(np.frombuffer(self.view, np.uint8) == _LINE_FEED))
        else:
            text = data[start:].rstrip(_BLANK) + b"\n"
            self.view, self.lines = memoryview(text), text.count(b"\n") if len(text) > 1 else 0


def read(profile: Profile, raws: Sequence[RawLog]) -> list[tuple[Log, ...] | LogError]:
    """Read native logs.

    Parameters
    ----------
    profile : Profile
        The native profile.
    raws : sequence of RawLog

    Returns
    -------
    list of tuple of Log (one each), or LogError
        Outcomes in the order of ``raws``.
    """
    outcomes: list[tuple[Log, ...] | LogError | None] = [None] * len(raws)
    bodies: dict[int, _Body] = {}
    for index, raw in enumerate(raws):
        try:
            bodies[index] = _Body(raw)
        except LogError as error:
            outcomes[index] = error
    filled = [body for body in bodies.values() if body.lines]
    columns = _parse(b"".join([body.view for body in filled]), sum(body.lines for body in filled))
    end = 0
    for index, body in bodies.items():
        start, end = end, end + body.lines
        try:
            time, command, position = _parse_alone(body) if columns is None else (c[start:end] for c in columns)
            outcomes[index] = (check_samples(body.header, time, command, position, body.first_row),)
        except LogError as error:
            outcomes[index] = error
    return [outcome for outcome in outcomes if outcome is not None]


def _split(data: bytes) -> tuple[NativeHeader, int, int]:
    """Return the header, the offset of the first sample, and its line number."""
    head, start = data[:LONGEST_HEADER], 0
    if not head.strip(b"\xef\xbb\xbf \t\r\n"):
        raise refusal("empty", "", "file is empty", "a header, the column line and samples", row=1)
    lines: list[str] = []
    for row, line in enumerate(BytesIO(head), start=1):
        try:
            text = line.decode("utf-8-sig" if row == 1 else "utf-8").strip()
        except UnicodeDecodeError as error:
            raise refusal("encoding", "", f"line is not UTF-8 text ({error.reason})", row=row) from error
        start += len(line)
        if text and not text.startswith("#"):
            if [cell.strip() for cell in text.split(",")] != _NAMES:
                found = f"columns must be exactly {COLUMN_LINE!r}, found {text[:200]!r}"
                cure = "Correct the column line, or describe the file by a profile."
                raise refusal("column-missing", "", found, cure=cure, row=row)
            return parse_header(lines), start, row + 1
        lines.append(text)
    parse_header(lines)
    found = f"column line {COLUMN_LINE!r} is missing below the header"
    raise refusal("header-missing", "", found, cure="Add this line and the samples.", row=len(lines) + 1)


def _parse(text: bytes, lines: int) -> Columns | None:
    """Return the columns, or None if the text does not have exactly three numbers on each line."""
    if not lines:
        return np.empty(0), np.empty(0), np.empty(0)
    try:
        table = pacsv.read_csv(
            pa.BufferReader(text),
            pacsv.ReadOptions(column_names=_NAMES, use_threads=False),
            # Blank lines count as rows, and quotation marks are ordinary characters, so that each line is one row.
            pacsv.ParseOptions(quote_char=False, ignore_empty_lines=False),
            pacsv.ConvertOptions(
                column_types=dict.fromkeys(_NAMES, pa.float64()), null_values=[], strings_can_be_null=False
            ),
        )
    except pa.ArrowInvalid:
        return None
    if table.num_rows != lines:
        return None
    time, command, position = (column.to_numpy() for column in table.columns)
    return time, command, position


def _parse_alone(body: _Body) -> Columns:
    """Return the columns of a log that the common parser rejected, if its lines are valid numbers. Otherwise, raise an
    error that names the faulty row.
    """
    rows = []
    for row, line in enumerate(bytes(body.view).decode("utf-8", "replace").split("\n")[:-1], start=body.first_row):
        cells = line.split(",")
        if not line.strip() or len(cells) != len(_NAMES):
            found = (
                f"expected 3 values, found {len(cells)} ({line[:200]!r})"
                if line.strip()
                else "a blank line between rows"
            )
            raise refusal("row-length", "", found, row=row)
        for name, cell in zip(_NAMES, cells, strict=True):
            if not cell.strip():
                raise refusal("no-value", "", f"{name} has no value", row=row)
            if not _NUMBER.fullmatch(cell.strip()):
                raise refusal("not-a-number", "", f"{name} must be a number, found {cell[:200]!r}", row=row)
        rows.append([float(cell) for cell in cells])
    time, command, position = np.array(rows).reshape(-1, 3).T
    return time, command, position

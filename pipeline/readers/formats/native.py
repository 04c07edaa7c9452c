"""Reads native logs, many at a time: the bodies are parsed as one text, which saves the cost per file.

A body that breaks the common parse, or whose number of rows does not agree with its lines, is searched alone
for the row at fault.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence
from io import BytesIO

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from pipeline.base.errors import LogError
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_kind import refuse_other_kind
from pipeline.readers.limits import LONGEST_HEADER, LONGEST_HEADER_LINE, LONGEST_LINE
from pipeline.readers.log import Log, RawLog, check_samples
from pipeline.readers.refusals import refusal
from pipeline.records.batch import Floats
from pipeline.records.native import COLUMN_LINE, NativeHeader, parse_header

_NAMES = COLUMN_LINE.split(",")
# float() would take digits of every script, which the common parse does not; no digit may belong to two parts, or a
# million of them would be divided in every way
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_BLANK = b"\r\n\t "
_LINE_FEED = 10

Columns = tuple[Floats, Floats, Floats]


class _Body:
    """The samples of one log as text, and the line number of the first."""

    def __init__(self, raw: RawLog) -> None:
        data = raw.data[0]
        if not data.startswith(b"#"):
            refuse_other_kind(raw.names[0], "native", data)
        self.header, start, self.first_row = _split(data)
        if data.endswith(b"\n") and data[-2:-1] not in _BLANK:
            # as it is nearly always: no copy
            self.view = memoryview(data)[start:]
            # takes a third of the time of `bytes.count`
            self.lines = int(np.count_nonzero(np.frombuffer(self.view, np.uint8) == _LINE_FEED))
        else:
            text = data[start:].rstrip(_BLANK) + b"\n"
            self.view, self.lines = memoryview(text), text.count(b"\n") if len(text) > 1 else 0

    @property
    def text(self) -> bytes:
        """All lines, each with its end."""
        return bytes(self.view)


def read(profile: Profile, raws: Sequence[RawLog], use_threads: bool) -> list[tuple[Log, ...] | LogError]:
    """Read native logs.

    Parameters
    ----------
    profile : Profile
        The native profile.
    raws : sequence of RawLog
    use_threads : bool
        Whether parsing may use several processors.

    Returns
    -------
    list of tuple of Log (one each), or LogError
        In the order given.
    """
    outcomes: list[tuple[Log, ...] | LogError | None] = [None] * len(raws)
    bodies: dict[int, _Body] = {}
    for index, raw in enumerate(raws):
        try:
            bodies[index] = _Body(raw)
        except LogError as error:
            outcomes[index] = error
    filled = {index: body for index, body in bodies.items() if body.lines}
    columns = _parse(b"".join([b.view for b in filled.values()]), sum(b.lines for b in filled.values()), use_threads)
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
    """Return the header, the offset of the first sample and its line number."""
    head = data[:LONGEST_HEADER]
    cure = "Correct the column line, or describe the file by a profile."
    if not head.strip(b"\xef\xbb\xbf \t\r\n"):
        raise refusal("empty", "", "file is empty", "a header, the column line and samples", row=1)
    lines: list[str] = []
    start = 0
    while start < len(head):
        end = head.find(b"\n", start) + 1 or len(head)
        row = len(lines) + 1
        if end - start > LONGEST_HEADER_LINE:
            found = f"line has more than {LONGEST_HEADER_LINE} bytes"
            raise refusal("too-long-line", "", found, f"header lines and the column line {COLUMN_LINE!r}", row=row)
        try:
            text = head[start:end].decode("utf-8-sig" if start == 0 else "utf-8").strip()
        except UnicodeDecodeError as error:
            found = f"line is no UTF-8 text ({error.reason})"
            raise refusal("encoding", "", found, row=row) from error
        start = end
        if text and not text.startswith("#"):
            header = parse_header(lines)
            if [cell.strip() for cell in text.split(",")] != _NAMES:
                found = f"columns must be exactly {COLUMN_LINE!r}, found {text[:200]!r}"
                raise refusal("column-missing", "", found, cure=cure, row=row)
            return header, start, row + 1
        lines.append(text)
    parse_header(lines)
    found = f"column line {COLUMN_LINE!r} is missing below the header"
    raise refusal("header-missing", "", found, cure="Add it and the samples.", row=len(lines) + 1)


def _parse(text: bytes, lines: int, use_threads: bool) -> Columns | None:
    """Return the columns, or None where the text is not exactly three numbers on each line."""
    if not lines:
        return np.empty(0), np.empty(0), np.empty(0)
    try:
        table = pacsv.read_csv(
            pa.BufferReader(text),
            read_options=pacsv.ReadOptions(column_names=_NAMES, use_threads=use_threads),
            # blank lines are rows and quotes are text, so that one line is one row
            parse_options=pacsv.ParseOptions(quote_char=False, ignore_empty_lines=False),
            convert_options=pacsv.ConvertOptions(
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
    """Return the columns of a log whose lines the common parse does not take, if they are numbers all the same."""
    columns = _parse(body.text, body.lines, use_threads=False)
    if columns is not None:
        return columns
    values = array("d")
    # one line at a time: lines as objects take ten times their bytes
    for row, line in enumerate(BytesIO(body.text), start=body.first_row):
        if len(line) > LONGEST_LINE:
            found = f"line has more than {LONGEST_LINE} characters"
            raise refusal("too-long-line", "", found, f"3 values ({COLUMN_LINE})", row=row)
        text = line.decode("utf-8", "replace").removesuffix("\n")
        cells = [cell.strip() for cell in text.split(",")]
        if len(cells) != 3:
            what = "a blank line" if not text.strip() else f"{len(cells)} values ({text.strip()[:200]!r})"
            raise refusal("row-length", "", f"expected 3 values ({COLUMN_LINE}), found {what}", row=row)
        for name, cell in zip(_NAMES, cells, strict=True):
            if _NUMBER.fullmatch(cell) is None:
                found = f"{name} must be a finite number with a decimal point, found {cell[:200]!r}"
                raise refusal("not-a-number", "", found, row=row)
            values.append(float(cell))
    time, command, position = np.frombuffer(values).reshape(-1, 3).T
    return time, command, position

"""Reads native logs, many at a time: the bodies are parsed as one text, which saves the cost per file.

A body that breaks the common parse, or whose number of rows does not agree with its lines, is searched alone
for the row at fault.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from pipeline.base.errors import LogError
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_kind import refuse_other_kind
from pipeline.readers.limits import LONGEST_HEADER, LONGEST_HEADER_LINE, LONGEST_LINE
from pipeline.readers.log import Log, RawLog, check_samples
from pipeline.records.batch import Floats
from pipeline.records.native import COLUMN_LINE, NativeHeader, parse_header

_NAMES = COLUMN_LINE.split(",")
# float() would take digits of every script, which the common parse does not; no digit may belong to two parts, or a
# million of them would be divided in every way
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_SEARCHED = 1 << 20
"""Bytes of a body that are searched at once for the row at fault: lines as objects take ten times their bytes."""

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
    accepted = [outcome[0] for outcome in outcomes if isinstance(outcome, tuple)]
    if 2 * sum(len(log.time) for log in accepted) < end:
        # the columns of a log are parts of those of all, which would stay in memory for the sake of few
        outcomes = [tuple(map(_copied, o)) if isinstance(o, tuple) else o for o in outcomes]
    return [outcome for outcome in outcomes if outcome is not None]


def _copied(log: Log) -> Log:
    return replace(log, time=log.time.copy(), command=log.command.copy(), position=log.position.copy())


def _split(data: bytes) -> tuple[NativeHeader, int, int]:
    """Return the header, the offset of the first sample and its line number."""
    head = data[:LONGEST_HEADER]
    if not head.strip(b"\xef\xbb\xbf \t\r\n"):
        raise LogError(
            "file is empty; expected a header, the column line and samples. Record the log again.", 1, code="empty"
        )
    lines: list[str] = []
    start = 0
    while start < len(head):
        end = head.find(b"\n", start) + 1 or len(head)
        if end - start > LONGEST_HEADER_LINE:
            raise LogError(
                f"line has more than {LONGEST_HEADER_LINE} bytes; expected header lines `# key: value` and the column "
                f"line {COLUMN_LINE!r}. Shorten the line, or describe the file by a profile.",
                len(lines) + 1,
                code="too-long-line",
            )
        try:
            text = head[start:end].decode("utf-8-sig" if start == 0 else "utf-8").strip()
        except UnicodeDecodeError as error:
            raise LogError(
                f"line is no UTF-8 text ({error.reason}). Save the log as UTF-8.", len(lines) + 1, code="encoding"
            ) from error
        start = end
        if text and not text.startswith("#"):
            header = parse_header(lines)
            if [cell.strip() for cell in text.split(",")] != _NAMES:
                raise LogError(
                    f"columns must be exactly {COLUMN_LINE!r}, found {text[:200]!r}. "
                    "Correct the column line, or describe the file by a profile.",
                    len(lines) + 1,
                    code="column-missing",
                )
            return header, start, len(lines) + 2
        lines.append(text)
    parse_header(lines)
    raise LogError(
        f"column line {COLUMN_LINE!r} is missing below the header; add it and the samples.",
        len(lines) + 1,
        code="header-missing",
    )


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
    text = body.text
    columns = _parse(text, body.lines, use_threads=False)
    if columns is not None:
        return columns
    parts: list[Columns] = []
    start, row = 0, body.first_row
    while start < len(text):
        # whole lines, and at least one
        end = text.rfind(b"\n", start, start + _SEARCHED) + 1 or text.find(b"\n", start) + 1
        block = text[start:end]
        lines = block.count(b"\n")
        part = _parse(block, lines, use_threads=False)
        parts.append(_parse_lines(block, row) if part is None else part)
        start, row = end, row + lines
    time, command, position = (np.concatenate(column) for column in zip(*parts, strict=True))
    return time, command, position


def _parse_lines(block: bytes, first_row: int) -> Columns:
    """Return the numbers of some lines that the common parse does not take, if they are numbers all the same."""
    lines = block.decode("utf-8", "replace").split("\n")[:-1]
    values = np.empty((len(lines), 3))
    for index, line in enumerate(lines):
        row = first_row + index
        if len(line) > LONGEST_LINE:
            raise LogError(
                f"line has more than {LONGEST_LINE} characters; expected 3 values ({COLUMN_LINE}). Repair the row, or "
                "leave this log out.",
                row,
                code="too-long-line",
            )
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) != 3:
            what = "a blank line" if not line.strip() else f"{len(cells)} values ({line.strip()[:200]!r})"
            raise LogError(
                f"expected 3 values ({COLUMN_LINE}), found {what}. Repair the row, or leave this log out.",
                row,
                code="row-length",
            )
        for column, (name, cell) in enumerate(zip(_NAMES, cells, strict=True)):
            if _NUMBER.fullmatch(cell) is None:
                raise LogError(
                    f"{name} must be a finite number with a decimal point, found {cell[:200]!r}. "
                    "Repair the row, or leave this log out.",
                    row,
                    code="not-a-number",
                )
            values[index, column] = float(cell)
    return values[:, 0], values[:, 1], values[:, 2]

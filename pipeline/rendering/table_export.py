"""Tables of a comparison as files for others: CSV and JSON with all digits, Markdown and LaTeX as printed.

Names come from logs and may hold anything, so each format escapes what means something in it.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args
from urllib.parse import quote

from pipeline.base.disk import write_text
from pipeline.base.errors import UsageError
from pipeline.records.results import ComparisonResult
from pipeline.rendering.report.report import PRINTED, tables_of
from pipeline.rendering.table import Cell, Table, Value, footnote
from pipeline.rendering.table_latex import latex_text
from pipeline.rendering.table_values import as_document, value_tables

Format = Literal["csv", "json", "markdown", "latex"]
FORMATS: tuple[Format, ...] = get_args(Format)

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters by which a spreadsheet takes a cell for a formula."""

_MARKDOWN = re.compile(r"[\\`*_{}\[\]<>|#~$!]")


def parse_formats(words: Sequence[str]) -> tuple[Format, ...]:
    """Return formats by their names, each once; several may be joined by commas.

    Raises
    ------
    UsageError
        If one is not known.
    """
    names = dict.fromkeys(part.strip() for word in words for part in word.split(",") if part.strip())
    known = {name: name for name in FORMATS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UsageError(f"unknown format of tables {unknown[0]!r}; expected some of {', '.join(FORMATS)}.")
    return tuple(known[name] for name in FORMATS if name in names)


def tables_folder(report: Path) -> Path:
    """Return the folder beside a report that gets its tables."""
    return report.with_name(f"{report.stem}-tables")


def export_tables(result: ComparisonResult, folder: Path, formats: Sequence[Format]) -> tuple[Path, ...]:
    """Write the tables of a comparison; files of the same name are replaced, others are left alone.

    Parameters
    ----------
    result : ComparisonResult
    folder : Path
        Made if needed: one ``.csv`` and one ``.tex`` a table, ``tables.json``, ``tables.md``.
    formats : sequence of {"csv", "json", "markdown", "latex"}

    Returns
    -------
    tuple of Path
        The files written.
    """
    values = value_tables(result)
    printed = [table for name in PRINTED for table in tables_of(name, result)]
    files: dict[str, str] = {}
    if "csv" in formats:
        files |= {f"{_file_name(table.name)}.csv": csv_text(table) for table in values}
    if "json" in formats:
        files["tables.json"] = json.dumps(as_document(values), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    if "markdown" in formats:
        files["tables.md"] = f"# {_markdown(result.title)}\n\n" + "\n".join(markdown_text(t) for t in printed)
    if "latex" in formats:
        files |= {f"{_file_name(t.name)}.tex": latex_text(t, f"{result.device}-{t.name}") for t in printed}
    for name, text in files.items():
        write_text(folder / name, text)
    return tuple(folder / name for name in files)


def csv_text(table: Table) -> str:
    """Return a table as CSV (RFC 4180 with its CR LF, UTF-8).

    Numbers have all digits; a cell is empty where a value is missing. A text that a spreadsheet would take for a
    formula gets an apostrophe in front.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\r\n")
    # names, not printed heads: programs read them
    writer.writerow([guarded(f"{c.name} [{c.unit}]" if c.unit else c.name) for c in table.columns])
    writer.writerows([_csv_cell(value) for value in record.values()] for record in table.records)
    return stream.getvalue()


def guarded(text: str) -> str:
    """Return a text with an apostrophe in front where a spreadsheet would take it for a formula; numbers stay.

    Examples
    --------
    >>> guarded("=1+1"), guarded("-2.5"), guarded("-a")
    ("'=1+1", '-2.5', "'-a")
    """
    if not text.startswith(_FORMULA):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text if text[0] not in "\t\r" else f"'{text}"


def _csv_cell(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return guarded(value) if isinstance(value, str) else repr(value)


def markdown_text(table: Table) -> str:
    """Return a table as GitHub-flavoured Markdown; headings above columns stand in front of the column heads."""
    heads = [_markdown(f"{column.group}: {column.head}" if column.group else column.head) for column in table.columns]
    lines = [f"**{_markdown(table.caption)}**", "", _markdown_row(heads)]
    lines.append(_markdown_row(["---:" if column.numeric else ":---" for column in table.columns]))
    for block, rows in table.blocks:
        if block:
            lines.append(_markdown_row([f"*{_markdown(block)}*", *[""] * (len(heads) - 1)]))
        lines += [_markdown_row([_markdown_cell(cell) for cell in row]) for row in rows]
    lines += ["", *(f"{footnote(n)}) {_markdown(note)}  " for n, note in enumerate(table.notes))]
    return "\n".join(lines).rstrip() + "\n"


def _markdown_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _markdown_cell(cell: Cell) -> str:
    marks = f"<sup>{','.join(cell.marks)}</sup>" if cell.marks else ""
    return _markdown(cell.text) + marks + (f" ({_markdown(cell.aside)})" if cell.aside else "")


def _markdown(text: str) -> str:
    return _MARKDOWN.sub(r"\\\g<0>", " ".join(text.split()))


def _file_name(name: str) -> str:
    """Return a file name for a table: names of experiments may hold anything; long ones are cut."""
    safe = quote(name, safe=" +=,@")
    safe = "%2E" + safe[1:] if safe.startswith(".") else safe
    return safe[:200]

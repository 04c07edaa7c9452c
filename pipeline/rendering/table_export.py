"""Write the tables of a comparison to files. CSV and JSON have all digits, Markdown and LaTeX those of the report."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from pipeline.base.disk import write_text
from pipeline.base.json_object import JsonObject
from pipeline.records.results import ComparisonResult
from pipeline.rendering.frames import frames
from pipeline.rendering.report.report import printed_tables
from pipeline.rendering.table import Table, records

if TYPE_CHECKING:
    import pandas as pd

LONGEST = 45
"""Largest number of rows that fit on a page. A longer table becomes a ``longtable``."""

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters that make a spreadsheet treat a cell as a formula."""

_MARKDOWN = re.compile(r"[\\`*_{}\[\]<>|#~$!]")

_LETTERS = {
    **{
        letter: rf"$\{name}$"
        for letter, name in zip("αβγδζω", ["alpha", "beta", "gamma", "delta", "zeta", "omega"], strict=True)
    },
    "\N{MINUS SIGN}": "$-$",
    "\N{EN DASH}": "--",
    "\N{NO-BREAK SPACE}": "~",
    "²": r"\textsuperscript{2}",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "×": r"$\times$",
    "±": r"$\pm$",
    "°": r"\textdegree{}",
    "“": "``",
    "”": "''",
}
"""Characters and their replacements in LaTeX. Other characters stay in UTF-8, the default encoding of LaTeX since
2018."""


def export_tables(result: ComparisonResult, folder: Path) -> tuple[Path, ...]:
    """Write the tables of a comparison. Files with the same name are replaced, and other files are not changed.

    There is one ``.csv`` and one ``.tex`` file per table, and the files ``tables.json`` and ``tables.md``. Return the
    written files.
    """
    values, printed = named_frames(result), [table for of in printed_tables(result).values() for table in of]
    document = {name: as_document(frame) for name, frame in values.items()}
    files = {f"{_file_name(name)}.csv": csv_text(frame) for name, frame in values.items()}
    files |= {f"{_file_name(t.name)}.tex": latex_text(t, f"{result.device}-{t.name}") for t in printed}
    files["tables.json"] = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False, default=_plain) + "\n"
    files["tables.md"] = f"# {_markdown(result.title)}\n\n" + "\n".join(map(markdown_text, printed))
    for name, text in files.items():
        write_text(folder / name, text)
    return tuple(folder / name for name in files)


def named_frames(result: ComparisonResult) -> dict[str, pd.DataFrame]:
    """Return the non-empty frames, with Tables D.1 to D.6 under separate names."""
    found = {name: frame for name, frame in frames(result).items() if len(frame)}
    if "tables" not in found:
        return found
    tables = found.pop("tables")
    parts = dict(iter(tables.groupby("table", sort=False)))
    for part in parts.values():
        part.attrs = tables.attrs
    return parts | found


def as_document(frame: pd.DataFrame) -> JsonObject:
    """Return a frame as JSON values. Columns are listed with their units, and rows are objects."""
    units = frame.attrs.get("units", {})
    return {"columns": [{"name": name, "unit": units.get(name, "")} for name in frame.columns], "rows": records(frame)}


def csv_text(frame: pd.DataFrame) -> str:
    """Return a frame as CSV (RFC 4180 with CR LF) with all digits. The head states the units.

    A text that a spreadsheet would treat as a formula gets an apostrophe in front.
    """
    units = frame.attrs.get("units", {})
    safe = frame.map(lambda value: guarded(value) if isinstance(value, str) else value)
    safe = safe.astype(dict.fromkeys(frame.select_dtypes(bool).columns, object)).replace({True: "true", False: "false"})
    safe.columns = [guarded(f"{name} [{units[name]}]" if name in units else name) for name in frame.columns]
    return str(safe.to_csv(index=False, lineterminator="\r\n"))


def guarded(text: str) -> str:
    """Return a text, preceded by an apostrophe if a spreadsheet would treat it as a formula. Numbers are unchanged.

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


def markdown_text(table: Table) -> str:
    """Return a table as GitHub-flavoured Markdown."""
    printed = as_printed(table, _markdown, "<sup>{}</sup>")
    heads = [_markdown(column.head) for column in table.columns]
    lines = [f"**{_markdown(table.caption)}**", "", heads, ["---:" if c.show else ":---" for c in table.columns]]
    lines += [list(row) for row in printed.to_numpy()]
    notes = [f"{f'{mark}) ' if mark else ''}{_markdown(note)}  " for mark, note in table.footnotes]
    return (
        "\n".join(
            line if isinstance(line, str) else f"| {' | '.join(line)} |" for line in [*lines, "", *notes]
        ).rstrip()
        + "\n"
    )


def latex_text(table: Table, label: str) -> str:
    """Return a table as a LaTeX float with caption and label, written by pandas. Notes are below the table."""
    printed = as_printed(table, _latex, r"\textsuperscript{{{}}}")
    printed.columns = [_latex(column.head) for column in table.columns]
    name = re.sub(r"[^A-Za-z0-9.:-]+", "-", label)
    kinds = "".join("r" if column.show else "l" for column in table.columns)
    long = len(printed) > LONGEST
    text = printed.to_latex(
        index=False, escape=False, column_format=f"@{{}}{kinds}@{{}}", longtable=long,
        caption=_latex(table.caption), label=f"tab:{name}", position=None if long else "t",
    )  # fmt: skip
    marked = ((rf"\textsuperscript{{{mark}}}" if mark else " ", _latex(note)) for mark, note in table.footnotes)
    notes = [rf"\par\raggedright\footnotesize{mark}{note}" for mark, note in marked]
    body, end, rest = text.rpartition("\\end{longtable}\n" if long else "\\end{table}\n")
    notes_text = "\n".join(notes) + "\n" if notes else ""
    packages = f"% \\usepackage{{booktabs{',longtable' if long else ''}}}\n"
    return f"{packages}{body}{end}{notes_text}{rest}" if long else f"{packages}{body}{notes_text}{end}{rest}"


def as_printed(table: Table, escape: Any, mark: str) -> pd.DataFrame:
    """Return the escaped texts of a table. Headings of blocks are rows."""
    import pandas as pd

    rows: list[list[str]] = []
    for block, of in table.blocks:
        rows += [[escape(block), *[""] * (len(table.columns) - 1)]] if block else []
        for _, cells in of:
            rows.append(
                [
                    escape(c.text)
                    + (mark.format(",".join(c.marks)) if c.marks else "")
                    + (f" ({escape(c.aside)})" if c.aside else "")
                    for c in cells
                ]
            )
    return pd.DataFrame(rows, columns=[column.name for column in table.columns])


def _plain(value: Any) -> Any:
    return value.item()  # convert a numpy scalar


def _markdown(text: str) -> str:
    return _MARKDOWN.sub(r"\\\g<0>", " ".join(text.split()))


def _latex(text: str) -> str:
    plain = re.sub(r"[^\S\N{NO-BREAK SPACE}]+", " ", text).strip()
    special: dict[str, str | int | None] = {
        **{c: rf"\{c}" for c in "&%$#_{}"},
        **{c: f"{{{c}}}" for c in '[]*"'},
        **_LETTERS,
    }
    special |= {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
    }
    return plain.translate(str.maketrans(special))


def _file_name(name: str) -> str:
    """Return a file name for a table. Names of experiments may contain any character, and long names are cut."""
    safe = quote(name, safe=" +=,@")
    return ("%2E" + safe[1:] if safe.startswith(".") else safe)[:200]

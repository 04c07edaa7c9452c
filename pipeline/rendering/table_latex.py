"""A table in LaTeX: a float with caption and label, as wide as one column of a two-column page or as both."""

from __future__ import annotations

import re
import textwrap
import unicodedata
from collections.abc import Sequence

from pipeline.rendering.table import Cell, Table, footnote

COLUMN, PAGE = 252.0, 516.0
"""Widths [pt] of one column and of both, as of IEEE journals."""

LETTER, GAP = 4.1, 6.0
"""Mean width of a letter and space between two columns [pt], at 8 pt."""

NARROWEST = 12
"""Letters below which a column of words is not wrapped."""

ASIDE = 20
"""Letters of a line of what stands below a number, such as its interval."""

LONGEST = 45
"""Rows beyond which a table does not fit on a page, and is a ``longtable``, which needs a page of one column."""

_SPECIAL = str.maketrans(
    {
        **{character: rf"\{character}" for character in "&%$#_{}"},
        **{character: rf"{{{character}}}" for character in "[]*"},  # behind a line's end they would belong to its \\
        **{letter: rf"$\{unicodedata.name(letter).split()[-1].lower()}$" for letter in "αβγδζω"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        '"': r"\textquotedbl{}",
        "\N{MINUS SIGN}": "$-$",
        "\N{EN DASH}": "--",
        "\N{NO-BREAK SPACE}": "~",
        "\N{PLUS-MINUS SIGN}": r"$\pm$",
        "\N{SUPERSCRIPT TWO}": r"\textsuperscript{2}",
        "\N{GREATER-THAN OR EQUAL TO}": r"$\geq$",
        "\N{LESS-THAN OR EQUAL TO}": r"$\leq$",
        "\N{MULTIPLICATION SIGN}": r"$\times$",
        "\N{DEGREE SIGN}": r"\textdegree{}",
        "“": "``",
        "”": "''",
    }
)
"""What stands for a character in LaTeX; other letters are UTF-8, which LaTeX reads since 2018."""


def latex_text(table: Table, label: str = "") -> str:
    """Return a table with the rules of ``booktabs``, its notes below it; the first line says which packages and width.

    Parameters
    ----------
    table : Table
    label : str
        Of the float, behind ``tab:``; the table's name where it is not given.

    Notes
    -----
    Widths are estimated from the number of letters. Columns of words wrap where that makes the table fit into one
    column, else into two.
    """
    letters, needs = _letters(table)
    long = len(table.rows) > LONGEST
    star = "*" if needs > COLUMN else ""
    kind = "longtable" if long else "tabular"
    room = "one column" if needs <= COLUMN else "two columns" if needs <= PAGE else "more than two columns"
    name = re.sub(r"[^A-Za-z0-9.:-]+", "-", label or table.name)
    caption = rf"\caption{{{_latex(table.caption)}}}\label{{tab:{name}}}"
    first = [*_latex_groups(table), _heads(table, letters), r"\midrule"]
    sizes = r"\footnotesize\setlength{\tabcolsep}{3pt}"
    lines = [rf"% \usepackage{{booktabs,array{',longtable' if long else ''}}}; some {needs:.0f} pt wide: {room}"]
    if long:
        lines += [f"{{{sizes}", rf"\begin{{longtable}}{{{_columns(table, letters)}}}", caption + r"\\"]
        lines += [r"\toprule", *first, r"\endfirsthead", r"\toprule", *first[-2:], r"\endhead", r"\bottomrule"]
        lines += [r"\endfoot", *_body(table, letters), r"\end{longtable}"]
    else:
        lines += [rf"\begin{{table{star}}}[t]", caption, rf"\centering{sizes}"]
        lines += [rf"\begin{{{kind}}}{{{_columns(table, letters)}}}", r"\toprule", *first, *_body(table, letters)]
        lines += [r"\bottomrule", rf"\end{{{kind}}}"]
    for number, note in enumerate(table.notes):
        lines.append(rf"\par\raggedright\textsuperscript{{{footnote(number)}}}{_latex(note)}")
    lines.append(r"\par}" if long else rf"\end{{table{star}}}")
    return "\n".join(lines) + "\n"


def _letters(table: Table) -> tuple[list[int], float]:
    """Return the letters of each column and the width that they need [pt]."""
    columns = list(zip(*table.rows, strict=True))
    cells = [max((len(line) for cell in column for line in _lines(cell)), default=0) for column in columns]
    heads = [max(map(len, column.head.split()), default=0) for column in table.columns]
    found = [max(pair) for pair in zip(cells, heads, strict=True)]
    wrapping = [i for i, column in enumerate(table.columns) if not column.numeric and found[i] > NARROWEST]
    least = [max(NARROWEST, heads[i]) for i in wrapping]
    for room in (COLUMN, PAGE):
        over = (_width(found) - room) / LETTER
        spare = sum(found[i] for i in wrapping) - sum(least)
        if 0 < over <= spare:
            share = over / spare
            for i, end in zip(wrapping, least, strict=True):
                found[i] = int(found[i] - share * (found[i] - end))
        if over <= max(spare, 0):
            break
    return found, _width(found)


def _width(letters: Sequence[int]) -> float:
    return LETTER * sum(letters) + GAP * (len(letters) - 1)


def _lines(cell: Cell) -> list[str]:
    """Return what a cell shows, and below that what stands beside it."""
    return [cell.text + "".join(cell.marks), *(textwrap.wrap(f"({cell.aside})", ASIDE) if cell.aside else [])]


def _wraps(table: Table, letters: Sequence[int]) -> list[bool]:
    """Return which columns wrap: words of more letters than the column has."""
    pairs = zip(table.columns, zip(*table.rows, strict=True), letters, strict=True)
    return [not c.numeric and any(len(line) > width for x in cells for line in _lines(x)) for c, cells, width in pairs]


def _columns(table: Table, letters: Sequence[int]) -> str:
    """Return the kinds of the columns."""
    kinds = []
    for column, wraps, width in zip(table.columns, _wraps(table, letters), letters, strict=True):
        wrapped = rf">{{\raggedright\arraybackslash}}p{{{width * LETTER:.0f}pt}}"
        kinds.append("r" if column.numeric else wrapped if wraps else "l")
    return f"@{{}}{''.join(kinds)}@{{}}"


def _heads(table: Table, letters: Sequence[int]) -> str:
    """Return the line of column heads; long ones have several lines."""
    found = []
    for column, width in zip(table.columns, letters, strict=True):
        lines = textwrap.wrap(column.head, max(width, 1), break_long_words=False) or [""]
        found.append(_stacked(list(map(_latex, lines)), numeric=column.numeric, place="b"))
    return " & ".join(found) + r" \\"


def _stacked(lines: Sequence[str], *, numeric: bool, place: str = "t") -> str:
    """Return lines below each other, the first (``t``) or the last (``b``) on the line of the row."""
    side, text = "r" if numeric else "l", r" \\ ".join(lines)
    return text if len(lines) == 1 else rf"\begin{{tabular}}[{place}]{{@{{}}{side}@{{}}}}{text}\end{{tabular}}"


def _body(table: Table, letters: Sequence[int]) -> list[str]:
    lines, wraps = [], _wraps(table, letters)
    for number, (block, rows) in enumerate(table.blocks):
        if block:
            lines += [r"\addlinespace"] if number else []
            lines.append(rf"\multicolumn{{{len(table.columns)}}}{{l}}{{\emph{{{_latex(block)}}}}} \\")
        lines += [" & ".join(map(_latex_cell, row, wraps)) + r" \\" for row in rows]
    return lines


def _latex_groups(table: Table) -> list[str]:
    """Headings above the column heads, each with a rule below."""
    if not table.groups:
        return []
    cells, rules, first = [], [], 1
    for text, span in table.groups:
        cells.append(rf"\multicolumn{{{span}}}{{c}}{{{_latex(text)}}}")
        if text:
            rules.append(rf"\cmidrule(lr){{{first}-{first + span - 1}}}")
        first += span
    return [" & ".join(cells) + r" \\", "".join(rules)]


def _latex_cell(cell: Cell, wraps: bool) -> str:
    marks = rf"\textsuperscript{{{','.join(cell.marks)}}}" if cell.marks else ""
    _, *below = _lines(cell)
    if wraps and cell.aside:
        return rf"{_latex(cell.text)}{marks} \newline ({_latex(cell.aside)})"
    return _stacked([_latex(cell.text) + marks, *map(_latex, below)], numeric=cell.numeric)


def _latex(text: str) -> str:
    # a no-break space is white space to split(), and stays one
    plain = re.sub(r"[^\S\N{NO-BREAK SPACE}]+", " ", text).strip()
    return plain.translate(_SPECIAL)

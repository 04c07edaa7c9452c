"""How delimited text is laid out: the part of a profile that `pipeline.readers.formats.delimited` reads by."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from pipeline.profiles.patterns import pattern_problem
from pipeline.records.findings import Record

BLANKS = "blanks"
"""Delimiter of tables whose columns are parted by runs of blanks and tabs."""

Number = Annotated[float, Field(strict=True)]
"""A number as such: "300" in quotation marks and true are mistakes, not 300 and 1."""

Count = Annotated[int, Field(ge=0, strict=True)]
"""A whole number from 0."""

Problem = tuple[tuple[str | int, ...], str]
"""Place of a key in a profile, and what is wrong there."""


class TextLayout(Record):
    """Layout of a delimited text file, plain or compressed (gzip, zstd: known by their first bytes).

    Parameters
    ----------
    delimiter : str
        One character, or ``"blanks"`` for runs of blanks and tabs.
    decimal : {".", ","}
        Needed, because "1,234" is two numbers: there is no default.
    encoding : {"utf-8", "utf-16", "latin-1", "cp1252"}
        A byte order mark is legal in UTF-8 and UTF-16.
    skip_rows : int
        Lines above the table, or above the first line that is searched for its beginning.
    header : bool
        Whether the table begins with a line of column names; if not, columns are taken by position (``column = 3``).
    header_after, header_at : str, optional
        Regular expression: the table begins below (at) the first line in which it is found, as behind a banner.
    unit_line : bool
        Whether the line below the names holds units. They are shown by checks, never used.
    comment : str, optional
        Lines that begin with it are left out.
    labels : str, optional
        Sign between label and value in lines such as ``Gain: 32``, above the table or between its rows.
    trailing_delimiter : bool
        Whether rows end with one more delimiter.
    blank_lines : {"refuse", "skip"}
        What becomes of blank lines between rows; those at the end of a file are never counted.
    missing : tuple of str
        Cells that mean "no value", as a blank cell does.
    """

    delimiter: Annotated[str, Field(min_length=1)] = ","
    decimal: Literal[".", ","] | None = None
    encoding: Literal["utf-8", "utf-16", "latin-1", "cp1252"] = "utf-8"
    skip_rows: Count = 0
    header: bool = True
    header_after: str | None = None
    header_at: str | None = None
    unit_line: bool = False
    comment: Annotated[str, Field(min_length=1)] | None = None
    labels: Annotated[str, Field(min_length=1)] | None = None
    trailing_delimiter: bool = False
    blank_lines: Literal["refuse", "skip"] = "refuse"
    missing: tuple[str, ...] = ()

    @property
    def decimal_sign(self) -> str:
        """Decimal sign of numbers in texts; a point in formats that keep numbers as such, where none is stated."""
        return self.decimal or "."

    def layout_problems(self) -> Iterator[Problem]:
        """Yield what does not fit together in the layout."""
        if len(self.delimiter) != 1 and self.delimiter != BLANKS:
            yield ("delimiter",), f"expected one character or {BLANKS!r}, found {self.delimiter!r}"
        if self.decimal is None:
            yield ("decimal",), """missing; add the line decimal = "." or decimal = ",", as the file has it"""
        if self.delimiter == self.decimal:
            yield ("decimal",), f"{self.decimal!r} as the delimiter is; expected different characters"
        for key in ("header_after", "header_at"):
            if problem := pattern_problem(getattr(self, key)):
                yield (key,), problem

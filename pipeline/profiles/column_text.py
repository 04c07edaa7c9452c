"""Texts of the command line that state a column with its unit, or a constant with its unit. ``t:ms`` is the column
``t`` in ms, ``-x:mm`` is the column ``x`` in mm with the opposite sign, and ``4 N`` is a constant. A name that contains
a quotation mark, or a colon before a unit, is written in double quotes: ``"F:N":mN``.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal, Self

from pipeline.base.errors import UsageError
from pipeline.base.units import find_unit, split_quantity

LISTED_COLUMNS = 40
"""Largest number of columns that are listed in a message. A bag has hundreds."""

_QUOTED = re.compile(r'"((?:[^"]|"")*)"(?::(.*))?')


@dataclass(frozen=True)
class ColumnText:
    """A column or a constant, as written by the user.

    Parameters
    ----------
    column : str or None
        Name of the column, or None for a constant.
    value : float or None
        The constant, or None for a column.
    unit : str
        Unit as written. Empty if no unit was written.
    sign : {1, -1} or None
        Sign before the name of the column, or None if there is none.
    """

    column: str | None
    value: float | None
    unit: str
    sign: Literal[1, -1] | None = None

    @classmethod
    def constant(cls, text: str) -> Self | None:
        """Read a constant. Return None if the text is not a number, with or without a unit.

        >>> ColumnText.constant("4 N")
        ColumnText(column=None, value=4.0, unit='N', sign=None)
        """
        found = split_quantity(text)
        return None if found is None else cls(None, *found)

    @classmethod
    def among(cls, option: str, text: str, names: Collection[str]) -> Self:
        """Read the name of a column in the file, with its unit.

        Parameters
        ----------
        option : str
            Name of the option for messages, such as ``--time``.
        text : str
            Name of the column. A sign ``-`` or ``+`` may precede it, and a colon and the unit may follow it.
        names : collection of str
            Names of the columns in the file.

        Raises
        ------
        UsageError
            If no column has the name, or the unit is unknown.

        Examples
        --------
        >>> ColumnText.among("--position", "-x:mm", ["t", "x"])
        ColumnText(column='x', value=None, unit='mm', sign=-1)
        >>> ColumnText.among("--command", "Dev1:ai0:V", ["Dev1:ai0"])
        ColumnText(column='Dev1:ai0', value=None, unit='V', sign=None)
        """
        found = _named(text, names)
        if found is None and text[:1] in ("-", "+"):
            found, sign = _named(text[1:], names), -1 if text[0] == "-" else 1
        else:
            sign = None
        if found is None:
            raise UsageError(f"{option} {text}: {_lacking(text, names)}")
        column, unit = found
        if unit and find_unit(unit) is None:
            raise UsageError(f"{option} {text}: unit {unit!r} is unknown. Write a unit such as N, V, mm, rad or ms.")
        return cls(column, None, unit, sign)  # type: ignore[arg-type]


def _named(text: str, names: Collection[str]) -> tuple[str, str] | None:
    """Return the column that a text names, and its unit, or None if the text names no column."""
    if (quoted := _QUOTED.fullmatch(text)) and (name := quoted[1].replace('""', '"')) in names:
        return name, (quoted[2] or "").strip()
    name, colon, unit = text.rpartition(":")
    for column, symbol in ((text, ""), (name, unit.strip()) if colon else (text, "")):
        for spelling in (column, column.strip(), f"/{column}"):
            if spelling in names:
                return spelling, symbol
    return None


def _lacking(text: str, names: Collection[str]) -> str:
    """Return the message for a column that does not exist, with the columns of the file."""
    name = text.lstrip("+-")
    stem = name.rpartition(":")[0] or name
    near = get_close_matches(stem, names, 3) or [n for n in names if n.casefold() == stem.casefold()]
    listing = ", ".join(list(names)[:LISTED_COLUMNS]) + (", ..." if len(names) > LISTED_COLUMNS else "")
    nearest = f" Nearest: {', '.join(near)}." if near else ""
    return (
        f"no column {stem!r}.{nearest} Columns of the file: {listing or 'none'}. Write the name, a colon and the unit."
    )

"""Published values of the theory tables B.1 to B.4, C.1 to C.3 and 5.1, as printed, with what is known of their errata.

The file ``schemas/published/hulin-2017-theory.csv`` ships with the package; nothing here is computed. Numbers stay
text, because their printed digits matter.

Source: Hulin 2017, Table 5.1, appendices B and C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from typing import Annotated, Self

from pydantic import Field, field_validator, model_validator

from pipeline.base.errors import ParameterError
from pipeline.device_data.published import shipped_rows
from pipeline.records.findings import NonNegative, Record
from pipeline.records.models import Name

THEORY_TABLES = ("B.1", "B.2", "B.3", "B.4", "C.1", "C.2", "C.3", "5.1(a)", "5.1(b)")
"""Tables of theory alone; those of appendix D are in `pipeline.device_data.published`."""

QUANTITIES = ("alpha", "beta", "cost", "percent", "scaling")
"""Numbers that a row may have."""

_FILE = "hulin-2017-theory.csv"

_Digits = Annotated[str, Field(pattern=r"^-?\d+(\.\d+)?$")]


@dataclass(frozen=True)
class PrintedNumber:
    """A number as it stands in a table.

    Parameters
    ----------
    text : str
        All printed digits, trailing zeros included.
    """

    text: str

    @property
    def value(self) -> float:
        """The number."""
        return float(self.text)

    @property
    def digits(self) -> int:
        """Number of digits after the decimal point."""
        return max(0, -int(Decimal(self.text).as_tuple().exponent))

    @property
    def unit(self) -> float:
        """One unit of the last printed digit."""
        return float(10.0**-self.digits)


class PublishedPoint(Record):
    """One printed point or factor; what the table does not have is None.

    Parameters
    ----------
    table : str
        One of `THEORY_TABLES`. A row of B.1 to B.4 holds two points, which are two of these.
    criterion : str
        As in `pipeline.theory.optimum`, or ``alpha_max``, ``beta_max``, ``ziegler_nichols``.
    delay, gamma, delta : float
        Parameters of the loop, normalised.
    alpha, beta : str or None
        Normalised stiffness and damping of the point.
    cost : str or None
        Cost there as the tables give it: damping ratio, pole modulus, samples, fraction, energy.
    percent : str or None
        Tables B: the largest alpha or beta relative to that without delay.
    scaling : str or None
        Table 5.1: scaling factor of (5.19).
    erratum_of : tuple of str
        Names of the numbers that a computation cannot meet.
    erratum : str or None
        Why.
    """

    table: Name
    criterion: Name
    delay: NonNegative
    gamma: NonNegative
    delta: NonNegative
    alpha: _Digits | None = None
    beta: _Digits | None = None
    cost: _Digits | None = None
    percent: _Digits | None = None
    scaling: _Digits | None = None
    erratum_of: tuple[Name, ...] = ()
    erratum: str | None = None

    @field_validator("erratum_of", mode="before")
    @classmethod
    def _names_are_parted_by_blanks(cls, given: object) -> object:
        return tuple(given.split()) if isinstance(given, str) else given

    @model_validator(mode="after")
    def _errata_have_a_reason(self) -> Self:
        absent = [name for name in self.erratum_of if name not in self.printed()]
        if absent or bool(self.erratum_of) != bool(self.erratum):
            raise ValueError(f"erratum_of {list(self.erratum_of)}: expected names of printed numbers, and a reason")
        return self

    def printed(self) -> dict[str, PrintedNumber]:
        """Return the printed numbers by name, in the order of `QUANTITIES`."""
        texts = {name: getattr(self, name) for name in QUANTITIES}
        return {name: PrintedNumber(text) for name, text in texts.items() if text is not None}


@cache
def _all_points() -> tuple[PublishedPoint, ...]:
    return shipped_rows(_FILE, PublishedPoint)


def published_points(tables: Sequence[str] = THEORY_TABLES) -> tuple[PublishedPoint, ...]:
    """Return the printed points of the named tables, in the order of the thesis.

    Parameters
    ----------
    tables : sequence of str
        Of `THEORY_TABLES`.

    Raises
    ------
    ParameterError
        For another table.
    StoreError
        If the file that ships with the package is missing or damaged.

    Source: Hulin 2017, Tables 5.1, B.1 to B.4, C.1 to C.3.
    """
    unknown = [name for name in tables if name not in THEORY_TABLES]
    if unknown:
        raise ParameterError(f"table {unknown[0]!r} is unknown; expected one of {list(THEORY_TABLES)}.")
    return tuple(point for point in _all_points() if point.table in tables)

"""Published values as printed, with known errata: tables of the thesis and models of the human arm.

The files in ``schemas/published`` ship with the package. This module reads them and computes no values of theory.
Source: Hulin 2017, Tables 3.2, 5.1, appendices B to D.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Annotated, Self, TypeVar

from pydantic import Field, ValidationError, field_validator, model_validator

from pipeline.base.errors import ParameterError, StoreError
from pipeline.base.provenance import schema_folder
from pipeline.device.parts import Positive
from pipeline.records.findings import NonNegative, Record
from pipeline.records.models import Name, PublishedBound, PublishedMass

_FILE, _THEORY, _ARMS = "hulin-2017.csv", "hulin-2017-theory.csv", "hulin-2017-human-arm.csv"
_BOUNDS, _MASSES = "hulin-2017-bounds.csv", "hulin-2017-masses.csv"

THEORY_TABLES = ("B.1", "B.2", "B.3", "B.4", "C.1", "C.2", "C.3", "5.1(a)", "5.1(b)")
"""Tables of purely theoretical values. Their numbers are stored as text because the printed digits matter."""

MEASURED_TABLES = ("D.1", "D.2", "D.3", "D.4", "D.5", "D.6")
"""Tables of theoretical and experimental optima."""

QUANTITIES = ("alpha", "beta", "cost", "percent", "scaling")
"""Quantities that a row of the theory tables may have."""

_Digits = Annotated[str, Field(pattern=r"^-?\d+(\.\d+)?$")]

RowT = TypeVar("RowT", bound=Record)
OfDevice = TypeVar("OfDevice", PublishedBound, PublishedMass)


class PublishedRow(Record):
    """Printed optimum. A value that is missing from the table is None.

    Parameters
    ----------
    table : str
        ``D.1`` to ``D.6``.
    device : str
    criterion, condition : str
        Criterion and condition as in the tables. The condition is ``theory_discrete``, ``theory_continuous``,
        ``experiment`` or ``experiment_<n>``.
    delay_samples : float or None
        Total delay of a row of Table D.6; None in the other tables.
    stiffness, damping : float or None
        Optimal K [N/m, Nm/rad] and B [Ns/m, Nms/rad]; None in Table D.6.
    cost : float
        Cost in samples (settling time), as a fraction (overshoot) or dimensionless (energy).
    stiffness_low, stiffness_high, damping_low, damping_high : float or None
        Printed bounding box of a discrete settling optimum.
    erratum : str or None
        Reason why a recomputation differs from the printed value; None if it agrees, or if the row was measured.
    """

    table: Name
    device: Name
    criterion: Name
    condition: Name
    delay_samples: float | None = None
    stiffness: Positive | None = None
    damping: Positive | None = None
    cost: float
    stiffness_low: Positive | None = None
    stiffness_high: Positive | None = None
    damping_low: Positive | None = None
    damping_high: Positive | None = None
    erratum: str | None = None

    @property
    def is_theory(self) -> bool:
        """Whether the row comes from theory and not from an experiment."""
        return self.condition.startswith("theory")


def shipped_rows(file: str, row: type[RowT]) -> tuple[RowT, ...]:
    """Read a CSV file of published values that ships with the package. Empty cells are omitted.

    Parameters
    ----------
    file : str
        File name in ``schemas/published/``.
    row : type
        Type of record that validates each row.

    Raises
    ------
    StoreError
        If the file is missing or damaged. The message names the row.
    """
    path = schema_folder() / "published" / file
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(
            f"{path}: the published values that ship with the package cannot be read ({error}). "
            "Install the package again."
        ) from error
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    rows = []
    for number, cells in enumerate(csv.DictReader(lines), start=1):
        try:
            rows.append(row.model_validate({name: cell for name, cell in cells.items() if cell}))
        except ValidationError as error:
            raise StoreError(
                f"{path}, data row {number}: expected the columns of {row.__name__}, found {error}. "
                "Restore the file that ships with the package."
            ) from error
    return tuple(rows)


def published_files() -> tuple[Path, ...]:
    """Return all files of published values that ship with the package."""
    return tuple(sorted((schema_folder() / "published").glob("*.csv")))


@cache
def published_rows() -> tuple[PublishedRow, ...]:
    """Return all printed rows in the order of the tables.

    Raises
    ------
    StoreError
        If the file that ships with the package is missing or damaged.

    Source: Hulin 2017, Tables D.1 to D.6.
    """
    return shipped_rows(_FILE, PublishedRow)


def find(table: str, criterion: str, condition: str, delay_samples: float | None = None) -> PublishedRow | None:
    """Return a printed row, or None if it does not exist.

    Parameters
    ----------
    table, criterion, condition : str
        Values as in `PublishedRow`.
    delay_samples : float, optional
        Total delay. It is required for Table D.6 and ignored for the other tables, which use the device's delay.
    """
    rows = (r for r in published_rows() if (r.table, r.criterion, r.condition) == (table, criterion, condition))
    return next((row for row in rows if row.delay_samples in (None, delay_samples)), None)


def published_deviation(row: PublishedRow) -> float | None:
    """Compute the deviation of a printed measurement from the printed discrete theory of its table, in percent.

    Return None for a row of theory, or if the printed theoretical cost is 0 or missing.

    Source: Hulin 2017, Table D.6, which prints the deviation for each delay. The same definition is used for D.1 to
    D.5.
    """
    theory = find(row.table, row.criterion, "theory_discrete", row.delay_samples)
    if row.is_theory or theory is None or not theory.cost:
        return None
    return 100 * (row.cost - theory.cost) / theory.cost


@dataclass(frozen=True)
class PrintedNumber:
    """Number as printed in a table.

    Parameters
    ----------
    text : str
        All printed digits, including trailing zeros.
    """

    text: str

    @property
    def value(self) -> float:
        """Numeric value."""
        return float(self.text)

    @property
    def digits(self) -> int:
        """Number of digits after the decimal point."""
        return max(0, -int(Decimal(self.text).as_tuple().exponent))

    @property
    def unit(self) -> float:
        """One unit in the last printed digit."""
        return float(10.0**-self.digits)


class PublishedPoint(Record):
    """Printed point or factor. A value that is missing from the table is None.

    Parameters
    ----------
    table : str
        One of `THEORY_TABLES`. A row of B.1 to B.4 contains two points, which are stored as two records.
    criterion : str
        Criterion of `pipeline.theory.optimum`, or ``alpha_max``, ``beta_max`` or ``ziegler_nichols``.
    delay, gamma, delta : float
        Normalised parameters of the loop.
    alpha, beta : str or None
        Normalised stiffness and damping of the point.
    cost : str or None
        Cost of the point as tabulated. It is a damping ratio, a pole modulus, a number of samples, a fraction or an
        energy.
    percent : str or None
        Largest alpha or beta relative to its value without delay (Tables B).
    scaling : str or None
        Scaling factor of (5.19) (Table 5.1).
    erratum_of : tuple of str
        Names of the printed numbers that cannot be reproduced by computation.
    erratum : str or None
        Reason for the deviation.
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
            raise ValueError(f"erratum_of {list(self.erratum_of)}: expected names of printed numbers and a reason")
        return self

    def printed(self) -> dict[str, PrintedNumber]:
        """Return the printed numbers by name, in the order of `QUANTITIES`."""
        texts = {name: getattr(self, name) for name in QUANTITIES}
        return {name: PrintedNumber(text) for name, text in texts.items() if text is not None}


@cache
def _all_points() -> tuple[PublishedPoint, ...]:
    return shipped_rows(_THEORY, PublishedPoint)


def published_points(tables: Sequence[str] = THEORY_TABLES) -> tuple[PublishedPoint, ...]:
    """Return the printed points of the given tables, in the order of the thesis.

    Parameters
    ----------
    tables : sequence of str
        Names from `THEORY_TABLES`.

    Raises
    ------
    ParameterError
        If a table is unknown.
    StoreError
        If the file that ships with the package is missing or damaged.

    Source: Hulin 2017, Tables 5.1, B.1 to B.4, C.1 to C.3.
    """
    unknown = [name for name in tables if name not in THEORY_TABLES]
    if unknown:
        raise ParameterError(f"table {unknown[0]!r} is unknown; expected one of {list(THEORY_TABLES)}.")
    return tuple(point for point in _all_points() if point.table in tables)


class HumanArm(Record):
    """Model of the human arm with mass [kg], stiffness [N/m] and viscous damping [Ns/m].

    Source: Hulin 2017, Table 3.2.
    """

    source: str
    mass: Positive
    stiffness: Positive
    damping: Positive


@cache
def human_arms() -> tuple[HumanArm, ...]:
    """Return all models of the human arm in Table 3.2.

    Raises
    ------
    StoreError
        If the file that ships with the package is missing or damaged.
    """
    return shipped_rows(_ARMS, HumanArm)


def published_bound(device: str) -> PublishedBound | None:
    """Return the printed straight bound of the limits of a device, or None if there is none.

    Raises
    ------
    StoreError
        If the file that ships with the package is missing or damaged.
    """
    return _of_device(shipped_rows(_BOUNDS, PublishedBound), device)


def published_mass(device: str) -> PublishedMass | None:
    """Return the weighed mass of a device, or None if there is none.

    Raises
    ------
    StoreError
        If the file that ships with the package is missing or damaged.
    """
    return _of_device(shipped_rows(_MASSES, PublishedMass), device)


def _of_device(rows: Sequence[OfDevice], device: str) -> OfDevice | None:
    """Return the first row of a device, or None if there is none."""
    return next((row for row in rows if row.device == device), None)

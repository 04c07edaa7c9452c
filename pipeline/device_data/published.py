"""Published values of Tables D.1 to D.6, as printed, with what is known of their errata, and of the human arm.

The files in ``schemas/published`` ship with the package; nothing here is computed.

Source: Hulin 2017, appendix D, Table 3.2.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from pipeline.base.errors import StoreError
from pipeline.base.provenance import schema_folder
from pipeline.records.findings import Record
from pipeline.records.models import Name, Positive

_FILE, _ARMS = "hulin-2017.csv", "hulin-2017-human-arm.csv"

RowT = TypeVar("RowT", bound=Record)


class PublishedRow(Record):
    """One printed optimum; a cell that the table does not have is None.

    Parameters
    ----------
    table : str
        ``D.1`` to ``D.6``.
    device : str
    criterion, condition : str
        As in the tables: ``theory_discrete``, ``theory_continuous``, ``experiment`` or ``experiment_<n>``.
    delay_samples : float or None
        Total delay of a row of Table D.6; None in the other tables.
    stiffness, damping : float or None
        Optimal K [N/m, Nm/rad] and B [Ns/m, Nms/rad]; None in Table D.6.
    cost : float
        Samples (settling time), fraction (overshoot) or dimensionless (energy).
    stiffness_low, stiffness_high, damping_low, damping_high : float or None
        Printed bounding box of a discrete settling optimum.
    erratum : str or None
        Why a recomputation differs from the printed value; None where it agrees, or where the row was measured.
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


def shipped_rows(file: str, row: type[RowT]) -> tuple[RowT, ...]:
    """Return the rows of a CSV file of published values that ships with the package; empty cells are left out.

    Parameters
    ----------
    file : str
        Name below ``schemas/published/``.
    row : type
        Record that validates each row.

    Raises
    ------
    StoreError
        If the file is missing or damaged; the message names the data row.
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
    """Return the printed row, or None where the tables have none.

    Parameters
    ----------
    table, criterion, condition : str
        As in `PublishedRow`.
    delay_samples : float, optional
        Total delay; needed for Table D.6, and not compared elsewhere, where the delay is that of the device.
    """
    rows = (r for r in published_rows() if (r.table, r.criterion, r.condition) == (table, criterion, condition))
    return next((row for row in rows if row.delay_samples in (None, delay_samples)), None)


class HumanArm(Record):
    """One set of parameters: mass [kg], stiffness [N/m] and viscous damping [Ns/m].

    Source: Hulin 2017, Table 3.2.
    """

    source: str
    mass: Positive
    stiffness: Positive
    damping: Positive


@cache
def human_arms() -> tuple[HumanArm, ...]:
    """Return all rows of Table 3.2.

    Raises
    ------
    StoreError
        If the file that ships with the package is missing or damaged.
    """
    return shipped_rows(_ARMS, HumanArm)

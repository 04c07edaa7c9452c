"""Parameters of the human arm from the literature (Table 3.2).

The file ``schemas/published/hulin-2017-human-arm.csv`` ships with the package.
"""

from __future__ import annotations

import csv
from functools import cache

from pydantic import ValidationError

from pipeline.errors import StoreError
from pipeline.models import Positive, Record
from pipeline.provenance import schema_folder

_FILE = "hulin-2017-human-arm.csv"


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
    path = schema_folder() / "published" / _FILE
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
        return tuple(HumanArm.model_validate(row) for row in csv.DictReader(lines))
    except (OSError, ValidationError) as error:
        raise StoreError(
            f"{path}: expected rows of source, mass, stiffness and damping that ship with the package, found {error}. "
            "Install the package again."
        ) from error

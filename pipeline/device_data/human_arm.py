"""Parameters of the human arm from the literature (Table 3.2).

The file ``schemas/published/hulin-2017-human-arm.csv`` ships with the package.
"""

from __future__ import annotations

from functools import cache

from pipeline.device_data.published import shipped_rows
from pipeline.records.findings import Record
from pipeline.records.models import Positive

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
    return shipped_rows(_FILE, HumanArm)

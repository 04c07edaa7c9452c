"""Logs whose command obeys another wall or step than their headers state: nothing in K and B rests on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.law.wall_law import WallLaw
from pipeline.records.batch import Floats

OTHER_WALL = 0.02
"""Departure from the stated law, relative to the step, from which on the wall is another one: a course brackets its
limits no closer. A header that rounds K and B stays below."""


@dataclass(frozen=True, eq=False)
class OtherWalls:
    """Of each trial K, B and step that its command obeys, shape (n, 3), NaN where the stated ones; and this in words.

    ``reason`` is empty where the command obeys what its header states.
    """

    obeyed: Floats
    reason: tuple[str, ...]


def other_walls(law: WallLaw) -> OtherWalls:
    """Return which commands obey another wall or step than stated."""
    obeyed, reason = np.full((len(law.departures), 3), np.nan), [""] * len(law.departures)
    for i, found in enumerate(law.departures):
        other = next((each for each in found if each.obeyed is not None), None)
        if other is not None and law.residual[i] > OTHER_WALL:
            obeyed[i], reason[i] = other.obeyed, other.evidence
    return OtherWalls(obeyed, tuple(reason))

"""Logs whose command obeys another wall or step than their headers state: nothing in K and B rests on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.response import Response
from pipeline.measured.signal.wall_law import wall_law
from pipeline.records.batch import Floats, TrialBatch

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


def other_walls(batch: TrialBatch, response: Response) -> OtherWalls:
    """Return which commands obey another wall or step than stated."""
    law = wall_law(batch, response)
    obeyed, reason = np.full((len(batch), 3), np.nan), [""] * len(batch)
    for i, found in enumerate(law.departures):
        other = next((each for each in found if each.obeyed is not None), None)
        if other is not None and law.residual[i] > OTHER_WALL:
            obeyed[i], reason[i] = other.obeyed, other.evidence
    return OtherWalls(obeyed, tuple(reason))

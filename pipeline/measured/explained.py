"""When a model explains what was measured."""

from __future__ import annotations

EXPLAINED = 0.9
"""Share of the logs that a model explains which is right: chance leaves 5 % of them unexplained."""


def holds(explained: int, of: int) -> bool:
    """Return whether so many of some trials are nearly all; of few one may be left to chance.

    >>> holds(9, 10), holds(5, 6), holds(4, 6), holds(17, 20), holds(1, 2)
    (True, True, False, False, False)
    """
    return of - explained <= max((1 - EXPLAINED) * of, 1) and explained > of / 2

"""Arguments of compiled functions that do not change between calls."""

from __future__ import annotations

from typing import Any


class Constants(tuple[Any, ...]):
    """Arguments that do not change. Their numbers and addresses are collected at the first call only.

    The arrays may not be resized, and all functions that take them must have the same types for them.

    Examples
    --------
    >>> Constants((1.0, 2.0)) == (1.0, 2.0)
    True
    """

    words: list[Any] | None = None

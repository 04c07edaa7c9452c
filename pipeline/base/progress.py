"""How far long work is: each part reports its share of the whole; without a listener nothing happens.

A part covers a range of the part around it, so that a function reports from 0 to 1 whatever calls it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace

Listener = Callable[[str, float], None]
"""Hears the name of what is done now, and the share of the whole that is done, 0 to 1."""


@dataclass(frozen=True)
class _Part:
    listener: Listener
    name: str = ""
    begin: float = 0.0
    end: float = 1.0


_PART: ContextVar[_Part | None] = ContextVar("part", default=None)
_SHARE = ContextVar("share", default=0.0)
"""Share of the part around that is done."""


@contextmanager
def heard_by(listener: Listener) -> Iterator[None]:
    """Have a listener hear what is reported inside."""
    token = _PART.set(_Part(listener))
    _SHARE.set(0.0)
    try:
        yield
    finally:
        _PART.reset(token)


@contextmanager
def part_of_work(name: str, begin: float, end: float) -> Iterator[None]:
    """Report what is done inside as a part of the work around it, from one share of that to another.

    Parameters
    ----------
    name : str
        What is done; that of the part around it where it is empty.
    begin, end : float
        Shares of the part around it, 0 to 1.

    Examples
    --------
    >>> with heard_by(lambda name, share: print(name, share)):
    ...     with part_of_work("read", 0.0, 0.5):
    ...         report(0.5)
    read 0.0
    read 0.25
    """
    around = _PART.get()
    if around is None:
        yield
        return
    size = around.end - around.begin
    inner = replace(around, name=name or around.name, begin=around.begin + begin * size, end=around.begin + end * size)
    token, share = _PART.set(inner), _SHARE.get()
    report(0.0)
    try:
        yield
    finally:
        _PART.reset(token)
        _SHARE.set(max(share, end))


class Names:
    """Listener that hands on the name of each part when it begins."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._last = say, ""

    def __call__(self, name: str, share: float) -> None:
        """Hear how far a part is."""
        if name and name != self._last:
            self._last = name
            self._say(name)


def report(share: float) -> None:
    """Report the share of the part around that is done, 0 to 1."""
    part = _PART.get()
    if part is not None:
        _SHARE.set(share)
        part.listener(part.name, part.begin + min(max(share, 0.0), 1.0) * (part.end - part.begin))


def approach(fraction: float) -> None:
    """Report that a fraction of the remaining part is done, for work of unknown length.

    >>> with heard_by(lambda name, share: print(share)):
    ...     approach(0.5)
    ...     approach(0.5)
    0.5
    0.75
    """
    if _PART.get() is not None:
        report(_SHARE.get() + fraction * (1 - _SHARE.get()))

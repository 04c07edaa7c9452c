"""Progress of long computations. A part of the work reports its completed share to a listener, if there is one. Each
part covers a range of its enclosing part, so a function reports shares from 0 to 1, whatever its caller.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace

Listener = Callable[[str, float], None]
"""Callback that receives the name of the current part and the completed share of the total work (0 to 1)."""


@dataclass(frozen=True)
class _Part:
    listener: Listener
    name: str = ""
    begin: float = 0.0
    end: float = 1.0


_PART: ContextVar[_Part | None] = ContextVar("part", default=None)
_SHARE = ContextVar("share", default=0.0)
"""Completed share of the enclosing part."""


@contextmanager
def heard_by(listener: Listener) -> Iterator[None]:
    """Pass the progress that is reported in the block to a listener."""
    token = _PART.set(_Part(listener))
    _SHARE.set(0.0)
    try:
        yield
    finally:
        _PART.reset(token)


@contextmanager
def part_of_work(name: str, begin: float, end: float) -> Iterator[None]:
    """Map the progress that is reported in the block to a range of the enclosing part.

    Parameters
    ----------
    name : str
        Name of the part. If it is empty, the name of the enclosing part is used.
    begin, end : float
        Start and end of the range, as shares of the enclosing part from 0 to 1.

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
    """Listener that passes the name of each part to a function when the part begins."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._last = say, ""

    def __call__(self, name: str, share: float) -> None:
        """Receive the name and the progress of a part."""
        if name and name != self._last:
            self._last = name
            self._say(name)


def report(share: float) -> None:
    """Report the completed share of the current part (0 to 1)."""
    part = _PART.get()
    if part is not None:
        _SHARE.set(share)
        part.listener(part.name, part.begin + min(max(share, 0.0), 1.0) * (part.end - part.begin))


def approach(fraction: float) -> None:
    """Report that a fraction of the remaining work of a part is done. This function is meant for work of unknown
    length.

    >>> with heard_by(lambda name, share: print(share)):
    ...     approach(0.5)
    ...     approach(0.5)
    0.5
    0.75
    """
    if _PART.get() is not None:
        report(_SHARE.get() + fraction * (1 - _SHARE.get()))

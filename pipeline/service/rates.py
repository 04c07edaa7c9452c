"""How often one sender may ask: a bucket of requests each, which fills again at a steady rate."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

BURST_S = 10.0
"""Seconds whose requests may come at once: a page loads several things, a program asks in bursts."""

MOST_KNOWN = 10_000
"""Senders that are remembered; beyond these, those that may ask freely are forgotten."""


class Rates:
    """Requests by sender.

    Parameters
    ----------
    per_minute : int
        Requests that a sender may make; 0 sets no limit.
    clock : callable
        Time [s].
    """

    def __init__(self, per_minute: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.per_s, self.clock = per_minute / 60.0, clock
        self.most = max(1.0, self.per_s * BURST_S)
        self._lock = threading.Lock()
        self._left: dict[str, tuple[float, float]] = {}

    def wait_s(self, sender: str) -> float:
        """Take a request of a sender; return how long he has to wait instead where he asked too often, else 0."""
        if not self.per_s:
            return 0.0
        now = self.clock()
        with self._lock:
            left = self._now(sender, now)
            if left < 1.0:
                return (1.0 - left) / self.per_s
            if len(self._left) >= MOST_KNOWN:
                self._left = {who: kept for who, kept in self._left.items() if self._now(who, now) < self.most}
            self._left[sender] = (left - 1.0, now)
        return 0.0

    def _now(self, sender: str, now: float) -> float:
        left, since = self._left.get(sender, (self.most, now))
        return min(self.most, left + (now - since) * self.per_s)

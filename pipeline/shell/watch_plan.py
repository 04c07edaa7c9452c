"""Plans beside a rig: takes in each log that arrives, and says which wall to try next."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path

from pipeline.base.errors import StoreError
from pipeline.base.process import process_pool
from pipeline.intake.ingest import ingest
from pipeline.measured.model.parts import Choice, chosen
from pipeline.measured.model.recordings import Recording
from pipeline.plan.course import Learnt, Wish, open_course
from pipeline.plan.planner import Plan, plan_of
from pipeline.shell.watch import Arrivals, look_at

INTERVAL_S, SETTLE_S = 0.1, 0.3
"""Time between two looks, and for which a log must stay the same before it is read [s]: the next wall is told within
a second."""


class Beside:
    """Looks for the parts of a device in another process, so that no answer waits for it."""

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self.pool = pool
        self.running: Future[Choice] | None = None

    def __call__(self, recordings: list[Recording]) -> Choice | None:
        """Return what was found since it was first asked; None as long as it looks."""
        if self.running is None:
            self.running = self.pool.submit(chosen, recordings)
        if not self.running.done():
            return None
        found, self.running = self.running.result(), None
        return found


def watch_plan(
    folders: Sequence[Path],
    name: str,
    processed: Path,
    experiment: str | None,
    wish: Wish,
    *,
    profile: str | None,
    emit: Callable[[Plan], None],
    refused: Callable[[str], None],
    stopped: Callable[[], bool],
) -> None:
    """Tell the plan at first and after each new log, until it is done or ``stopped``.

    Parameters
    ----------
    folders : sequence of Path
        In which logs arrive.
    name, processed, experiment, wish
        As of `planner.plan`.
    profile : str or None
        Log profile by name, or a profile file.
    emit, refused : callable
        Get each plan, and what is said of logs that go into quarantine.
    stopped : callable
        Asked between two looks.
    """
    with process_pool(1) as pool:
        look = Beside(pool)
        arrivals = Arrivals(SETTLE_S)
        arrivals.update(look_at(folders, (), (processed,))[0], time.monotonic() - SETTLE_S)
        known: Learnt | None = None
        told: set[tuple[str, str]] = set()
        first = True
        while not stopped():
            now = time.monotonic()
            arrivals.update(look_at(folders, (), (processed,))[0], now)
            if not (first or arrivals.ready(now)):
                time.sleep(INTERVAL_S)
                continue
            growing = arrivals.restless(now)
            arrivals.take(now)
            try:
                report = ingest(folders, processed, profile, growing=tuple(growing))
            except StoreError as error:  # another command writes there: the next look tries again
                refused(str(error))
                arrivals = Arrivals(SETTLE_S)
                time.sleep(1.0)
                continue
            new = [(refusal.path, refusal.reason) for refusal in report.quarantined]
            for path, reason in new:
                if (path, reason) not in told:
                    refused(f"refused: {path}: {reason}")
            told |= set(new)
            course = open_course(name, processed, experiment, wish, known, look)
            known, answer = course.learnt, plan_of(course, wish)
            emit(answer)
            if answer.done:
                return
            first = False

"""Processes that execute jobs one after the other, and the server threads that supervise them.

A process is run as ``python -m pipeline.service.workers PROCESSED REPORTS KINDS``, of which the last argument is one of
`database.WORKS`. A byte on standard input signals that a job is waiting. The end of file signals that the server has
ended. The process then ends as well, and another process takes its job when the lease has expired. Job functions write
atomically and can be repeated. A thread of the server requests the renewal of reports when no other job is waiting, and
removes old files.
"""

from __future__ import annotations

import logging
import os
import secrets
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.base.errors import EXIT_ERROR, PipelineError
from pipeline.base.process import begin_alone
from pipeline.service.database import KEPT_S, WORKS, Database
from pipeline.service.settings import Settings

BEAT_S = 1.0
"""Time between two heartbeats, and longest time between two checks for a waiting job [s]."""

LOOK_S, TIDY_S = 1.0, 3600.0
"""Polling interval for jobs, and interval between clean-ups [s]."""


class Workers:
    """Workers of a server. They end when the server ends, even if the server is killed."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self.settings, self.database = settings, database
        self._running: list[subprocess.Popen[bytes]] = []
        self._ended = threading.Event()

    def start(self, renew: Callable[[], None]) -> None:
        """Start all workers. The function ``renew`` requests the renewal of reports."""
        for kinds in WORKS:
            threading.Thread(target=self._keep, args=(kinds,), daemon=True).start()
        threading.Thread(target=self._renew, args=(renew,), daemon=True).start()

    def stop(self) -> None:
        """Stop all workers. Other workers take their jobs when the leases expire."""
        self._ended.set()
        for process in list(self._running):
            process.kill()

    def wake(self) -> None:
        """Signal that a job is waiting."""
        for process in list(self._running):
            try:
                assert process.stdin is not None
                process.stdin.write(b"\n")
            except OSError:  # the process has just ended, and its successor polls for jobs anyway
                pass

    def _keep(self, kinds: str) -> None:
        given = [str(self.settings.processed), str(self.settings.reports), kinds]
        command = [sys.executable, "-m", "pipeline.service.workers", *given]
        while not self._ended.is_set():
            # The process has a separate session, so that Ctrl-C ends only the server, which then ends its workers.
            with subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0, start_new_session=True
            ) as process:
                self._running.append(process)
                assert process.stdout is not None
                owner = process.stdout.readline().decode().strip()
                if self._ended.is_set():
                    process.kill()
                process.wait()
                self._running.remove(process)
            self.database.free(owner, blamed=not self._ended.is_set())
            self._ended.wait(0.2)
        self.database.close()

    def _renew(self, renew: Callable[[], None]) -> None:
        database = self.database
        done, tidied = _stages(database), 0.0
        while not self._ended.wait(LOOK_S):
            try:
                if time.monotonic() - tidied > TIDY_S or not tidied:
                    tidied = time.monotonic()
                    remove_old(self.settings, database.forget_old())
                counts, now = database.job_counts(), _stages(database)
                if now == done or counts.get("queued") or counts.get("running"):
                    continue
                done = now
                if self.settings.renew:
                    renew()
            except (PipelineError, OSError):
                logging.getLogger("pipeline.service").exception("reports could not be updated")
        database.close()


def _stages(database: Database) -> int:
    """Return the number of completed computations of the verdicts and costs of the whole store."""
    return database.job_counts("kind = 'stages'").get("done", 0)


def remove_old(settings: Settings, keys: set[str]) -> None:
    """Remove old documents and reports to which no job refers any more. They can be recomputed."""
    for folder in (settings.comparisons, settings.data / "documents"):
        for file in folder.glob("*"):
            if file.is_file() and file.stem not in keys and time.time() - file.stat().st_mtime > KEPT_S:
                file.unlink(missing_ok=True)


@contextmanager
def _beating(database: Database, job: str, owner: str) -> Iterator[Callable[[object], None]]:
    """Report the progress of a running job. If another process has taken the job, end this process."""
    progress, done = deque[object]([None], maxlen=1), threading.Event()

    def beat() -> None:
        while not done.wait(BEAT_S):
            if not database.heartbeat(job, owner, progress[0]):
                # The job was cancelled. Incomplete files are harmless, because readers ignore their names.
                os._exit(EXIT_ERROR)
        database.close()

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield progress.append
    finally:
        done.set()
        thread.join()


def work(settings: Settings, database: Database, owner: str, kinds: str = " ".join(WORKS)) -> bool:
    """Execute the next job. Return False if no job is waiting."""
    job = database.claim(owner, kinds)
    if job is None:
        return False
    from pipeline.service.problems import Problem, problem_of
    from pipeline.service.results import KINDS

    result, problem, begun = None, None, time.time()
    with _beating(database, job.id, owner) as say:
        try:
            result = KINDS[job.kind](settings, database, job.request, say)
        except (PipelineError, Problem) as error:
            problem = problem_of(error).document
        except OSError as error:
            problem = Problem(503, str(error)).document
        except Exception:
            # A defect ends this process and leaves a traceback in the server's log. Another process executes the
            # waiting jobs.
            detail = f"This is a defect of the program. The log of the server contains the details of job {job.id}."
            database.finish(job.id, owner, problem={"title": "The job failed", "status": 500, "detail": detail})
            raise
    if job.kind != "stages" and database.job_counts(f"kind = 'stages' AND created > {begun}"):
        # this worker may have overwritten current stages with stages of earlier trials
        database.add_job("stages", {}, "stages")
    database.finish(job.id, owner, result, problem)
    return True


def main() -> None:
    """Execute jobs until the server ends."""
    begin_alone()
    settings = Settings(Path(sys.argv[1]), Path(sys.argv[2]))
    waiting = threading.Event()

    def listen() -> None:
        while os.read(0, 1):
            waiting.set()
        os._exit(EXIT_ERROR)

    threading.Thread(target=listen, daemon=True).start()
    database, owner = Database(settings.data), f"{os.getpid()}-{secrets.token_hex(4)}"
    print(owner, flush=True)
    while True:
        while work(settings, database, owner, sys.argv[3]):
            pass
        waiting.wait(BEAT_S)
        waiting.clear()


if __name__ == "__main__":
    main()

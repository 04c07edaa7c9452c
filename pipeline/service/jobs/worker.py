"""A process that works at jobs, one after the other, while its server lives.

Run as ``python -m pipeline.service.jobs.worker PROCESSED REPORTS KINDS``, of which the last is one of
`database.WORKS`. A byte on standard input says that a job waits, its end that the server ended: then this process
ends, too, and another one takes the job when its lease has run out. What the functions of jobs write is whole at any
moment, and they can be run again.
"""

from __future__ import annotations

import os
import secrets
import sys
import threading
import time
from pathlib import Path

from pipeline.base.errors import EXIT_ERROR, PipelineError
from pipeline.base.process import begin_alone
from pipeline.service.database import WORKS, Database
from pipeline.service.settings import Settings

BEAT_S = 1.0
"""Time between two heartbeats, and longest wait for a job [s]."""


class _Beats:
    """Tells that a job is worked at, and how far; ends the process if it is not this one's any more."""

    def __init__(self, database: Database, job: str, owner: str) -> None:
        self.database, self.job, self.owner = database, job, owner
        self.progress: object = None
        self.done = threading.Event()
        self.thread = threading.Thread(target=self._beat, daemon=True)

    def _beat(self) -> None:
        while not self.done.wait(BEAT_S):
            if not self.database.heartbeat(self.job, self.owner, self.progress):
                # cancelled: files that were not complete have names that readers leave out
                os._exit(EXIT_ERROR)
        self.database.close()

    def __enter__(self) -> _Beats:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.done.set()
        self.thread.join()

    def say(self, progress: object) -> None:
        """Take the progress that the next heartbeat tells."""
        self.progress = progress


def work(settings: Settings, database: Database, owner: str, kinds: str = " ".join(WORKS)) -> bool:
    """Do the next job; return whether there was one."""
    job = database.claim(owner, kinds)
    if job is None:
        return False
    from pipeline.service.jobs.results import KINDS
    from pipeline.service.problems import Problem, problem_of

    shown = database.job(job["id"])
    assert shown is not None, "jobs are never removed"
    result, problem, begun = None, None, time.time()
    with _Beats(database, job["id"], owner) as beats:
        try:
            result = KINDS[job["kind"]](settings, database, shown["request"], beats.say)
        except (PipelineError, OSError, Problem) as error:
            problem = (error if isinstance(error, Problem) else problem_of(error)).document
        except Exception:
            # a defect ends this process with its traceback, in the server's log; another one does what waits
            detail = f"A defect of the program; the server's log has the details of job {job['id']}."
            database.finish(job["id"], owner, problem={"title": "The job failed", "status": 500, "detail": detail})
            raise
    if job["kind"] != "stages" and database.job_counts(f"kind = 'stages' AND created > {begun}"):
        # it may have stored stages of the trials of before over those of now
        database.add_job("stages", {}, "stages")
    database.finish(job["id"], owner, result, problem)
    return True


def main() -> None:
    """Work until the server ends."""
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

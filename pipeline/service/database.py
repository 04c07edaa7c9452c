"""What is not in Parquet: jobs with a lease, tokens, sessions, names of uploads, notes and tags (SQLite, WAL).

Every statement is its own transaction, on the disk when it returns. Server, workers and command line share the file.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from pipeline.base.disk import make_folder

Role = Literal["viewer", "contributor", "admin"]
ROLES: tuple[Role, ...] = ("viewer", "contributor", "admin")

LEASE_S = 10.0
"""Time after which a job is another worker's, if its own was not heard of [s]."""

ATTEMPTS = 3
"""Times that a job is begun; a worker that dies with it each time was killed by it."""

FIRST = "upload stages experiment comparison trial"
"""Kinds of jobs as they are taken: logs and their verdicts before what is looked at, figures last."""

SESSION_S = 12 * 3600.0
"""Life of a login [s]."""

ENDED = ("done", "failed", "cancelled")
STATES = ("queued", "running", *ENDED)

_SCHEMA = """
CREATE TABLE IF NOT EXISTS jobs (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT UNIQUE NOT NULL, kind TEXT NOT NULL,
  key TEXT NOT NULL, request TEXT NOT NULL, state TEXT NOT NULL DEFAULT 'queued', progress TEXT, result TEXT,
  problem TEXT, owner TEXT, lease REAL, attempts INTEGER NOT NULL DEFAULT 0, created REAL NOT NULL,
  changed REAL NOT NULL);
CREATE INDEX IF NOT EXISTS jobs_state ON jobs (state, kind, key);
CREATE TABLE IF NOT EXISTS tokens (hash TEXT PRIMARY KEY, name TEXT NOT NULL, role TEXT NOT NULL,
  created REAL NOT NULL);
CREATE TABLE IF NOT EXISTS sessions (hash TEXT PRIMARY KEY, token TEXT NOT NULL, expires REAL NOT NULL);
CREATE TABLE IF NOT EXISTS uploads (sha256 TEXT NOT NULL, profile TEXT NOT NULL, job TEXT NOT NULL, path TEXT NOT NULL,
  name TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS uploads_content ON uploads (sha256, profile);
CREATE INDEX IF NOT EXISTS uploads_path ON uploads (path);
CREATE TABLE IF NOT EXISTS words (kind TEXT NOT NULL, of TEXT NOT NULL, value TEXT NOT NULL, changed REAL NOT NULL,
  PRIMARY KEY (kind, of));
CREATE TABLE IF NOT EXISTS secrets (name TEXT PRIMARY KEY, value TEXT NOT NULL);
"""


def hashed(secret: str) -> str:
    """Return what is stored of a secret; those made here are random, so that a fast hash keeps them."""
    return hashlib.sha256(secret.encode()).hexdigest()


class Database:
    """The service's own file, which nobody else may read; one connection a thread.

    Parameters
    ----------
    folder : Path
        Where it lies; made if needed.
    """

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        with suppress(PermissionError):  # a folder of somebody else is as he made it
            os.chmod(folder, 0o700)
        self.file = folder / "service.sqlite"
        self._local = threading.local()
        with suppress(PermissionError):
            os.close(os.open(self.file, os.O_RDWR | os.O_CREAT, 0o600))
            os.chmod(self.file, 0o600)
        if self.run("PRAGMA user_version")[0][0] == 0:
            self.run("PRAGMA journal_mode = WAL")
            self._connection.executescript(_SCHEMA + "PRAGMA user_version = 1;")
            self.run("INSERT OR IGNORE INTO secrets VALUES ('forms', ?)", secrets.token_hex())

    @property
    def _connection(self) -> sqlite3.Connection:
        if not hasattr(self._local, "connection"):
            connection = sqlite3.connect(self.file, timeout=30.0, isolation_level=None)
            connection.row_factory = sqlite3.Row
            connection.execute("PRAGMA synchronous = FULL")
            self._local.connection = connection
        found: sqlite3.Connection = self._local.connection
        return found

    def run(self, statement: str, *values: object) -> list[sqlite3.Row]:
        """Execute a statement and return its rows."""
        return self._connection.execute(statement, values).fetchall()

    def close(self) -> None:
        """Close the connection of this thread."""
        if hasattr(self._local, "connection"):
            self._local.connection.close()
            del self._local.connection

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Do all statements of a block, or none."""
        self.run("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            if self._connection.in_transaction:  # SQLite has rolled back by itself where the disk is full
                self.run("ROLLBACK")
            raise
        self.run("COMMIT")

    # jobs

    def add_job(self, kind: str, request: dict[str, Any], key: str = "", job: str | None = None) -> str:
        """Queue a job, or return the waiting or running one of the same kind and key; an empty key is no other's.

        A running job of the kind ``stages`` may have passed what is new.
        """
        name = job or secrets.token_hex(8)
        now = time.time()
        self.run(
            "INSERT INTO jobs (id, kind, key, request, created, changed) SELECT ?, ?, ?, ?, ?, ? WHERE ? = '' OR NOT "
            "EXISTS (SELECT 1 FROM jobs WHERE kind = ? AND key = ? AND (state = 'queued' OR (state = 'running' AND "
            "kind != 'stages')))",
            *(name, kind, key, json.dumps(request), now, now, key, kind, key),
        )
        if key:
            same = self.run("SELECT id FROM jobs WHERE kind = ? AND key = ? ORDER BY number DESC LIMIT 1", kind, key)
            name = same[0]["id"]
        return name

    def claim(self, owner: str) -> dict[str, Any] | None:
        """Take a job that waits, or whose worker was not heard of, by `FIRST`; None where there is none."""
        now = time.time()
        rows = self.run(
            "UPDATE jobs SET state = 'running', owner = ?, lease = ?, changed = ? WHERE "
            "number = (SELECT number FROM jobs WHERE state = 'queued' OR (state = 'running' AND lease < ?) "
            "ORDER BY instr(?, kind), number LIMIT 1) RETURNING *",
            *(owner, now + LEASE_S, now, now, FIRST),
        )
        return dict(rows[0]) if rows else None

    def heartbeat(self, job: str, owner: str, progress: object) -> bool:
        """Renew the lease of a job; return whether it still is this worker's."""
        now = time.time()
        rows = self.run(
            "UPDATE jobs SET lease = ?, progress = ?, changed = ? WHERE id = ? AND owner = ? AND state = 'running' "
            "RETURNING id",
            *(now + LEASE_S, json.dumps(progress), now, job, owner),
        )
        return bool(rows)

    def free(self, owner: str, blamed: bool = True) -> None:
        """Let other workers take the job of one that was seen to end; one that ended several of them has failed."""
        now = time.time()
        problem = json.dumps({"title": "The worker ended each time", "status": 500, "detail": _KILLED})
        self.run(
            "UPDATE jobs SET lease = 0, attempts = attempts + ?, changed = ? WHERE owner = ? AND state = 'running'",
            *(blamed, now, owner),
        )
        self.run(
            "UPDATE jobs SET state = 'failed', problem = ? WHERE owner = ? AND state = 'running' AND attempts >= ?",
            *(problem, owner, ATTEMPTS),
        )

    def finish(self, job: str, owner: str, result: object = None, problem: object = None) -> None:
        """Store what became of a job, unless it was cancelled or is another's by now."""
        self.run(
            "UPDATE jobs SET state = ?, result = ?, problem = ?, changed = ? WHERE id = ? AND owner = ? "
            "AND state = 'running'",
            "done" if problem is None else "failed",
            None if result is None else json.dumps(result),
            None if problem is None else json.dumps(problem),
            *(time.time(), job, owner),
        )

    def cancel(self, job: str) -> None:
        """End a job that has not ended; its worker notices at the next heartbeat."""
        self.run(
            "UPDATE jobs SET state = 'cancelled', changed = ? WHERE id = ? AND state IN ('queued', 'running')",
            *(time.time(), job),
        )

    def job(self, job: str) -> dict[str, Any] | None:
        """Return a job as users see it; None where there is none."""
        rows = self.run("SELECT * FROM jobs WHERE id = ?", job)
        return _shown(rows[0]) if rows else None

    def failed_job(self, kind: str, key: str, within_s: float) -> str | None:
        """Return the job of a kind and key that failed a moment ago."""
        since = time.time() - within_s
        rows = self.run(
            "SELECT id FROM jobs WHERE kind = ? AND key = ? AND state = 'failed' AND changed > ?", kind, key, since
        )
        return rows[0]["id"] if rows else None

    def job_counts(self) -> dict[str, int]:
        """Return how many jobs are in which state."""
        rows = self.run("SELECT state, count(*) AS n FROM jobs GROUP BY state")
        return {row["state"]: row["n"] for row in rows}

    def jobs(self, before: int, limit: int) -> list[dict[str, Any]]:
        """Return jobs, the newest first, below a number."""
        rows = self.run("SELECT * FROM jobs WHERE number < ? ORDER BY number DESC LIMIT ?", before, limit)
        return [_shown(row) for row in rows]

    def asked_reports(self) -> list[dict[str, Any]]:
        """Return what was asked for in reports that were made, each once."""
        rows = self.run("SELECT request FROM jobs WHERE kind = 'comparison' AND state = 'done' ORDER BY number")
        asked = [json.loads(row["request"]).get("asked") for row in rows]
        return list({json.dumps(each): each for each in asked if each}.values())

    def stages_done(self) -> int:
        """Return how often verdicts and costs of all that is stored were computed."""
        count: int = self.run("SELECT count(*) FROM jobs WHERE kind = 'stages' AND state = 'done'")[0][0]
        return count

    # who may

    def create_token(self, role: Role, name: str) -> str:
        """Make a token and return it; only its hash is stored."""
        token = f"hp_{secrets.token_urlsafe(32)}"
        self.run("INSERT INTO tokens VALUES (?, ?, ?, ?)", hashed(token), name, role, time.time())
        return token

    def has_tokens(self) -> bool:
        """Return whether somebody may come from another computer."""
        return bool(self.run("SELECT 1 FROM tokens LIMIT 1"))

    def role_of(self, token: str) -> Role | None:
        """Return the role of a token; None where it is none."""
        rows = self.run("SELECT role FROM tokens WHERE hash = ?", hashed(token))
        return rows[0]["role"] if rows else None

    def login(self, token: str) -> str | None:
        """Return the secret of a new session of a token; None where it is none."""
        if self.role_of(token) is None:
            return None
        session, now = secrets.token_urlsafe(32), time.time()
        self.run("DELETE FROM sessions WHERE expires < ?", now)
        self.run("INSERT INTO sessions VALUES (?, ?, ?)", hashed(session), hashed(token), now + SESSION_S)
        return session

    def role_of_session(self, session: str) -> Role | None:
        """Return the role of a session; None where there is none, or its token was revoked."""
        rows = self.run(
            "SELECT role FROM sessions JOIN tokens ON tokens.hash = sessions.token WHERE sessions.hash = ? "
            "AND expires > ?",
            *(hashed(session), time.time()),
        )
        return rows[0]["role"] if rows else None

    def logout(self, session: str) -> None:
        """End a session."""
        self.run("DELETE FROM sessions WHERE hash = ?", hashed(session))

    def form_secret(self) -> str:
        """Return the secret that tokens of forms are made with."""
        value: str = self.run("SELECT value FROM secrets WHERE name = 'forms'")[0]["value"]
        return value

    # words of people

    def words(self, kind: str, of: Sequence[str]) -> Any:
        """Return the notes or tags of a trial or experiment: a text, or a list; empty where there are none."""
        rows = self.run("SELECT value FROM words WHERE kind = ? AND of = ?", kind, json.dumps(of))
        return json.loads(rows[0]["value"]) if rows else "" if kind == "notes" else []

    def all_words(self) -> list[tuple[str, list[str], Any]]:
        """Return all notes and tags that are not empty, with what they belong to."""
        rows = self.run("SELECT kind, of, value FROM words ORDER BY of")
        found = [(row["kind"], json.loads(row["of"]), json.loads(row["value"])) for row in rows]
        return [(kind, of, value) for kind, of, value in found if value]

    def set_words(self, kind: str, of: Sequence[str], value: object) -> None:
        """Replace the notes or tags of a trial or experiment."""
        self.run(
            "INSERT OR REPLACE INTO words VALUES (?, ?, ?, ?)", kind, json.dumps(of), json.dumps(value), time.time()
        )


_KILLED = f"The process that worked at it ended {ATTEMPTS} times; it may need more memory than there is."


def _shown(row: sqlite3.Row) -> dict[str, Any]:
    loaded = {name: None if row[name] is None else json.loads(row[name]) for name in ("progress", "result", "problem")}
    plain = {name: row[name] for name in ("id", "kind", "state", "created", "changed", "number")}
    return {**plain, **loaded, "request": json.loads(row["request"])}

"""SQLite database (in WAL mode) for data that are not in Parquet files.

These are jobs with their leases, tokens, sessions, uploads, notes, tags and the audit.

Every statement is a separate transaction, which has been written to disk when the statement returns. Server, workers
and command line share the database file.
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

from pydantic import BaseModel, ConfigDict

from pipeline.base.disk import make_folder
from pipeline.base.json_object import JsonObject
from pipeline.base.paths import path_of_text
from pipeline.records.findings import Record

Role = Literal["viewer", "contributor", "admin"]
ROLES: tuple[Role, ...] = ("viewer", "contributor", "admin")

SESSION_S = 12 * 3600.0
"""Time after which a login expires [s]."""

LEASE_S = 10.0
"""Time without a heartbeat after which another worker takes over a job [s]."""

ATTEMPTS = 3
"""Largest number of attempts to execute a job. If its worker crashes each time, the job is regarded as the cause."""

WORKS = ("upload", "stages", "experiment plan comparison optimum drawing")
"""Kinds of jobs that each worker executes, in order of priority.

The workers process, respectively, logs with their verdicts, costs, and displayed results. Drawings have the lowest
priority, except for renewed reports.
"""

MOST_DRAWINGS = 100
"""Largest number of queued drawings. The users who requested older drawings have probably left the page."""

KEPT_S = 30 * 86400.0
"""Retention time of ended jobs, and of reports that were replaced by a newer version [s]."""

LOCAL = "this computer"
"""Name of a user without a token."""

ENDED = ("done", "failed", "cancelled")

NEWEST = 2**62
"""A number larger than that of any row."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS jobs (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT UNIQUE NOT NULL, kind TEXT NOT NULL,
  key TEXT NOT NULL, request TEXT NOT NULL, state TEXT NOT NULL DEFAULT 'queued', progress TEXT, result TEXT,
  problem TEXT, owner TEXT, lease REAL, attempts INTEGER NOT NULL DEFAULT 0, created REAL NOT NULL,
  changed REAL NOT NULL, author TEXT NOT NULL DEFAULT '', late INTEGER NOT NULL DEFAULT 0);
CREATE INDEX IF NOT EXISTS jobs_state ON jobs (state, kind, key);
CREATE TABLE IF NOT EXISTS tokens (hash TEXT PRIMARY KEY, name TEXT NOT NULL, role TEXT NOT NULL,
  created REAL NOT NULL, expires REAL);
CREATE TABLE IF NOT EXISTS sessions (hash TEXT PRIMARY KEY, token TEXT NOT NULL, expires REAL NOT NULL);
CREATE TABLE IF NOT EXISTS uploads (sha256 TEXT NOT NULL, profile TEXT NOT NULL, job TEXT NOT NULL, path TEXT NOT NULL,
  name TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS uploads_content ON uploads (sha256, profile);
CREATE INDEX IF NOT EXISTS uploads_path ON uploads (path);
CREATE TABLE IF NOT EXISTS words (kind TEXT NOT NULL, of TEXT NOT NULL, value TEXT NOT NULL, changed REAL NOT NULL,
  author TEXT NOT NULL DEFAULT '', PRIMARY KEY (kind, of));
CREATE TABLE IF NOT EXISTS audit (number INTEGER PRIMARY KEY AUTOINCREMENT, time REAL NOT NULL, who TEXT NOT NULL,
  did TEXT NOT NULL, what TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS secrets (name TEXT PRIMARY KEY, value TEXT NOT NULL);
"""


class ProblemDocument(BaseModel):
    """Reason why a request failed (RFC 9457)."""

    model_config = ConfigDict(extra="allow")
    title: str
    status: int
    detail: str
    type: str = "about:blank"
    where: str | None = None
    expected: Any = None
    found: Any = None


class Job(Record):
    """A job; `result` is null until the job is done. `problem` is null unless the job failed."""

    id: str
    number: int
    kind: str
    author: str
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    created: float
    changed: float
    request: JsonObject
    progress: Any
    result: Any
    problem: ProblemDocument | None

    @property
    def has_ended(self) -> bool:
        """True if the job is done, failed or cancelled."""
        return self.state in ENDED


class Deed(Record):
    """A manual action, with its time and user."""

    number: int
    time: float
    who: str
    did: str
    what: JsonObject


class Words(Record):
    """Notes (a text) or tags (a list) of a trial or experiment, with the author and the time of the last change [s]."""

    value: Any
    author: str | None = None
    changed: float | None = None


def hashed(secret: str) -> str:
    """Return the hash under which a secret is stored. A fast hash is sufficient because the secrets are random
    numbers."""
    return hashlib.sha256(secret.encode()).hexdigest()


_OWN = "WHERE id = ? AND owner = ? AND state = 'running'"


def connected(local: threading.local, file: Path, synchronous: str) -> sqlite3.Connection:
    """Return the connection of this thread to a file, stored in `local`."""
    if not hasattr(local, "connection"):
        local.connection = sqlite3.connect(file, timeout=30.0, isolation_level=None)
        local.connection.row_factory = sqlite3.Row
        local.connection.execute(f"PRAGMA synchronous = {synchronous}")
    found: sqlite3.Connection = local.connection
    return found


class Database:
    """Private database file of the service, which only its user can read. Each thread has its own connection.

    Parameters
    ----------
    folder : Path
        Folder of the file. It is created if it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        with suppress(PermissionError):  # the permissions of another user's folder stay unchanged
            os.chmod(folder, 0o700)
        self.file = folder / "service.sqlite"
        self._local = threading.local()
        with suppress(PermissionError):
            os.close(os.open(self.file, os.O_RDWR | os.O_CREAT, 0o600))
            os.chmod(self.file, 0o600)
        if not self.run("PRAGMA user_version")[0][0]:
            self._connection.executescript(f"PRAGMA journal_mode = WAL; {_SCHEMA} PRAGMA user_version = 2;")
            self.run("INSERT OR IGNORE INTO secrets VALUES ('forms', ?)", secrets.token_hex())

    @property
    def _connection(self) -> sqlite3.Connection:
        return connected(self._local, self.file, "FULL")

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
        """Execute either all statements of a block or none of them."""
        self.run("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            if self._connection.in_transaction:  # SQLite has already rolled back if the disk is full
                self.run("ROLLBACK")
            raise
        self.run("COMMIT")

    # jobs

    def add_job(
        self, kind: str, request: JsonObject, key: str = "", job: str | None = None, author: str = "", late: int = 0
    ) -> str:
        """Queue a job, or return the waiting or running job of the same kind with the same key. An empty key always
        queues a new job.

        A running job of the kind ``stages`` is not reused because it may miss new trials.
        """
        name, now = job or secrets.token_hex(8), time.time()
        same = "kind = ? AND key = ? AND (state = 'queued' OR (state = 'running' AND kind != 'stages'))"
        self.run(
            "INSERT INTO jobs (id, kind, key, request, created, changed, author, late) SELECT ?, ?, ?, ?, ?, ?, ?, ? "
            f"WHERE ? = '' OR NOT EXISTS (SELECT 1 FROM jobs WHERE {same})",
            *(name, kind, key, json.dumps(request), now, now, author, late, key, kind, key),
        )
        if kind in ("optimum", "drawing"):  # requested by readers
            waiting = "FROM jobs WHERE state = 'queued' AND kind IN ('optimum', 'drawing')"
            self.run(
                f"UPDATE jobs SET state = 'cancelled', changed = ? WHERE number IN (SELECT number {waiting} "
                "ORDER BY number DESC LIMIT -1 OFFSET ?)",
                *(now, MOST_DRAWINGS),
            )
        if not key:
            return name
        if not late:  # a user waits for a job that was queued with low priority
            self.run("UPDATE jobs SET late = 0 WHERE kind = ? AND key = ? AND state = 'queued'", kind, key)
        rows = self.run("SELECT id FROM jobs WHERE kind = ? AND key = ? ORDER BY number DESC LIMIT 1", kind, key)
        return str(rows[0]["id"])

    def claim(self, owner: str, kinds: str = " ".join(WORKS)) -> Job | None:
        """Take a waiting job of these kinds, or a running job whose worker has no heartbeat. Return None if there is no
        such job.
        """
        now = time.time()
        rows = self.run(
            "UPDATE jobs SET state = 'running', owner = ?, lease = ?, changed = ? WHERE "
            "number = (SELECT number FROM jobs WHERE (state = 'queued' OR (state = 'running' AND lease < ?)) "
            "AND instr(?, kind) ORDER BY late, instr(?, kind), number LIMIT 1) RETURNING *",
            *(owner, now + LEASE_S, now, now, kinds, kinds),
        )
        return _job_of(rows[0]) if rows else None

    def heartbeat(self, job: str, owner: str, progress: object) -> bool:
        """Renew the lease of a job. Return False if the job no longer belongs to this worker."""
        given = (time.time() + LEASE_S, json.dumps(progress), time.time(), job, owner)
        return bool(self.run(f"UPDATE jobs SET lease = ?, progress = ?, changed = ? {_OWN} RETURNING id", *given))

    def free(self, owner: str, blamed: bool = True) -> None:
        """Release the job of a worker that has ended. A job that ended several workers counts as failed."""
        mine = "WHERE owner = ? AND state = 'running'"
        given = (blamed, time.time(), owner)
        self.run(f"UPDATE jobs SET lease = 0, attempts = attempts + ?, changed = ? {mine}", *given)
        problem = json.dumps({"title": "The worker ended each time", "status": 500, "detail": _KILLED})
        ended = (problem, owner, ATTEMPTS)
        self.run(f"UPDATE jobs SET state = 'failed', problem = ? {mine} AND attempts >= ?", *ended)

    def finish(self, job: str, owner: str, result: object = None, problem: object = None) -> None:
        """Store the outcome of a job, unless it was cancelled or taken by another worker."""
        texts = [None if each is None else json.dumps(each) for each in (result, problem)]
        given = ("failed" if problem else "done", *texts, time.time(), job, owner)
        self.run(f"UPDATE jobs SET state = ?, result = ?, problem = ?, changed = ? {_OWN}", *given)

    def cancel(self, job: str) -> None:
        """Cancel a job that has not ended. Its worker notices this at the next heartbeat."""
        self.run(
            "UPDATE jobs SET state = 'cancelled', changed = ? WHERE id = ? AND state IN ('queued', 'running')",
            *(time.time(), job),
        )

    def job(self, job: str) -> Job | None:
        """Return a job as it is shown to users, or None if it does not exist."""
        rows = self.run("SELECT * FROM jobs WHERE id = ?", job)
        return _job_of(rows[0]) if rows else None

    def failed_job(self, kind: str, key: str, within_s: float) -> str | None:
        """Return the job of a kind and key that failed recently."""
        which = "kind = ? AND key = ? AND state = 'failed' AND changed > ?"
        rows = self.run(f"SELECT id FROM jobs WHERE {which}", kind, key, time.time() - within_s)
        return rows[0]["id"] if rows else None

    def jobs(self, before: int, limit: int, which: str = "1") -> tuple[list[Job], int | None]:
        """Return jobs (``which``, a condition) as `latest` does."""
        rows, last = self.latest("jobs", before, limit, which)
        return [_job_of(row) for row in rows], last

    def latest(self, table: str, before: int, limit: int, which: str = "1") -> tuple[list[sqlite3.Row], int | None]:
        """Return the rows with numbers below a given one, newest first, and the number of the last row, or None if no
        more rows follow.
        """
        given = (min(max(before, 0), NEWEST), limit + 1)
        rows = self.run(f"SELECT * FROM {table} WHERE {which} AND number < ? ORDER BY number DESC LIMIT ?", *given)
        return rows[:limit], rows[limit - 1]["number"] if len(rows) > limit else None

    def reports(self, most: int) -> list[tuple[Job, bool]]:
        """Return the jobs that made comparisons, newest first, each with True if a newer job made the same
        comparison."""
        found, seen = list[tuple[Job, bool]](), set[str]()
        for job in self.jobs(NEWEST, most, "kind = 'comparison' AND state = 'done'")[0]:
            asked = json.dumps(job.request.get("asked", job.id))
            found.append((job, asked in seen))
            seen.add(asked)
        return found

    def uploaded_name(self, path: str) -> str:
        """Return the name under which a source was uploaded, or its path."""
        rows = self.run("SELECT name FROM uploads WHERE path = ?", path)
        return rows[0]["name"] if rows else str(path_of_text(path))

    def uploaded(self) -> dict[str, tuple[str, str]]:
        """Return the name and the uploader of each uploaded log, keyed by its path."""
        rows = self.run("SELECT path, name, author FROM uploads JOIN jobs ON jobs.id = uploads.job")
        return {row["path"]: (row["name"], row["author"]) for row in rows}

    def job_counts(self, which: str = "1") -> dict[str, int]:
        """Return the number of jobs in each state."""
        rows = self.run(f"SELECT state, count(*) AS n FROM jobs WHERE {which} GROUP BY state")
        return {row["state"]: row["n"] for row in rows}

    def forget_old(self) -> set[str]:
        """Remove jobs that ended long ago, and return the remaining keys.

        The last report of each request is kept. Jobs of uploads are kept as well, so that their logs are recognised.
        """
        self.run(
            "DELETE FROM jobs WHERE state IN ('done', 'failed', 'cancelled') AND kind != 'upload' AND changed < ? AND "
            "number NOT IN (SELECT max(number) FROM jobs WHERE kind = 'comparison' AND state = 'done' "
            "GROUP BY json_extract(request, '$.asked'))",
            time.time() - KEPT_S,
        )
        return {row["key"] for row in self.run("SELECT key FROM jobs WHERE key != ''")}

    # Permissions and audit. Only hashes of tokens and logins are stored.

    def create_token(self, role: Role, name: str, days: float | None = None) -> str:
        """Create a token and return it. Only its hash is stored."""
        token, now = f"hp_{secrets.token_urlsafe(32)}", time.time()
        end = None if days is None else now + days * 86400.0
        self.run("INSERT INTO tokens VALUES (?, ?, ?, ?, ?)", hashed(token), name, role, now, end)
        return token

    def tokens(self) -> list[dict[str, str | None]]:
        """Return the id, the role, the name and the expiry date of all tokens."""
        columns = "substr(hash, 1, 12) AS id, role, name, date(expires, 'unixepoch') AS ends"
        return [dict(row) for row in self.run(f"SELECT {columns} FROM tokens ORDER BY created")]

    def revoke_token(self, identifier: str) -> bool:
        """Remove the token with an id. Return False if it did not exist."""
        return bool(self.run("DELETE FROM tokens WHERE substr(hash, 1, 12) = ? RETURNING hash", identifier))

    def has_tokens(self) -> bool:
        """Return True if any token for other computers exists."""
        return bool(self.run("SELECT 1 FROM tokens LIMIT 1"))

    def holder_of(self, token: str) -> tuple[Role, str] | None:
        """Return the role and the name of a token, or None if the token is invalid or has expired."""
        return self._holder("tokens.hash = ?", hashed(token))

    def _holder(self, which: str, secret: str) -> tuple[Role, str] | None:
        known = f"{which} AND (tokens.expires IS NULL OR tokens.expires > ?)"
        both = "tokens LEFT JOIN sessions ON tokens.hash = sessions.token"
        rows = self.run(f"SELECT role, name, tokens.hash FROM {both} WHERE {known}", secret, time.time())
        return (rows[0]["role"], rows[0]["name"] or f"token {rows[0]['hash'][:12]}") if rows else None

    def login(self, token: str) -> str | None:
        """Return the secret of a new session of a token, or None if the token is invalid."""
        if self.holder_of(token) is None:
            return None
        session, now = secrets.token_urlsafe(32), time.time()
        self.run("DELETE FROM sessions WHERE expires < ?", now)
        self.run("INSERT INTO sessions VALUES (?, ?, ?)", hashed(session), hashed(token), now + SESSION_S)
        return session

    def holder_of_session(self, session: str) -> tuple[Role, str] | None:
        """Return the role and the name of a session, or None if it does not exist or its token was revoked."""
        return self._holder(f"sessions.expires > {time.time()} AND sessions.hash = ?", hashed(session))

    def logout(self, session: str) -> None:
        """End a session."""
        self.run("DELETE FROM sessions WHERE hash = ?", hashed(session))

    def form_secret(self) -> str:
        """Return the secret from which form tokens are derived."""
        value: str = self.run("SELECT value FROM secrets WHERE name = 'forms'")[0]["value"]
        return value

    def note(self, who: str, did: str, what: object) -> None:
        """Record a manual action in the audit."""
        given = (time.time(), who, did, json.dumps(what))
        self.run("INSERT INTO audit (time, who, did, what) VALUES (?, ?, ?, ?)", *given)

    def has_noted(self, did: str, what: object) -> bool:
        """Return True if an action with these details, by any user, is in the audit."""
        return bool(self.run("SELECT 1 FROM audit WHERE did = ? AND what = ? LIMIT 1", did, json.dumps(what)))

    def audit(self, before: int, limit: int) -> tuple[list[Deed], int | None]:
        """Return the audit, like `latest`."""
        rows, last = self.latest("audit", before, limit)
        return [Deed.model_validate({**row, "what": json.loads(row["what"])}) for row in rows], last

    # notes and tags

    def words(self, kind: str, of: Sequence[str]) -> Words:
        """Return the notes or tags of a trial or experiment."""
        rows = self.run("SELECT value, author, changed FROM words WHERE kind = ? AND of = ?", kind, json.dumps(of))
        if not rows:
            return Words(value="" if kind == "notes" else [])
        value, author, changed = rows[0]
        return Words(value=json.loads(value), author=author, changed=changed)

    def all_words(self) -> list[tuple[str, list[str], Any]]:
        """Return all notes and tags that are not empty, with the trials or experiments to which they belong."""
        rows = self.run("SELECT kind, of, value FROM words ORDER BY of")
        found = [(row["kind"], json.loads(row["of"]), json.loads(row["value"])) for row in rows]
        return [(kind, of, value) for kind, of, value in found if value]

    def set_words(self, kind: str, of: Sequence[str], value: object, author: str = "") -> None:
        """Replace the notes or tags of a trial or experiment."""
        given = (kind, json.dumps(of), json.dumps(value), time.time(), author)
        self.run("INSERT OR REPLACE INTO words VALUES (?, ?, ?, ?, ?)", *given)

    def move_words(self, old: Sequence[str], new: Sequence[str]) -> None:
        """Move the notes and tags of a renamed experiment, unless the target already has notes or tags."""
        self.run("UPDATE OR IGNORE words SET of = ? WHERE of = ?", json.dumps(new), json.dumps(old))


_KILLED = f"The worker process ended {ATTEMPTS} times. The job may need more memory than is available."


def _job_of(row: sqlite3.Row) -> Job:
    columns = {name: row[name] for name in Job.model_fields}
    for name in ("request", "progress", "result", "problem"):
        columns[name] = None if row[name] is None else json.loads(row[name])
    return Job.model_validate(columns)

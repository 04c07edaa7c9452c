"""Who may come in: tokens with a role, and login sessions of these, until they expire."""

from __future__ import annotations

import hashlib
import secrets
import sqlite3
import time
from abc import ABC, abstractmethod
from typing import Any, Literal

Role = Literal["viewer", "contributor", "admin"]
ROLES: tuple[Role, ...] = ("viewer", "contributor", "admin")

SESSION_S = 12 * 3600.0
"""Life of a login [s]."""


def hashed(secret: str) -> str:
    """Return what is stored of a secret; those made here are random, so that a fast hash keeps them."""
    return hashlib.sha256(secret.encode()).hexdigest()


class Sessions(ABC):
    """Tokens and sessions of a database; of both it holds hashes alone."""

    @abstractmethod
    def run(self, statement: str, *values: object) -> list[sqlite3.Row]:
        """Run one statement and return its rows."""

    def create_token(self, role: Role, name: str, days: float | None = None) -> str:
        """Make a token and return it; only its hash is stored."""
        token, now = f"hp_{secrets.token_urlsafe(32)}", time.time()
        end = None if days is None else now + days * 86400.0
        self.run("INSERT INTO tokens VALUES (?, ?, ?, ?, ?)", hashed(token), name, role, now, end)
        return token

    def tokens(self) -> list[dict[str, Any]]:
        """Return who has tokens: id, role, name and day of expiry."""
        columns = "substr(hash, 1, 12) AS id, role, name, date(expires, 'unixepoch') AS ends"
        return [dict(row) for row in self.run(f"SELECT {columns} FROM tokens ORDER BY created")]

    def revoke_token(self, identifier: str) -> bool:
        """Remove a token by its id; return whether there was one."""
        return bool(self.run("DELETE FROM tokens WHERE substr(hash, 1, 12) = ? RETURNING hash", identifier))

    def has_tokens(self) -> bool:
        """Return whether somebody may come from another computer."""
        return bool(self.run("SELECT 1 FROM tokens LIMIT 1"))

    def holder_of(self, token: str) -> tuple[Role, str] | None:
        """Return role and name of a token; None where it is none, or has expired."""
        return self._holder("tokens.hash = ?", hashed(token))

    def _holder(self, which: str, secret: str) -> tuple[Role, str] | None:
        rows = self.run(
            "SELECT role, name, tokens.hash FROM tokens LEFT JOIN sessions ON tokens.hash = sessions.token WHERE "
            f"{which} AND (tokens.expires IS NULL OR tokens.expires > ?)",
            *(secret, time.time()),
        )
        return (rows[0]["role"], rows[0]["name"] or f"token {rows[0]['hash'][:12]}") if rows else None

    def login(self, token: str) -> str | None:
        """Return the secret of a new session of a token; None where it is none."""
        if self.holder_of(token) is None:
            return None
        session, now = secrets.token_urlsafe(32), time.time()
        self.run("DELETE FROM sessions WHERE expires < ?", now)
        self.run("INSERT INTO sessions VALUES (?, ?, ?)", hashed(session), hashed(token), now + SESSION_S)
        return session

    def holder_of_session(self, session: str) -> tuple[Role, str] | None:
        """Return role and name of a session; None where there is none, or its token was revoked."""
        return self._holder(f"sessions.expires > {time.time()} AND sessions.hash = ?", hashed(session))

    def logout(self, session: str) -> None:
        """End a session."""
        self.run("DELETE FROM sessions WHERE hash = ?", hashed(session))

    def form_secret(self) -> str:
        """Return the secret that tokens of forms are made with."""
        value: str = self.run("SELECT value FROM secrets WHERE name = 'forms'")[0]["value"]
        return value

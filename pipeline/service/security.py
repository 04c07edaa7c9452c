"""Access control. It checks every request before any other code reads it, and sets the headers of every answer.

On loopback, no token is needed. A page of another site cannot exploit this: its Origin is refused, and so is any host
name under which the page made a browser find this computer (Host). Elsewhere, a token is needed. A token is sent as a
Bearer token, or replaced by the cookie of a login.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import math
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from urllib.parse import quote, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.service.database import LOCAL as LOCAL_NAME
from pipeline.service.database import ROLES, Database, Role, hashed
from pipeline.service.problems import Problem, answer
from pipeline.service.settings import Settings

LOG = logging.getLogger("pipeline.service")

SESSION, FORM = "pipeline-session", "pipeline-form"
"""Names of the cookie for a login, and of the cookie for the forms of a browser."""

SMALL = 1 << 20
"""Largest size of a request without logs [byte]."""

DRAIN_S = 5.0
"""Time for which a refused client may continue sending [s]. A client that is disconnected at once would not read the
reason."""

OPEN = ("/login", "/api/v1/health")
UPLOADS = ("/upload", "/api/v1/logs")

_LOG_IN = "Send a token as `Authorization: Bearer`, or log in at /login."
SAFE = ("GET", "HEAD", "OPTIONS")
LOCAL = ("localhost", "127.0.0.1", "::1")

HEADERS = {
    "content-security-policy": "default-src 'none'; style-src 'self'; script-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "private, no-cache",
}


BURST_S = 10.0
"""Burst size, in seconds at the permitted rate. Bursts are normal because a page loads several files."""

MOST_KNOWN = 10_000
"""Largest number of tracked senders. If there are more, senders that are not currently limited are dropped."""


class Rates:
    """Requests by sender.

    Parameters
    ----------
    per_minute : int
        Number of requests that a sender may make per minute, or 0 for no limit.
    clock : callable
        Time [s].
    """

    def __init__(self, per_minute: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.per_s, self.clock = per_minute / 60.0, clock
        self.most = max(1.0, self.per_s * BURST_S)
        self._lock = threading.Lock()
        self._left: dict[str, tuple[float, float]] = {}

    def wait_s(self, sender: str) -> float:
        """Count a request of a sender. Return the required waiting time [s] if there were too many requests, otherwise
        0."""
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


class Guard:
    """Outermost layer of the server. It checks each request before any other code reads it."""

    def __init__(self, app: ASGIApp, settings: Settings, database: Database) -> None:
        self.app, self.settings, self.database = app, settings, database
        self.rates = Rates(settings.per_minute)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or refuse a request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        began, status, request_id = time.monotonic(), 0, secrets.token_hex(6)
        scope.setdefault("state", {})
        request = HTTPConnection(scope)

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                headers["x-request-id"] = request_id
                if "form" in scope["state"]:
                    headers.append("set-cookie", cookie(FORM, scope["state"]["form"]))
            await send(message)

        try:
            scope["state"]["role"], scope["state"]["who"] = self._role(request)
            logs = scope["path"] in UPLOADS
            body = _Body(receive, self.settings.max_request if logs else SMALL, self.settings.body_s, whole=not logs)
            body.check(Headers(scope=scope))
            await self.app(scope, body, sending)
        except Problem as problem:
            if status == 0:
                await _refuse(problem, scope, receive, sending)
        finally:
            seconds = time.monotonic() - began
            line = {"id": request_id, "method": scope["method"], "path": scope["path"], "status": status}
            LOG.info(json.dumps({**line, "ms": round(1e3 * seconds, 1)}))

    def _role(self, request: HTTPConnection) -> tuple[Role, str]:
        """Return the role and the name of the sender, or raise a problem if the request is not permitted."""
        headers, path, method = request.headers, request.scope["path"], request.scope["method"]
        host, origin = headers.get("host", ""), headers.get("origin")
        if self.settings.loopback and _name(host) not in LOCAL:
            raise Problem(
                403,
                "The server accepts only requests from this computer, addressed to localhost.",
                where="Host",
                expected=LOCAL,
            )
        if origin is not None and urlsplit(origin).netloc != host:
            raise Problem(403, "Requests from pages of other sites are refused.", where="Origin", expected=host)
        if any(name.lower() in ("token", "access_token", "api_key") for name in request.query_params):
            detail = "A token in a URL is written to the logs of servers. Send the token as `Authorization: Bearer`."
            raise Problem(400, detail, where="query")
        role, who, secret = self._known(headers.get("authorization"), request.cookies.get(SESSION, ""))
        # An unknown sender is identified only by its address, because it may send a different token each time.
        self._limit(hashed(secret) if secret else (request.scope.get("client") or ("",))[0])
        program, public = "authorization" in headers, path in OPEN or path.startswith("/static/")
        if role is None and (program or not public):
            told = "The token is unknown. Create one with `pipeline token create`." if program else _LOG_IN
            raise Problem(401, told, where="Authorization")
        role = "viewer" if self.settings.read_only else role or "viewer"
        needed = _needed(method, path)
        if path not in OPEN and ROLES.index(role) < ROLES.index(needed):
            why = "The server is read-only." if self.settings.read_only else "Ask for a token with a higher role."
            raise Problem(403, f"This needs the role {needed}. {why}", expected=needed, found=role)
        if method not in SAFE and not program and path.startswith("/api/"):
            # Programs send no cookies. A browser may change data only from a page of this server.
            token = headers.get("x-csrf-token", "")
            if (request.cookies or "origin" in headers) and not is_form(self.database, request.cookies, token):
                raise Problem(403, "The form is not from this server. Reload the page.", where="X-CSRF-Token")
        return role, who

    def _limit(self, sender: str) -> None:
        wait_s = self.rates.wait_s(sender)
        if wait_s:
            most = f"{self.settings.per_minute} requests a minute"
            retry = {"Retry-After": str(math.ceil(wait_s))}
            raise Problem(429, "There are too many requests. Try again later.", retry, expected=most)

    def _known(self, given: str | None, session: str) -> tuple[Role | None, str, str]:
        """Return the role of the user (None if unknown), the name, and the token or session that identifies the
        user."""
        if given is None and self.settings.loopback:
            return "admin", LOCAL_NAME, ""
        scheme, _, token = (given or "").partition(" ")
        secret, found = session if given is None else token.strip(), None
        if given is None and secret:
            found = self.database.holder_of_session(secret)
        elif scheme.lower() == "bearer":
            found = self.database.holder_of(secret)
        return (*found, secret) if found else (None, "", "")


def is_form(database: Database, cookies: Mapping[str, str], token: str) -> bool:
    """Return True if the token of a form belongs to the browser that sends the form."""
    own = form_token(database, cookies.get(FORM, ""))
    return FORM in cookies and hmac.compare_digest(own.encode(), token.encode())


def form_token(database: Database, browser: str) -> str:
    """Return the token for forms sent to a browser."""
    return hmac.new(database.form_secret().encode(), browser.encode(), "sha256").hexdigest()


class _Body:
    """Body of a request, limited in size and time.

    The time limit applies to the whole body, or to each piece of a body with logs.
    """

    def __init__(self, receive: Receive, most: int, wait_s: float, *, whole: bool) -> None:
        self.receive, self.most, self.wait_s, self.whole, self.seen = receive, most, wait_s, whole, 0
        self.ended, self.until = False, time.monotonic() + wait_s

    def check(self, headers: Headers) -> None:
        length = headers.get("content-length", "0")
        if not length.isascii() or not length.isdigit():
            raise Problem(400, "Content-Length is not a number.", where="Content-Length")
        self._within(int(length))

    def _within(self, size: int) -> None:
        if size > self.most:
            raise Problem(
                413, "The request is too large. Send fewer files at a time.", expected=f"<= {self.most}", found=size
            )

    async def __call__(self) -> Message:
        if self.ended:
            return await self.receive()  # this call returns when the connection ends
        try:
            left_s = self.until - time.monotonic() if self.whole else self.wait_s
            message = await asyncio.wait_for(self.receive(), max(left_s, 0.1))
        except TimeoutError:
            raise Problem(408, f"The body did not arrive within {self.wait_s:g} s.", where="body") from None
        self.seen += len(message.get("body", b""))
        self.ended = not message.get("more_body", False)
        self._within(self.seen)
        return message


async def _refuse(problem: Problem, scope: Scope, receive: Receive, send: Send) -> None:
    """Send a problem so that even a client that is still sending its request can read it."""
    response = answer(problem)
    accept = Headers(scope=scope).get("accept", "")
    page = scope["method"] == "GET" and not scope["path"].startswith("/api/")
    if problem.status == 401 and page and "text/html" in accept:
        response.status_code = 303
        asked = f"{quote(scope['path'])}?{scope['query_string'].decode('latin-1')}".rstrip("?")
        response.headers["location"] = "/login" if asked == "/" else f"/login?{urlencode({'next': asked})}"
    await send({"type": "http.response.start", "status": response.status_code, "headers": response.raw_headers})
    await send({"type": "http.response.body", "body": response.body, "more_body": True})
    try:
        async with asyncio.timeout(DRAIN_S):
            while problem.status == 413 and (await receive()).get("more_body", False):
                pass
    except TimeoutError:
        pass
    await send({"type": "http.response.body", "body": b""})


def _needed(method: str, path: str) -> Role:
    if method in SAFE or path == "/logout":
        return "viewer"
    removes = method == "DELETE" and not path.startswith(("/api/v1/jobs/", "/api/v1/quarantine/"))
    return "admin" if removes else "contributor"


def _name(host: str) -> str:
    """Return the host name in a Host header, without the port and brackets."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def cookie(name: str, value: str, secure: bool = False) -> str:
    """Return the header of a cookie that scripts cannot read. From other sites, the cookie is sent only when the user
    follows a link.

    A report is sandboxed by its policy, so it counts as another site. Its link back to the pages needs the cookie.
    Changes additionally need the token of a form.
    """
    return f"{name}={value}; Path=/; HttpOnly; SameSite=Lax" + ("; Secure" if secure else "")

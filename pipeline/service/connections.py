"""Limits on client connections. A header must be complete in time, and the number of connections per address is
limited.

A server opens a file for each connection. Without these limits, a client without a token could keep files open by
sending half a header or nothing.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from pipeline.base.errors import UsageError
from pipeline.service.settings import Settings

BACKLOG, AT_ONCE = 2048, 16
"""Number of connections that the system queues until they are accepted, and number of connections that are accepted
before excess connections are closed."""


class Connection(H11Protocol):
    """Connection that is closed if its header is late, or if too many connections from its address have sent no
    header."""

    def __init__(self, *given: object, settings: Settings, **more: object) -> None:
        super().__init__(*given, **more)  # type: ignore[arg-type]
        self.settings, self.since = settings, self.loop.time()
        self.late: asyncio.TimerHandle | None = None

    @property
    def headless(self) -> bool:
        """True if no request is in progress. A request is in progress once its header is complete."""
        return self.conn.their_state is h11.IDLE and self.conn.our_state is h11.IDLE

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection. If its address has too many connections, close the oldest one without a header,
        otherwise the new one."""
        super().connection_made(transport)
        own = [one for one in self.connections if isinstance(one, Connection) and one.address == self.address]
        if len(own) > self.settings.connections:
            waiting = (one for one in own if one.headless and one is not self)
            goes = min(waiting, key=lambda one: one.since, default=self)
            goes.transport.abort()
            self.connections.discard(goes)
            if goes is self:
                return
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        super().connection_lost(exc)
        self._cancel()

    def data_received(self, data: bytes) -> None:
        """Receive data. The timeout for a header runs until the header is complete."""
        super().data_received(data)
        if not self.headless:
            self._cancel()
        elif self.late is None:
            self._wait()

    @property
    def address(self) -> str:
        """Address of the client. All clients of a Unix socket count as one address."""
        return self.client[0] if self.client else ""

    def _wait(self) -> None:
        self.late = self.loop.call_later(self.settings.header_s, self._end)

    def _cancel(self) -> None:
        if self.late is not None:
            self.late.cancel()
            self.late = None

    def _end(self) -> None:
        self.late = None
        if self.headless:
            self.transport.abort()


class _Server(uvicorn.Server):
    """Server with separate limits on connections that are accepted at once and on queued connections.

    Asyncio uses one number for both.
    """

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start listening."""
        await super().startup(sockets)
        for each in sockets or ():
            each.listen(BACKLOG)


def server_of(app: ASGIApp, settings: Settings) -> uvicorn.Server:
    """Return the server of an application."""
    protocol = partial(Connection, settings=settings)
    return _Server(
        uvicorn.Config(
            app, http=protocol, log_config=None, access_log=False, server_header=False, proxy_headers=False,  # type: ignore[arg-type]
            timeout_graceful_shutdown=5, backlog=AT_ONCE,
        )
    )  # fmt: skip


def serve(app: ASGIApp, settings: Settings, say: Callable[[str], None]) -> None:
    """Serve requests until a termination signal arrives. The address is reported as soon as the server can be reached.

    Raises
    ------
    UsageError
        If the address is not available.
    """
    six = ":" in settings.host
    family = socket.AF_INET6 if six else socket.AF_INET
    try:
        found = socket.create_server((settings.host, settings.port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise UsageError(
            f"--host {settings.host} --port {settings.port}: the server cannot listen there ({error}). Choose a "
            "different port, or end the program that uses this one."
        ) from error
    with found, suppress(KeyboardInterrupt):
        host = f"[{settings.host}]" if six else settings.host
        say(f"http://{host}:{found.getsockname()[1]}/")
        server_of(app, settings).run(sockets=[found])

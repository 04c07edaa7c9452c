"""The ASGI application, assembled from its parts."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import chain

from anyio import to_thread
from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response
from starlette.routing import Match
from starlette.types import ASGIApp

from pipeline.base.errors import PipelineError, UsageError
from pipeline.base.provenance import __version__
from pipeline.service import connections, device_files
from pipeline.service.catalogue import Catalogue
from pipeline.service.database import Database
from pipeline.service.pages import frame, pages
from pipeline.service.pages.comparing import comparing
from pipeline.service.problems import TITLES, Later, Problem, problem_of
from pipeline.service.problems import answer as answer_of
from pipeline.service.rest import api
from pipeline.service.rest.answers import describe, only_known
from pipeline.service.rest.lab import lab
from pipeline.service.rest.remarks import remarks
from pipeline.service.security import Guard
from pipeline.service.settings import Settings
from pipeline.service.shared import Service
from pipeline.service.theory import Theory
from pipeline.service.uploads import remove_unacknowledged
from pipeline.service.workers import Workers

ROUTERS = (api.api, lab, remarks, pages.pages, comparing)
ANSWERED = (Problem, Later, PipelineError, OSError, sqlite3.OperationalError, ValidationError, RequestValidationError,
            HTTPException)  # fmt: skip
"""Exceptions that are converted to responses to requests."""

THREADS = 12
"""Number of threads that answer requests. More threads would take memory and compete for the interpreter."""


def create_app(settings: Settings) -> ASGIApp:
    """Return the server as an ASGI application.

    Raises
    ------
    UsageError
        If the server is reachable from other computers and there is no token.
    """
    database = Database(settings.data)
    if not settings.loopback and not database.has_tokens():
        raise UsageError(
            f"--host {settings.host}: other computers could reach the server, but there is no token. Create a token "
            f"first: pipeline token create --role admin --processed {settings.processed}"
        )
    catalogue, workers = Catalogue(settings.processed, database), Workers(settings, database)
    service = Service(settings, database, catalogue, workers, Theory(settings.theory_s))

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        to_thread.current_default_thread_limiter().total_tokens = THREADS
        if not settings.read_only:
            remove_unacknowledged(settings, database)
            service.job("stages", {}, "stages")
            workers.start(service.renew)
        yield
        workers.stop()

    app = FastAPI(
        title="pipeline", version=__version__, lifespan=life, docs_url=None, redoc_url=None,
        openapi_url="/api/v1/openapi.json",
    )  # fmt: skip
    app.openapi = lambda: describe(app)  # type: ignore[method-assign]
    app.state.service = service
    for router in ROUTERS:
        app.include_router(router, dependencies=[Depends(only_known)] if router.prefix else [])
    _answer_errors(app, service)
    app.state.guard = guard = Guard(app, settings, database)
    return guard


def _answer_errors(app: FastAPI, service: Service) -> None:
    async def answer(request: Request, error: Exception) -> Response:
        if isinstance(error, Later):
            where = {"Retry-After": "5", "Location": f"/api/v1/jobs/{error.job}"}
            return JSONResponse({"job": error.job}, 202, where)
        if isinstance(error, HTTPException) and error.status_code not in TITLES:
            return Response(status_code=error.status_code, headers=error.headers)
        problem = problem_of(error)
        if problem.status == 405:
            problem.headers = {"Allow": ", ".join(sorted(_methods(request)))}
        if "text/html" in request.headers.get("accept", "") and not request.url.path.startswith("/api/"):
            return frame.page_of(service, request, "problem.html.j2", problem.status, problem=problem.document)
        return answer_of(problem)

    for kind in ANSWERED:
        app.add_exception_handler(kind, answer)


def _methods(request: Request) -> set[str]:
    """Return the HTTP methods of an address. Each method is a separate route."""
    routes = chain.from_iterable(router.routes for router in ROUTERS)
    found = (route for route in routes if route.matches(request.scope)[0] is not Match.NONE)
    return set[str]().union(*(getattr(route, "methods", ()) for route in found))


def serve(settings: Settings, say: Callable[[str], None]) -> None:
    """Serve requests until a termination signal arrives. The address is reported as soon as the server can be
    reached."""
    logging.getLogger("pipeline.service").setLevel(logging.INFO)
    logging.basicConfig(format="%(message)s")
    device_files.use_folder(settings)
    connections.serve(create_app(settings), settings, say)

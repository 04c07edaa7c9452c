"""The server: its parts put together."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import chain
from typing import Any

from anyio import to_thread
from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response
from starlette.routing import Match
from starlette.types import ASGIApp

from pipeline import __version__
from pipeline.base.errors import PipelineError, UsageError
from pipeline.service import connections
from pipeline.service.catalogue import Catalogue
from pipeline.service.database import Database
from pipeline.service.jobs.workers import Renewal, Workers
from pipeline.service.pages import frame, pages
from pipeline.service.pages.comparing import comparing
from pipeline.service.problems import TITLES, Later, Problem, full_disk, problem_of
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

ROUTERS = (api.api, lab, remarks, pages.pages, comparing)
THREADS = 12
"""That answer requests: more take memory, and the interpreter from each other."""


def create_app(settings: Settings) -> ASGIApp:
    """Return the server as an ASGI application.

    Raises
    ------
    UsageError
        If other computers would reach it and there is no token.
    """
    database = Database(settings.data)
    if not settings.loopback and not database.has_tokens():
        raise UsageError(
            f"--host {settings.host}: other computers would reach the server, and there is no token. Make one first: "
            f"pipeline token create --role admin --processed {settings.processed}"
        )
    workers, theory = Workers(settings, database), Theory(settings.theory_s)
    catalogue = Catalogue(settings.processed, database)
    service = Service(settings, database, catalogue, workers, theory)
    renewal = Renewal(settings, database, service.renew)

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        to_thread.current_default_thread_limiter().total_tokens = THREADS
        if not settings.read_only:
            remove_unacknowledged(settings, database)
            service.job("stages", {}, "stages")
            workers.start()
            renewal.start()
        yield
        renewal.stop()
        workers.stop()
        theory.stop()

    app = FastAPI(
        title="pipeline", version=__version__, lifespan=life, docs_url=None, redoc_url=None,
        openapi_url="/api/v1/openapi.json",
    )  # fmt: skip
    app.openapi = lambda: describe(app)  # type: ignore[method-assign]
    app.state.service = service
    for router in ROUTERS:
        app.include_router(router, dependencies=[Depends(only_known)] if router.prefix else [])
    _answer_errors(app, service)
    app.state.guard = Guard(app, settings, database)
    guard: ASGIApp = app.state.guard
    return guard


def _answer_errors(app: FastAPI, service: Service) -> None:
    def answer(request: Request, problem: Problem) -> Response:
        if "text/html" in request.headers.get("accept", "") and not request.url.path.startswith("/api/"):
            return frame.page_of(service, request, "problem.html.j2", problem.status, problem=problem.document)
        return answer_of(problem)

    @app.exception_handler(Problem)
    async def problem(request: Request, error: Problem) -> Response:
        return answer(request, error)

    @app.exception_handler(Later)
    async def later(_: Request, error: Later) -> Response:
        return JSONResponse({"job": error.job}, 202, {"Retry-After": "5", "Location": f"/api/v1/jobs/{error.job}"})

    @app.exception_handler(PipelineError)
    async def named(request: Request, error: PipelineError) -> Response:
        return answer(request, problem_of(error))

    @app.exception_handler(OSError)
    @app.exception_handler(sqlite3.OperationalError)
    async def failed(request: Request, error: OSError | sqlite3.OperationalError) -> Response:
        problem = full_disk(error)
        if problem is None:
            raise error
        return answer(request, problem)

    @app.exception_handler(ValidationError)
    @app.exception_handler(RequestValidationError)
    async def wrong(request: Request, error: RequestValidationError | ValidationError) -> Response:
        errors: list[Any] = [{"where": ".".join(map(str, e["loc"])), "detail": e["msg"]} for e in error.errors()]
        return answer(request, Problem(422, errors[0]["detail"], where=errors[0]["where"], errors=errors))

    @app.exception_handler(HTTPException)
    async def other(request: Request, error: HTTPException) -> Response:
        if error.status_code not in TITLES:
            return Response(status_code=error.status_code, headers=error.headers)
        headers = {"Allow": ", ".join(sorted(_methods(request)))} if error.status_code == 405 else None
        return answer(request, Problem(error.status_code, str(error.detail), headers))


def _methods(request: Request) -> set[str]:
    """Return the methods that an address has; each is a route of its own."""
    routes = chain.from_iterable(router.routes for router in ROUTERS)
    found = (route for route in routes if route.matches(request.scope)[0] is not Match.NONE)
    return set[str]().union(*(getattr(route, "methods", ()) for route in found))


def serve(settings: Settings, say: Callable[[str], None]) -> None:
    """Serve until a signal asks for an end; the address is said once it can be reached."""
    logging.getLogger("pipeline.service").setLevel(logging.INFO)
    logging.basicConfig(format="%(message)s")
    connections.serve(create_app(settings), settings, say)

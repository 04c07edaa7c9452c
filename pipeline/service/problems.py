"""Convert errors to problem documents (RFC 9457).

A document states the error and its place, the expected and the found value, and the remedy.
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Mapping

from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import ValidationError
from starlette.exceptions import HTTPException

from pipeline.base.errors import DeviceError, PipelineError, StoreError

MEDIA = "application/problem+json"

TITLES = {
    400: "The request is wrong",
    401: "Not logged in",
    403: "Not allowed",
    404: "Not found",
    405: "Method not allowed",
    406: "No such form",
    409: "Conflict with the current state",
    408: "The client is too slow",
    412: "Changed meanwhile",
    413: "Too large",
    422: "A value is wrong",
    429: "Too many requests",
    503: "Not available",
    504: "Took too long",
    507: "The disk is full",
}


_FULL = (
    "The server is out of disk space; nothing from this request was stored. Free some space and send the request again."
)


class Problem(Exception):  # noqa: N818 (RFC 9457 calls it so)
    """A request that cannot be answered.

    Parameters
    ----------
    status : int
    detail : str
        The error and its remedy.
    headers : mapping of str to str, optional
        Headers of the answer.
    **more : object
        Further members of the document, such as ``where``, ``expected`` and ``found``.
    """

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None, **more: object) -> None:
        super().__init__(detail)
        self.status = status
        self.headers = {"WWW-Authenticate": "Bearer", **(headers or {})} if status == 401 else headers
        self.document = {"type": "about:blank", "title": TITLES[status], "status": status, "detail": detail, **more}


class Later(Exception):  # noqa: N818 (nothing is wrong)
    """Raised if a result takes longer than a request waits. The exception contains the job that computes the result."""

    def __init__(self, job: str) -> None:
        super().__init__(job)
        self.job = job


def problem_of(error: Exception) -> Problem:
    """Return the problem document of an error. An unexpected error is raised again."""
    match error:
        case Problem():
            return error
        case PipelineError():
            status = 404 if isinstance(error, DeviceError) else 503 if isinstance(error, StoreError) else 422
            return Problem(status, str(error))
        case ValidationError() | RequestValidationError():
            errors = [{"where": ".".join(map(str, e["loc"])), "detail": e["msg"]} for e in error.errors()]
            return Problem(422, errors[0]["detail"], where=errors[0]["where"], errors=errors)
        case HTTPException():
            return Problem(error.status_code, str(error.detail))
        case OSError(errno=errno.ENOSPC | errno.EDQUOT):
            return Problem(507, _FULL)
        case sqlite3.OperationalError(sqlite_errorcode=sqlite3.SQLITE_FULL):
            return Problem(507, _FULL)
    raise error


def answer(problem: Problem) -> JSONResponse:
    """Return the document of a problem."""
    return JSONResponse(problem.document, problem.status, problem.headers, MEDIA)

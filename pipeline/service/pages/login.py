"""Pages by which people log in and out."""

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.concurrency import run_in_threadpool

from pipeline.service.pages.frame import fields_of, page_of
from pipeline.service.security import SESSION, cookie, cookies_of
from pipeline.service.shared import Shared

doors = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)


@doors.get("/login")
def login(service: Shared, request: Request) -> Response:
    """Show the form that asks for a token."""
    return page_of(service, request, "login.html.j2", wrong=False, following=_following(request))


@doors.post("/login")
async def enter(service: Shared, request: Request) -> Response:
    """Begin a session by a token."""
    fields = await fields_of(service, request)
    session = await run_in_threadpool(service.database.login, fields.get("secret", [""])[0].strip())
    if session is None:
        return page_of(service, request, "login.html.j2", 401, wrong=True, following=_following(request))
    secure = request.headers.get("x-forwarded-proto") == "https"
    return RedirectResponse(_following(request), 303, {"set-cookie": cookie(SESSION, session, secure)})


@doors.post("/logout")
async def leave(service: Shared, request: Request) -> Response:
    """End a session."""
    await fields_of(service, request)
    await run_in_threadpool(service.database.logout, cookies_of(request.scope).get(SESSION, ""))
    return RedirectResponse("/login", 303)


def _following(request: Request) -> str:
    """Return the page that somebody wanted who had to log in first: one of this server, else the first one.

    Browsers take a backslash for a slash, drop blanks, and read two slashes as another server.
    """
    asked = request.query_params.get("next", "/")
    own = asked.startswith("/") and asked[1:2] not in ("/", "\\") and all(" " < sign != "\\" for sign in asked)
    return asked if own else "/"

"""Forms of people: login, and what REST does, sent by a browser without scripts."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import unquote

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import Message

from pipeline.service.pages.frame import Fields, page_of, segment
from pipeline.service.security import SESSION, cookie
from pipeline.service.shared import Shared

forms = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_KEPT = (b"host", b"cookie", b"origin", b"x-forwarded-proto")
"""Headers of a form that the request has that is made of it."""


@forms.post("/do")
async def do(service: Shared, request: Request, fields: Fields) -> Response:
    """Make the REST request of a form, and lead to the page that follows; an error is a page.

    Its fields are those of the document (`_document`); beside them ``method``, ``path`` below the API, ``match`` (the
    ETag that was known) and ``next``, in which ``{field}`` stands for a name.
    """
    method, path, token = (fields.pop(name, [""])[0] for name in ("method", "path", "form"))
    known, following = (fields.pop(name, [usual])[0] for name, usual in (("match", "*"), ("next", "/")))
    document = _document(fields)
    body = json.dumps(document).encode()
    more = {"content-type": "application/json", "content-length": len(body), "x-csrf-token": token, "if-match": known}
    headers = [each for each in request.scope["headers"] if each[0] in _KEPT]
    headers += [(name.encode(), str(value).encode("latin-1", "replace")) for name, value in more.items()]
    asked = {name: request.scope[name] for name in ("type", "asgi", "http_version", "scheme", "server", "client")}
    asked |= {"method": method, "path": f"/api/v1/{unquote(path)}", "query_string": b"", "root_path": ""}
    status, answer = 0, b""

    async def receive() -> Message:
        return {"type": "http.request", "body": body}

    async def send(message: Message) -> None:
        nonlocal status, answer
        status = message.get("status", status)
        answer += message.get("body", b"")

    await request.app.state.guard({**asked, "headers": headers}, receive, send)
    found = json.loads(answer) if answer else {}
    if status >= 400:
        return page_of(service, request, "problem.html.j2", status, problem=found)
    if "job" in found:
        following = f"/jobs/{found['job']}"
    elif "key" in found:
        following = f"/api/v1/comparisons/{found['key']}/report"
    named = re.sub(r"\{(\w+)\}", lambda name: segment(document.get(name[1], "")), following)
    return RedirectResponse(_own(named), 303)


def _document(fields: Mapping[str, list[str]]) -> dict[str, Any]:
    """Return a form as a document: ``x[]`` has all values, ``x,`` a list of words, ``x?`` null where it is empty."""
    found: dict[str, Any] = {}
    for name, values in fields.items():
        text = values[0].replace("\r\n", "\n")
        if name.endswith("[]"):
            found[name[:-2]] = values
        elif name.endswith(","):
            found[name[:-1]] = [word.strip() for word in text.split(",") if word.strip()]
        elif name.endswith("?"):
            found[name[:-1]] = text.strip() or None
        else:
            found[name] = text
    return found


@forms.get("/login")
def login(service: Shared, request: Request) -> Response:
    """Show the form that asks for a token."""
    return _door(service, request, 200)


@forms.post("/login")
def enter(service: Shared, request: Request, fields: Fields) -> Response:
    """Begin a session by a token."""
    session = service.database.login(fields.get("secret", [""])[0].strip())
    if session is None:
        return _door(service, request, 401)
    secure = request.headers.get("x-forwarded-proto") == "https"
    following = _own(request.query_params.get("next", "/"))
    return RedirectResponse(following, 303, {"set-cookie": cookie(SESSION, session, secure)})


@forms.post("/logout")
def leave(service: Shared, request: Request, fields: Fields) -> Response:
    """End a session."""
    service.database.logout(request.cookies.get(SESSION, ""))
    return RedirectResponse("/login", 303)


def _door(service: Shared, request: Request, status: int) -> Response:
    following = _own(request.query_params.get("next", "/"))
    return page_of(service, request, "login.html.j2", status, wrong=status != 200, following=following)


def _own(address: str) -> str:
    """Return the page that somebody wants: one of this server, else the first one.

    Browsers take a backslash for a slash, drop blanks, and read two slashes as another server.
    """
    own = address.startswith("/") and address[1:2] not in ("/", "\\") and all(" " < sign != "\\" for sign in address)
    return address if own else "/"

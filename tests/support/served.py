"""A server of this process on a free port, asked by what Python brings along."""

import html
import json
import re
import socket
import threading
import time
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from http.cookies import SimpleCookie
from types import SimpleNamespace
from urllib.parse import urlencode

from pipeline.service.app import create_app
from pipeline.service.connections import server_of

BOUNDARY = "a-boundary"
HTML = {"Accept": "text/html"}


def form(files, **fields):
    """Body and headers of a form with files: pairs of name and bytes."""
    parts = [
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{value}\r\n'.encode()
        for name, value in fields.items()
    ]
    for name, data in files:
        head = f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="files"; filename="{name}"\r\n\r\n'
        parts.append(head.encode() + data + b"\r\n")
    body = b"".join(parts) + f"--{BOUNDARY}--\r\n".encode()
    return {"body": body, "headers": {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}}


class Client:
    """Asks a server; paths without a slash are those of the API."""

    def __init__(self, port, host="127.0.0.1"):
        self.port, self.host = port, host

    def ask(self, method, path, body=None, headers=None, document=None):
        """Status, headers, and content: parsed where it is JSON."""
        sent = dict(headers or {})
        if document is not None:
            body, sent["Content-Type"] = json.dumps(document), "application/json"
        # longer than the longest `wait_s` of a server here: a busy computer is no failure
        with closing(HTTPConnection(self.host, self.port, timeout=300)) as connection:
            connection.request(method, path if path.startswith("/") else f"/api/v1/{path}", body, sent)
            response = connection.getresponse()
            content = response.read()
        if "json" in response.headers.get("content-type", ""):
            content = json.loads(content)
        return SimpleNamespace(status=response.status, headers=response.headers, content=content)

    def get(self, path, **headers):
        return self.ask("GET", path, headers=headers)

    def done(self, job):
        """What became of a job."""
        until = time.monotonic() + 300
        while time.monotonic() < until:
            found = self.get(f"jobs/{job}").content
            if found["state"] not in ("queued", "running"):
                return found
            time.sleep(0.05)
        raise AssertionError(f"job {job} hangs: {found}")

    def all_done(self):
        """Wait until no job is left, those that jobs have queued included; return all."""
        while True:
            jobs = self.get("jobs?limit=1000").content["items"]
            left = [job["id"] for job in jobs if job["state"] in ("queued", "running")]
            if not left:
                return jobs
            for job in left:
                self.done(job)

    def upload(self, files, **fields):
        """Upload logs and wait until they are stored."""
        answer = self.ask("POST", "logs", **form(files, **fields))
        assert answer.status == 202, answer.content
        return answer.content, self.done(answer.content["job"])


def page(client, path, **headers):
    answer = client.get(path, **{**HTML, **headers})
    return answer.content.decode()


class Browser:
    """Keeps cookies, and sends the forms of pages."""

    def __init__(self, client):
        self.client, self.cookies = client, SimpleCookie()

    def ask(self, method, path, body=None, headers=None):
        cookie = "; ".join(f"{name}={morsel.value}" for name, morsel in self.cookies.items())
        sent = {**HTML, **(headers or {}), **({"Cookie": cookie} if cookie else {})}
        answer = self.client.ask(method, path, body, sent)
        for line in answer.headers.get_all("set-cookie") or ():
            assert "HttpOnly" in line
            assert "SameSite=Lax" in line
            self.cookies.load(line)
        return answer

    def token(self, path):
        return re.search(r'name="form" value="(\w+)"', self.ask("GET", path).content.decode())[1]

    def send(self, path, at, /, **fields):
        body = urlencode({"form": self.token(at), **fields}, doseq=True)
        return self.ask("POST", path, body, {"Content-Type": "application/x-www-form-urlencoded"})

    def do(self, at, method, path, /, **fields):
        """Send the form of a page that makes a request of REST, with the fields that a person fills in."""
        text = self.ask("GET", at).content.decode()
        for form in re.findall(r'<form method="post" action="/do".*?</form>', text, re.DOTALL):
            given = {}
            for name, value in re.findall(r'<input type="hidden" name="([^"]+)" value="([^"]*)">', form):
                given.setdefault(name, []).append(html.unescape(value))
            if (given["method"], given["path"]) == ([method], [path]):
                body = urlencode({**given, **fields}, doseq=True)
                return self.ask("POST", "/do", body, {"Content-Type": "application/x-www-form-urlencoded"})
        raise AssertionError(f"{at} has no form for {method} {path}")


def drop(page, field, path):
    """Drop a file or folder on a field, as the file manager does: the browser reads it itself."""
    page.locator(field).scroll_into_view_if_needed()
    box = page.locator(field).bounding_box()
    given = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
    at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2, "data": given}
    session = page.context.new_cdp_session(page)
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, **at})


@contextmanager
def serving(settings):
    """Serve while the block runs; yields a client."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        server = server_of(create_app(settings), settings)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        while not server.started:
            assert thread.is_alive(), "the server did not start"
            time.sleep(0.01)
        client = Client(listener.getsockname()[1])
        client.settings = settings
        yield client
        server.should_exit = True
        thread.join()

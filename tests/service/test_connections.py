"""Clients that hold connections and say half a word; the others are served meanwhile."""

import re
import shutil
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager, suppress

import pytest
from served import Client, serving

from pipeline.service.settings import Settings

HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n"
SOCKETS, FILES = 260, 256
"""Half headers, and what a computer may allow a process to have open: macOS does so unless it is told otherwise."""


@contextmanager
def halves(port, number):
    """Connections that have sent half a header each."""
    with ExitStack() as held:
        found = [held.enter_context(socket.create_connection(("127.0.0.1", port), timeout=20)) for _ in range(number)]
        for one in found:
            one.sendall(HALF)
        yield found


def closed(connection):
    """Whether the server has closed a connection that it had nothing to say to."""
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


@pytest.fixture
def patient(tmp_path):
    settings = Settings(tmp_path / "processed", tmp_path / "reports", connections=20, header_s=1.0, body_s=1.0)
    with serving(settings) as client:
        yield client


def test_half_headers_are_ended_in_time(patient):
    began = time.monotonic()
    with halves(patient.port, 5) as slow:
        assert patient.get("health").status == 200
        assert all(closed(one) for one in slow)
        assert 0.5 < time.monotonic() - began < 10


def test_a_header_that_trickles_has_no_more_time(patient):
    began = time.monotonic()
    with halves(patient.port, 1) as (slow,):
        slow.settimeout(0.2)
        while time.monotonic() - began < 10:
            try:
                slow.sendall(b"x: y\r\n")
                if slow.recv(1) == b"":
                    break
            except TimeoutError:
                continue
            except OSError:
                break
    assert time.monotonic() - began < 5


def test_one_address_holds_no_more_than_its_share_and_is_served(patient):
    with halves(patient.port, 40) as slow:
        assert patient.get("health").status == 200
        assert closed(slow[0]), "the oldest made room"


def test_a_header_in_two_pieces_and_a_second_request_are_answered(patient):
    with socket.create_connection(("127.0.0.1", patient.port), timeout=20) as connection:
        for _ in range(2):
            connection.sendall(HALF)
            time.sleep(0.2)
            connection.sendall(b"\r\n")
            assert connection.recv(65536).startswith(b"HTTP/1.1 200")
            connection.settimeout(0.3)
            with suppress(TimeoutError):
                while connection.recv(65536):
                    pass
            connection.settimeout(20)


def test_a_body_without_logs_is_there_in_time(patient):
    head = "POST /login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/x-www-form-urlencoded\r\n"
    with socket.create_connection(("127.0.0.1", patient.port), timeout=20) as connection:
        connection.sendall(f"{head}Content-Length: 100\r\n\r\n".encode())
        connection.settimeout(0.3)
        began, answer = time.monotonic(), b""
        while not answer and time.monotonic() - began < 10:
            try:
                connection.sendall(b"a")
                answer = connection.recv(65536)
            except TimeoutError:
                continue
    assert b" 408 " in answer.splitlines()[0]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None or sys.platform == "win32", reason="sets a limit by a shell")
def test_260_half_headers_do_not_stop_a_server_of_256_files(tmp_path):
    serve = f"{sys.executable} -m pipeline serve --port 0 --read-only --processed p --reports r"
    log = tmp_path / "log"
    with (
        log.open("w") as stream,
        subprocess.Popen(["bash", "-c", f"ulimit -n {FILES}; exec {serve}"], stderr=stream, cwd=tmp_path) as process,
    ):
        try:
            until = time.monotonic() + 120
            while not (said := re.search(r"http://127\.0\.0\.1:(\d+)/", log.read_text())):
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < until
                time.sleep(0.1)
            # the address is said when it can be reached, with the port that the system chose
            port = int(said[1])
            client = Client(port)
            assert client.get("health").status == 200
            with halves(port, SOCKETS):
                assert client.get("health").status == 200
        finally:
            process.terminate()


def test_a_port_that_is_taken_is_said(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        command = [sys.executable, "-m", "pipeline", "serve", "--port", str(other.getsockname()[1]), "--read-only"]
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False, timeout=60)
    assert done.returncode == 2
    assert "Choose a different port" in done.stderr
    assert "stop with Ctrl-C" not in done.stderr

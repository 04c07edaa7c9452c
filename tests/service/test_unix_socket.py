"""A server at a path: its owner's alone, at no address, and gone with the server."""

import signal
import socket
import subprocess
import sys
import time

import pytest

from pipeline.base.errors import UsageError
from pipeline.service.unix_socket import listening


def asked(path, host="localhost"):
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(20)
        connection.connect(str(path))
        connection.sendall(f"GET /api/v1/health HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
        return b"".join(iter(lambda: connection.recv(65536), b""))


@pytest.mark.slow
def test_a_server_at_a_path(tmp_path):
    path = tmp_path / "lab.sock"
    folders = ["--processed", tmp_path / "processed", "--reports", tmp_path / "reports"]
    command = [sys.executable, "-m", "pipeline", "serve", "--unix-socket", path, "--read-only", *folders]
    with subprocess.Popen([*map(str, command)], stderr=subprocess.PIPE, text=True) as process:
        try:
            until = time.monotonic() + 60
            while True:
                assert process.poll() is None
                assert time.monotonic() < until
                try:
                    answer = asked(path)
                    break
                except OSError:
                    time.sleep(0.05)
            assert b" 200 " in answer.splitlines()[0]
            assert path.stat().st_mode & 0o777 == 0o600
            assert b" 403 " in asked(path, "evil.example").splitlines()[0]
            with pytest.raises(UsageError, match="another server"), listening(path):
                pass
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait()
    assert not path.exists()


def test_what_a_killed_server_left_is_replaced(tmp_path):
    path = tmp_path / "lab.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
    with listening(path):
        assert path.stat().st_mode & 0o777 == 0o600
    assert not path.exists()


def test_no_file_is_replaced(tmp_path):
    path = tmp_path / "lab.sock"
    path.write_text("mine")
    with pytest.raises(UsageError, match="a file lies there"), listening(path):
        pass
    assert path.read_text() == "mine"


def test_a_path_that_cannot_be(tmp_path):
    with pytest.raises(UsageError, match="Choose a shorter path"), listening(tmp_path / ("x" * 200)):
        pass

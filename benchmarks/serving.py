"""A server in a process of its own, as the benchmarks of the service ask it: on one core, they on the others."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path

import numpy as np

SERVER_CORE = {0}


class Server:
    """A running ``pipeline serve``; its workers are its children."""

    def __init__(self, folder: Path, *options: str) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self.url = f"http://127.0.0.1:{self.port}"
        folders = ["--processed", str(folder / "processed"), "--reports", str(folder / "reports")]
        began = time.perf_counter()
        self.process = subprocess.Popen(
            on_one_core([sys.executable, "-m", "pipeline", "serve", "--port", str(self.port), *folders, *options]),
            stderr=subprocess.DEVNULL,
        )
        while True:
            try:
                get(self.port, "/api/v1/health")
                break
            except OSError:
                if self.process.poll() is not None:
                    raise SystemExit("the server did not start") from None
                time.sleep(0.02)
        self.start_s = time.perf_counter() - began

    def kill(self) -> None:
        """End it as a power cut does."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def processor_ms(self) -> float:
        """Return its processor time [ms]; Linux alone tells it."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) * 1e3 / os.sysconf("SC_CLK_TCK")

    def peak_mib(self) -> float:
        """Return the most memory that it had [MiB], without its workers."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1024


@contextmanager
def serving(folder: Path, *options: str) -> Iterator[Server]:
    """Serve a folder while the block runs."""
    server = Server(folder, *options)
    try:
        yield server
    finally:
        server.process.terminate()
        server.process.wait()


def on_one_core(command: list[str]) -> list[str]:
    """Return a command that runs on the core of the server, where the system can tell it so."""
    if not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2:
        return command
    start = f"import os, sys; os.sched_setaffinity(0, {SERVER_CORE}); os.execv(sys.argv[1], sys.argv[1:])"
    return [sys.executable, "-c", start, *command]


def get(port: int, path: str) -> tuple[float, bytes]:
    """Return the time of a request [s] and its answer."""
    began = time.perf_counter()
    connection = HTTPConnection("127.0.0.1", port, timeout=120)
    connection.request("GET", path)
    response = connection.getresponse()
    content = response.read()
    connection.close()
    if response.status >= 400:
        raise SystemExit(f"{path}: {response.status} {content[:300]!r}")
    return time.perf_counter() - began, content


def read_together(port: int, paths: tuple[str, ...], readers: int, requests: int) -> np.ndarray:
    """Return the times [ms] of so many requests by readers at the same time."""
    with ThreadPoolExecutor(readers) as pool:
        return 1e3 * np.array(list(pool.map(lambda i: get(port, paths[i % len(paths)])[0], range(requests))))


def read_for(port: int, paths: tuple[str, ...], readers: int, seconds: float) -> tuple[int, int]:
    """Return how many requests were answered, and how many were not, to readers that ask without a pause."""
    until = time.monotonic() + seconds

    def ask(reader: int) -> tuple[int, int]:
        answered = failed = 0
        while time.monotonic() < until:
            try:
                get(port, paths[(reader + answered) % len(paths)])
                answered += 1
            except (OSError, SystemExit):
                failed += 1
        return answered, failed

    with ThreadPoolExecutor(readers) as pool:
        counts = np.array(list(pool.map(ask, range(readers))))
    answered, failed = counts.sum(axis=0).tolist()
    return answered, failed


def until(true: Callable[[], bool], wait_s: float = 1200.0) -> bool:
    """Wait for something; return whether it came."""
    end = time.monotonic() + wait_s
    while time.monotonic() < end:
        if true():
            return True
        time.sleep(0.2)
    return False

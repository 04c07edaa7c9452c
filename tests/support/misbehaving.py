"""Readers as a damaged file may make them; called in worker processes by the tests of isolation."""

import ctypes
import os
import signal

from pipeline.base.errors import LogError


def hang(name: str, data: bytes) -> None:
    while True:
        pass


def crash(name: str, data: bytes) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def keep(name: str, data: bytes) -> None:
    """As a library does that neither comes to an end nor lets the interpreter go."""
    with open(data, "w") as stream:
        stream.write(str(os.getpid()))
    ctypes.PyDLL(None).sleep(3600)


def starve(name: str, data: bytes) -> int:
    return len(bytes(6 << 30))


def shout(name: str, data: bytes, more: str) -> str:
    print("noise of a library")
    os.write(1, b"noise of a library in C")
    return data.decode() + more


def refuse(name: str, data: bytes) -> None:
    raise LogError("wrong in row 7", 7)

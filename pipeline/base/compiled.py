"""Loops that numba compiles: when they are first called, kept on disk for the next process.

A command that calls none of them does not import numba. With ``NUMBA_DISABLE_JIT=1`` the Python functions run
themselves, slowly and with the same numbers, as a debugger needs them. Machine code is kept in the folder that
``NUMBA_CACHE_DIR`` names, else in the user's folder for caches; where that cannot be written it is made in each process
again. Several processes that index the same folder would damage it (numba's issue 4807), so that one compiles or loads
at a time.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from pipeline.base.disk import read_kept, write_kept

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

WAIT_S = 60.0
"""How long to wait for another process that compiles [s]: behind it, compile without a folder."""

NOTICED_S = 1.0
"""How long a user waits for machine code without a word [s]."""

_ONE_THREAD = threading.Lock()
"""Held while numba's folder is set to that of this package."""

_loaders: dict[str, list[Callable[[], object]]] = {}
"""What makes or loads the machine code of each compiled function, by module."""

_parts: list[tuple[Callable[..., Any], bool]] = []
"""Functions that compiled ones call and numba does not know yet, and whether they are inlined."""

_listeners: list[tuple[Callable[[str], None], float]] = []
"""Who hears that something is compiled, the first time that it takes longer than some seconds."""


def compiled(*signatures: str, allocates: bool = False) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that compiles a function to some signatures, such as ``"f8(f8[::1])"``, when it is called.

    The function itself stays as ``__wrapped__``. It takes arrays of the signatures' types only, and calls no other
    compiled one; it may call those that are `inlined`. Divisions by zero give infinity or NaN, as those of numpy.
    One that returns nothing (one signature, ``"void(...)"``) is loaded without numba (`pipeline.base.machine_code`),
    unless it ``allocates`` arrays.

    Examples
    --------
    >>> @compiled("f8(f8[::1])")
    ... def largest(values):
    ...     result = values[0]
    ...     for value in values:
    ...         result = max(result, value)
    ...     return result
    >>> import numpy as np
    >>> largest(np.array([1.0, 3.0, 2.0]))
    3.0
    """

    def decorated(function: Callable[P, R]) -> Callable[P, R]:
        @cache
        def machine_code() -> Callable[P, R]:
            return _machine_code(function, signatures, allocates)

        _loaders.setdefault(function.__module__, []).append(machine_code)

        @wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            return machine_code()(*args, **kwargs)

        return called

    return decorated


def inlined(function: F) -> F:
    """Let the compiled functions of a module call a function of the same module; it stays plain Python elsewhere.

    Numba takes machine code for old when the file of the compiled function changes, and looks at no other file: what a
    compiled function calls is in its own module, as are the constants that both use.
    """
    _parts.append((function, True))
    return function


def part(function: F) -> F:
    """Do the same for a long function that is called a few times: it stays a function, which takes less to compile."""
    _parts.append((function, False))
    return function


def load_compiled(*modules: str) -> None:
    """Load the machine code of all compiled functions of some modules, or packages, that are imported; all by default.

    A pool of processes begins with it: one process compiles what is missing, and the workers load it.
    """
    for module, loaders in list(_loaders.items()):
        if not modules or any(f"{module}.".startswith(f"{name}.") for name in modules):
            for load in loaders:
                load()


def on_compiling(listener: Callable[[str], None] | None, after_s: float = NOTICED_S) -> None:
    """Call a function with a message, once, when something takes longer to compile; by None nothing is called."""
    _listeners[:] = [] if listener is None else [(listener, after_s)]


@contextmanager
def _noticed() -> Iterator[None]:
    """Say that something is compiled if the block takes long."""
    if not _listeners:
        yield
        return
    listener, after_s = _listeners[0]

    def say() -> None:
        _listeners.clear()
        listener("compiling, once")

    timer = threading.Timer(after_s, say)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _machine_code(function: Callable[P, R], signatures: tuple[str, ...], allocates: bool) -> Callable[P, R]:
    """Return a function as machine code, from disk where another process left it there."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        import numpy

        plain: Callable[P, R] = numpy.errstate(all="ignore")(function)
        return plain
    with _ONE_THREAD, _noticed():
        if signatures[0].startswith("void(") and not allocates:
            return _kept_object(function, signatures[0])
        import numba

        options: dict[str, Any] = {"signature_or_function": list(signatures), "error_model": "numpy"}
        config: Any = numba.config
        _register_inlined()
        try:
            folder = cache_folder()
            with _one_process(folder), _numba_folder(config, folder):
                kept: Callable[P, R] = numba.njit(cache=True, **options)(function)
                return kept
        except Exception:  # a full disk, a file that is no machine code, a folder of another user: all numba lets pass
            made: Callable[P, R] = numba.njit(**options)(function)
            return made


def _register_inlined() -> None:
    """Let numba know the functions that compiled ones may call."""
    from numba.extending import register_jitable

    while _parts:
        function, into_caller = _parts.pop()
        register_jitable(forceinline=into_caller)(function)


def _kept_object(function: Callable[..., Any], signature: str) -> Callable[..., Any]:
    """Return a function without a result as machine code, by an object file that is kept under its name."""
    from pipeline.base import machine_code

    name, key = machine_code.object_name(function), machine_code.object_key(function, signature).encode()

    def kept(folder: Path) -> bytes | None:
        known, _, code = (read_kept(folder, name, ".o") or b"").partition(b"\n")
        return code if known == key else None

    def made() -> bytes:
        _register_inlined()
        return machine_code.compiled_object(function, signature)

    try:
        folder = cache_folder()
        code = kept(folder)
        if code is None:
            with _one_process(folder):
                code = kept(folder) or made()
                write_kept(folder, name, ".o", key + b"\n" + code)
    except (OSError, RuntimeError):  # a full disk, a folder of another user, none at all
        code = made()
    return machine_code.loaded_object(code, signature)


def cache_folder() -> Path:
    """Return the folder that machine code is kept in, and make it.

    Raises
    ------
    OSError
        If it cannot be made.
    RuntimeError
        If the user has no home.
    """
    own = os.environ.get("NUMBA_CACHE_DIR")
    if own:
        folder = Path(own)
    else:
        variable = "LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME"
        usual = Path("Library", "Caches") if sys.platform == "darwin" else Path(".cache")
        folder = Path(os.environ.get(variable) or Path.home() / usual, "haptic-pipeline")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@contextmanager
def _one_process(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder; the lock goes with its holder."""
    from filelock import lock_descriptor

    file = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        until = time.monotonic() + WAIT_S
        while not lock_descriptor(file, blocking=False):
            if time.monotonic() > until:
                raise TimeoutError(f"{folder}: another process compiles")
            time.sleep(0.01)
        yield
    finally:
        os.close(file)


@contextmanager
def _numba_folder(config: Any, folder: Path) -> Iterator[None]:
    """Let numba look for machine code in a folder; what others compile in this process stays in theirs."""
    former, config.CACHE_DIR = config.CACHE_DIR, os.fspath(folder)
    try:
        yield
    finally:
        config.CACHE_DIR = former

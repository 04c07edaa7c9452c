"""Loops that numba compiles at their first call, and that are stored on disk for later processes.

A command that calls no such loop does not import numba. With ``NUMBA_DISABLE_JIT=1``, plain Python functions are run,
so that a debugger can be used. They are slow, but return the same results. Machine code is stored in the folder
``NUMBA_CACHE_DIR``, by default in the cache folder of the user. If this folder is read-only, each process compiles in
memory. Otherwise, only one process compiles at a time, so that several processes do not compile the same function.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from pipeline.base.disk import read_result, write_result

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

WAIT_S = 60.0
"""Longest wait for another process that compiles [s]. After this time, the function is compiled in memory."""

KEPT_DAYS = 90.0
"""Age at which machine code is removed [days], so that former versions do not fill the disk."""

NOTICED_S = 1.0
"""Time after which the user is informed of a compilation [s]."""

_ONE_THREAD = threading.Lock()
"""Lock on the compiler and on the engine that loads machine code."""

_loaders: dict[str, list[Callable[[], object]]] = {}
"""Loaders of the machine code of compiled functions, with module names as keys."""

_parts: list[tuple[Callable[..., Any], bool]] = []
"""Functions to register with numba before their callers are compiled, and whether they are inlined."""

_listeners: list[tuple[Callable[[str], None], float]] = []
"""Callback for the first compilation that takes longer than the given time [s]. The list is empty if there is no
callback."""


def compiled(signature: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that compiles a function for a signature such as ``"f8(f8[::1])"`` at its first call.

    The Python function remains available as ``__wrapped__``. A compiled function accepts only arrays of the types in
    its signature. It cannot call other compiled functions, but only functions marked with `inlined` or `part`.
    Divisions by zero return infinity or NaN, as in numpy. Stored machine code is loaded without numba
    (`pipeline.base.machine_code`).

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
            return _machine_code(function, signature)

        _loaders.setdefault(function.__module__, []).append(machine_code)

        @wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            return machine_code()(*args, **kwargs)

        return called

    return decorated


def inlined(function: F) -> F:
    """Inline this function into compiled functions of the same module. For all other callers, it is plain Python.

    Stored machine code is replaced only if the file of the compiled function changes. Functions that it calls,
    and constants that both use, must therefore be in the same module.
    """
    _parts.append((function, True))
    return function


def part(function: F) -> F:
    """Let compiled functions of the same module call this function without inlining, which compiles faster."""
    _parts.append((function, False))
    return function


def load_compiled(*modules: str) -> None:
    """Load or compile all compiled functions of the given modules or packages that have been imported.

    By default, all functions are loaded. This function is called before a pool starts, so that one process compiles the
    functions and the workers load them.
    """
    for module, loaders in list(_loaders.items()):
        if not modules or any(f"{module}.".startswith(f"{name}.") for name in modules):
            for load in loaders:
                load()


def on_compiling(listener: Callable[[str], None] | None, after_s: float = NOTICED_S) -> None:
    """Call a function once with a message if a compilation takes longer than ``after_s``. None removes the function."""
    _listeners[:] = [] if listener is None else [(listener, after_s)]


@contextmanager
def _noticed() -> Iterator[None]:
    """Call the listener if the block takes a long time."""
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


def _machine_code(function: Callable[P, R], signature: str) -> Callable[P, R]:
    """Return a function as machine code, which is loaded from disk if it has been compiled before."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        import numpy

        plain: Callable[P, R] = numpy.errstate(all="ignore")(function)
        return plain
    from pipeline.base import machine_code

    def made() -> bytes:
        _register_inlined()
        return machine_code.compiled_object(function, signature)

    with _ONE_THREAD, _noticed():
        try:
            name, folder = machine_code.object_name(function, signature), cache_folder()
            code = read_result(folder, name, ".o")
            if code is None:
                with _one_process(folder):
                    code = read_result(folder, name, ".o")
                    if code is None:
                        code = made()
                        write_result(folder, name, ".o", code)
                        _remove_unused(folder)
        except (OSError, RuntimeError):  # the disk is full, or there is no usable folder
            code = made()
        return machine_code.loaded_object(code, signature)


def _register_inlined() -> None:
    """Register the functions that compiled functions may call with numba."""
    from numba.extending import register_jitable

    while _parts:
        function, into_caller = _parts.pop()
        register_jitable(forceinline=into_caller)(function)


def _remove_unused(folder: Path) -> None:
    """Remove object files that are older than `KEPT_DAYS`. A version that is still in use compiles its functions
    again."""
    oldest = time.time() - 86400 * KEPT_DAYS
    for file in folder.glob("*.o"):
        with suppress(OSError):
            if file.stat().st_mtime < oldest:
                file.unlink()


def cache_folder() -> Path:
    """Return the folder for machine code, and create it if necessary.

    Raises
    ------
    OSError
        If the folder cannot be created.
    RuntimeError
        If the user has no home directory.
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
    """Lock a folder against other processes. The lock ends with the process."""
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

"""Machine code of functions without a return value, stored as object files that llvmlite loads.

Importing numba and loading its cache takes half a second, whereas loading an object file takes a few milliseconds.
Numba compiles each function only once. The function allocates no memory and counts no references, so it runs without
numba. Its arguments are numbers and the addresses, shapes and strides of arrays.
"""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import numpy as np

from pipeline.base.provenance import digest, sha256

Function = Callable[..., None]

HASH_DIGITS = 32
"""Number of hexadecimal digits of the hash in the name of an object file. Equal hashes are practically impossible."""


@dataclass(frozen=True)
class Number:
    """Number type of a signature, such as ``f8``. Indexing it gives an array type, such as ``f8[:, ::1]``."""

    dtype: str
    passed: Any

    def __getitem__(self, axes: object) -> Array:
        return Array(np.dtype(self.dtype), len(axes) if isinstance(axes, tuple) else 1)

    @property
    def types(self) -> list[Any]:
        """C types of the argument."""
        return [self.passed]

    def append(self, value: Any, values: list[Any]) -> None:
        """Append the number to the C arguments."""
        values.append(value)


@dataclass(frozen=True)
class Array:
    """Type of C-contiguous arrays in a signature."""

    dtype: np.dtype[Any]
    axes: int

    @property
    def types(self) -> list[Any]:
        """C types of the arguments, which are two object pointers of numba, size, item size, address, shape and
        strides."""
        return [ctypes.c_int64] * (5 + 2 * self.axes)

    def append(self, value: np.ndarray, values: list[Any]) -> None:
        """Append the description of an array to the C arguments."""
        shape = value.shape
        if not (value.dtype == self.dtype and len(shape) == self.axes and value.flags.c_contiguous):
            raise TypeError(
                f"expected a C-contiguous array of {self.dtype} with {self.axes} axes, found an array of "
                f"{value.dtype} with {value.ndim}."
            )
        try:
            # `numpy.ndarray.ctypes` would take three times as long
            address = _address_of(_first_byte(cast(Any, value)))
        except (TypeError, ValueError):  # read-only, or empty
            address = value.ctypes.data
        values += (0, 0, value.size, value.itemsize, address, *shape, *value.strides)


_address_of, _first_byte = ctypes.addressof, ctypes.c_char.from_buffer


@dataclass(frozen=True)
class Several:
    """Tuple type of a signature."""

    parts: tuple[Any, ...]

    @property
    def types(self) -> list[Any]:
        """C types of all parts, in order."""
        return [each for part in self.parts for each in part.types]

    def append(self, value: tuple[Any, ...], values: list[Any]) -> None:
        """Append all parts to the C arguments."""
        for part, one in zip(self.parts, value, strict=True):
            part.append(one, values)


_NAMES = {
    "void": lambda *arguments: Several(arguments),
    "Tuple": lambda parts: Several(tuple(parts)),
    "UniTuple": lambda part, count: Several((part,) * count),
    "b1": Number("?", ctypes.c_uint8),
    "i8": Number("i8", ctypes.c_int64),
    "f8": Number("f8", ctypes.c_double),
    "c16": Number("c16", None),
}
"""Names that may occur in a signature."""


def arguments_of(signature: str) -> Several:
    """Parse the arguments of a signature such as ``"void(f8[::1], Tuple((i8, f8[:, ::1])))"``.

    Examples
    --------
    >>> len(arguments_of("void(f8[::1], Tuple((i8, f8[:, ::1])))").types)
    17
    """
    arguments: Several = eval(signature, {"__builtins__": {}}, _NAMES)  # a constant string of this package
    return arguments


def object_name(function: Function, signature: str) -> str:
    """Return the name of the object file of a function. It ends with a hash of all inputs of the machine code.

    Several versions of the package, and several processors that share a home directory, thus have separate files.
    """
    import llvmlite.binding as llvm

    file = Path(inspect.getsourcefile(function) or "")
    makers = [_folder(name) / "_version.py" for name in ("numba", "llvmlite")]
    sources = [sha256(each.read_bytes()) for each in (file, Path(__file__), *makers)]
    machine = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
    name = f"{function.__module__}.{function.__qualname__}"
    return f"{name}-{digest([name, signature, *sources, *machine])[:HASH_DIGITS]}"


def _folder(package: str) -> Path:
    """Return the folder of a package without importing it. Reading its version would take ten times as long."""
    spec = find_spec(package)
    return Path(spec.origin if spec and spec.origin else "").parent


def compiled_object(function: Function, signature: str) -> bytes:
    """Compile a function with numba. Return the object file, preceded by a line with its symbol name."""
    import numba

    options: dict[str, Any] = {"_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiled: Any = numba.njit(signature, error_model="numpy", **options)(function)
    (overload,) = compiled.overloads.values()
    _, _, (code, _) = overload.library.serialize_using_object_code()
    symbol: str = overload.fndesc.llvm_func_name
    return symbol.encode() + b"\n" + bytes(code)


def loaded_object(data: bytes, signature: str) -> Function:
    """Load the output of `compiled_object` and return a function that calls it."""
    import llvmlite.binding as llvm

    symbol, _, code = data.partition(b"\n")
    engine = _engine()
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    arguments = arguments_of(signature)
    types = [ctypes.c_void_p, ctypes.c_void_p, *arguments.types]
    code_of = ctypes.CFUNCTYPE(ctypes.c_int32, *types)(engine.get_function_address(symbol.decode()))

    def call(*given: Any) -> None:
        result, error = ctypes.c_void_p(), ctypes.c_void_p()
        values: list[Any] = [ctypes.byref(result), ctypes.byref(error)]
        arguments.append(given, values)
        status = code_of(*values)
        if status:
            raise ArithmeticError(f"{symbol.decode()}: machine code ended with status {status}.")

    return call


@cache
def _engine() -> Any:
    """Return the execution engine for loaded machine code. It exists until the process ends."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)

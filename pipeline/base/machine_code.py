"""Machine code of functions, stored as object files that llvmlite loads.

Importing numba and loading its cache takes a second, whereas loading an object file takes a few milliseconds. Numba
compiles each function only once. Arguments and results are numbers and the addresses, shapes and strides of arrays.
Arrays that a function allocates are blocks of memory with a count of references. Numba's own code changes the counts,
and `ALLOCATOR` allocates and frees the blocks.
"""

from __future__ import annotations

import ctypes
import inspect
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import numpy as np

from pipeline.base.constants import Constants
from pipeline.base.provenance import digest, sha256

Function = Callable[..., Any]

HASH_DIGITS = 32
"""Number of hexadecimal digits of the hash in the name of an object file. Equal hashes are practically impossible."""

ALLOCATOR = """
declare ptr @malloc(i64)
declare void @free(ptr)

define ptr @NRT_MemInfo_alloc_aligned(i64 %size, i32 %align) {
    %wide = zext i32 %align to i64
    %room = add i64 %wide, 64
    %total = add i64 %size, %room
    %block = call ptr @malloc(i64 %total)
    %failed = icmp eq ptr %block, null
    br i1 %failed, label %end, label %fill
fill:
    %address = ptrtoint ptr %block to i64
    %behind = add i64 %address, %room
    %over = urem i64 %behind, %wide
    %data = sub i64 %behind, %over
    store i64 1, ptr %block
    %place = getelementptr i8, ptr %block, i64 24
    store i64 %data, ptr %place
    br label %end
end:
    ret ptr %block
}

define void @NRT_MemInfo_call_dtor(ptr %block) {
    call void @free(ptr %block)
    ret void
}

define ptr @NRT_Allocate(i64 %size) {
    %block = call ptr @malloc(i64 %size)
    ret ptr %block
}

define void @NRT_Free(ptr %block) {
    call void @free(ptr %block)
    ret void
}

define void @release(ptr %block) {
    %count = atomicrmw sub ptr %block, i64 1 monotonic
    %last = icmp eq i64 %count, 1
    br i1 %last, label %destroy, label %end
destroy:
    call void @free(ptr %block)
    br label %end
end:
    ret void
}
"""
"""LLVM code of numba's allocator. A block begins with the count of references; its byte 24 is the address of the data.

Numba's own allocator is part of its library, which would have to be imported.
"""


class Type:
    """Type of an argument or a result."""

    def __call__(self, *arguments: Any) -> Signature:
        """Return the signature of a function with this result."""
        return Signature(self, Several(arguments))


@dataclass(frozen=True)
class Number(Type):
    """Number type of a signature, such as ``f8``. Indexing it gives an array type, such as ``f8[:, ::1]``."""

    dtype: str
    passed: str

    def __getitem__(self, axes: object) -> Array:
        return Array(np.dtype(self.dtype), len(axes) if isinstance(axes, tuple) else 1)

    @property
    def types(self) -> list[str]:
        """LLVM type of the argument."""
        return [self.passed]

    def append(self, value: Any, values: list[Any]) -> None:
        """Append the number to the arguments."""
        values.append(value)

    def read(self, words: list[int]) -> Any:
        """Return the number that the first words of a result contain, and remove them."""
        return np.int64(words.pop(0)).view(self.dtype).item()


@dataclass(frozen=True)
class Array(Type):
    """Type of C-contiguous arrays in a signature."""

    dtype: np.dtype[Any]
    axes: int

    @property
    def types(self) -> list[str]:
        """LLVM types of the arguments, which are two object pointers of numba, size, item size, address, shape and
        strides."""
        return ["ptr", "ptr", "i64", "i64", "ptr"] + ["i64"] * (2 * self.axes)

    def append(self, value: np.ndarray, values: list[Any]) -> None:
        """Append the description of an array to the arguments."""
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

    def read(self, words: list[int]) -> np.ndarray:
        """Return the array that the first words of a result describe, and remove them."""
        block, _, size, _, address, *shape = words[: 5 + self.axes]
        del words[: 5 + 2 * self.axes]
        if not size:
            result = np.empty(shape, self.dtype)
            _release(block)
            return result
        return np.asarray(Block(block, address, tuple(shape), self.dtype.str))


_address_of, _first_byte = ctypes.addressof, ctypes.c_char.from_buffer


class Block:
    """Memory that machine code has allocated for an array. It is freed with the last array that refers to it."""

    def __init__(self, block: int, address: int, shape: tuple[int, ...], dtype: str) -> None:
        self._block = block
        self.__array_interface__ = {"data": (address, False), "shape": shape, "typestr": dtype, "version": 3}

    def __del__(self) -> None:
        _release(self._block)


def _release(block: int) -> None:
    """Decrease the number of references to a block. The blocks of arguments, with address 0, are not counted."""
    if block:
        _engine()[1](block)


@dataclass(frozen=True)
class Several(Type):
    """Tuple type of a signature."""

    parts: tuple[Any, ...]

    @property
    def types(self) -> list[str]:
        """LLVM types of all parts, in order."""
        return [each for part in self.parts for each in part.types]

    def append(self, value: tuple[Any, ...], values: list[Any]) -> None:
        """Append all parts to the arguments."""
        if isinstance(value, Constants):
            if value.words is None:
                words = list[Any]()
                self.append(tuple(value), words)
                value.words = words  # complete, for other threads
            values += value.words
            return
        for part, one in zip(self.parts, value, strict=True):
            if isinstance(part, Number):  # most parts are numbers, and a call would take longer than all else
                values.append(one)
            else:
                part.append(one, values)

    def read(self, words: list[int]) -> Any:
        """Return the parts that the first words of a result contain, and remove them. Nothing is returned for void."""
        return tuple(part.read(words) for part in self.parts) if self.parts else None


@dataclass(frozen=True)
class Signature:
    """Types of the result and of the arguments of a function."""

    result: Any
    arguments: Several


_NAMES = {
    "void": Several(()),
    "Tuple": lambda parts: Several(tuple(parts)),
    "UniTuple": lambda part, count: Several((part,) * count),
    "b1": Number("?", "i8"),
    "i8": Number("i8", "i64"),
    "f8": Number("f8", "double"),
    "c16": Number("c16", ""),
}
"""Names that may occur in a signature."""


def signature_of(text: str) -> Signature:
    """Parse a signature such as ``"void(f8[::1], Tuple((i8, f8[:, ::1])))"``.

    Examples
    --------
    >>> len(signature_of("f8(f8[::1], Tuple((i8, f8[:, ::1])))").arguments.types)
    17
    """
    signature: Signature = eval(text, {"__builtins__": {}}, _NAMES)  # a constant string of this package
    return signature


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
    """Compile a function with numba. Return the object file, preceded by a line with its symbol name.

    Raises
    ------
    TypeError
        If the function calls functions of numba's library, which `loaded_object` cannot find.
    """
    import numba

    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiled: Any = numba.njit(signature, error_model="numpy", **options)(function)
    (overload,) = compiled.overloads.values()
    _, _, (code, _) = overload.library.serialize_using_object_code()
    called = re.findall(r"^declare .*@((?:numba|NRT)_\w+)\(", overload.library.get_llvm_str(), re.MULTILINE)
    if missing := [name for name in called if f"@{name}(" not in ALLOCATOR]:
        raise TypeError(
            f"{function.__module__}.{function.__qualname__}: calls {', '.join(missing)} of numba's library."
        )
    symbol: str = overload.fndesc.llvm_func_name
    return symbol.encode() + b"\n" + bytes(code)


def loaded_object(data: bytes, signature: str) -> Function:
    """Load the output of `compiled_object` and return a function that calls it."""
    import llvmlite.binding as llvm

    symbol, _, code = data.partition(b"\n")
    engine, _ = _engine()
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    given_types = signature_of(signature)
    arguments, result = given_types.arguments, given_types.result
    engine.add_module(llvm.parse_assembly(_entry(symbol.decode(), arguments.types)))
    engine.finalize_object()
    code_of = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_char_p)(
        engine.get_function_address(f"entry.{symbol.decode()}")
    )
    pack = struct.Struct("".join("d" if kind == "double" else "q" for kind in arguments.types)).pack
    returned = ctypes.c_int64 * max(len(result.types), 1)

    def call(*given: Any) -> Any:
        words, values = returned(), list[Any]()
        arguments.append(given, values)
        status = code_of(ctypes.addressof(words), pack(*values))
        if status:
            raise ArithmeticError(f"{symbol.decode()}: machine code ended with status {status}.")
        return result.read(list(words))

    return call


def _entry(symbol: str, types: Sequence[str]) -> str:
    """Return LLVM code that calls a function with arguments from memory, each of which has 8 bytes.

    Python would convert up to a hundred separate arguments in as much time as a trial takes.
    """
    loaded = [
        f"%p{i} = getelementptr i64, ptr %words, i64 {i}\n%a{i} = load {kind}, ptr %p{i}"
        for i, kind in enumerate(types)
    ]
    passed = ", ".join(["ptr %result", "ptr %error", *(f"{kind} %a{i}" for i, kind in enumerate(types))])
    kinds = ", ".join(["ptr", "ptr", *types])
    return "\n".join(
        [
            f'declare i32 @"{symbol}"({kinds})',
            f'define i32 @"entry.{symbol}"(ptr %result, ptr %words) {{',
            "%error = alloca ptr",
            *loaded,
            f'%status = call i32 @"{symbol}"({passed})',
            "ret i32 %status",
            "}",
        ]
    )


@cache
def _engine() -> tuple[Any, Callable[[int], None]]:
    """Return the execution engine for loaded machine code, and its function that releases a block of memory.

    Both exist until the process ends.
    """
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(ALLOCATOR), machine)
    engine.finalize_object()
    return engine, ctypes.CFUNCTYPE(None, ctypes.c_void_p)(engine.get_function_address("release"))

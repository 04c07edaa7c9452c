"""Takes MATLAB version 5 files (``save -v6``, ``-v7``) apart: numbers, text, structs and cells by dotted path.

The layout is that of MathWorks' "MAT-File Format" (level 5). It is read here and not by `scipy.io`, which loses the
names of objects beside the data, fails to list files that hold one, and asks for as much memory as a damaged file
claims.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.errors import LogError
from pipeline.readers.formats.arrays import StoredArray
from pipeline.readers.frame import Scalar
from pipeline.readers.safety import allowed_bytes, unpack

HEADER = 128
"""Bytes above the first element."""

MOST_ELEMENTS = 100_000
"""Arrays in one file, fields of structs counted one by one: a damaged file may claim millions of empty ones."""

DEEPEST = 32
"""Structs inside structs."""

_COMPRESSED, _MATRIX = 15, 14
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "latin-1", 2: "latin-1", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_NUMBERS = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_COMPLEX = 0x0800

_EXPORTS = {
    "timeseries": "s = struct('time', ts.Time, 'data', ts.Data)",
    "Simulink.SimulationData.Dataset": "ts = logsout{1}.Values; s = struct('time', ts.Time, 'data', ts.Data)",
    "Simulink.SimulationData.Signal": "ts = signal.Values; s = struct('time', ts.Time, 'data', ts.Data)",
    "Simulink.SimulationOutput": "ts = out.logsout{1}.Values; s = struct('time', ts.Time, 'data', ts.Data)",
    "table": "s = table2struct(T, 'ToScalar', true)",
    "timetable": "s = table2struct(timetable2table(T), 'ToScalar', true)",
    "string": "s = char(x)",
    "datetime": "s = seconds(x - x(1))",
    "duration": "s = seconds(x)",
}
"""How MATLAB makes plain arrays of what it saves in a form of its own, by class."""


def object_advice(kind: str) -> str:
    """Return why an object of a class is not read, and how it is exported."""
    export = _EXPORTS.get(kind, "s = struct('time', <its times>, 'data', <its values>)")
    each = " for each of its elements" if kind.endswith(("Dataset", "Output")) else ""
    return (
        f"is a MATLAB object of class {kind[:80]}, whose form only MATLAB knows. Export it there{each}: "
        f"{export}; save('log.mat', 's', '-v7')."
    )


@dataclass
class MatContents:
    """What a MAT file holds.

    Parameters
    ----------
    arrays : dict of str to StoredArray
        Numbers and texts by path: ``name``, ``struct.field``, ``structs[1].field``, ``cells[2]``.
    attributes : dict of str to str, float or int
        Single numbers and texts.
    refused : dict of str to str
        What cannot be read, and why.
    """

    arrays: dict[str, StoredArray] = field(default_factory=dict)
    attributes: dict[str, Scalar] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)


def parse_mat5(name: str, data: bytes) -> MatContents:
    """Take a MATLAB version 5 file apart.

    Parameters
    ----------
    name : str
        The file.
    data : bytes

    Returns
    -------
    MatContents

    Raises
    ------
    LogError
        If the file unpacks to more than `allowed_bytes`, or claims more parts than fit into it.
    ValueError, struct.error, zlib.error, EOFError
        On damage; call it inside `safety.reading`.
    """
    parser = _Parser(name, data)
    parser.read_file()
    return parser.contents


class _Parser:
    def __init__(self, name: str, data: bytes) -> None:
        self.name, self.data = name, data
        self.contents = MatContents()
        self.order = {b"IM": "<", b"MI": ">"}[data[126:128]]
        self.left = allowed_bytes(len(data))
        self.elements = 0

    def read_file(self) -> None:
        (workspace,) = struct.unpack(self.order + "Q", self.data[116:124])
        at = HEADER
        view = memoryview(self.data)
        while at < len(view):
            start = at
            kind, body, at = self._element(view, at)
            if kind == _COMPRESSED:
                # a compressed element is not padded
                at = start + 8 + len(body)
                whole = unpack(self.name, "zlib", body, self.left, len(self.data))
                self.left -= len(whole)
                kind, body, _ = self._element(memoryview(whole), 0)
            # the function workspace holds the insides of objects
            if kind == _MATRIX and start != workspace:
                self._matrix(body, "", 0)

    def _element(self, view: memoryview, at: int) -> tuple[int, memoryview, int]:
        """Return type and bytes of an element, and where the next one starts."""
        kind, size = struct.unpack_from(self.order + "II", view, at)
        if kind >> 16:
            size, kind = kind >> 16, kind & 0xFFFF
            if size > 4:
                raise ValueError(f"a small element claims {size} bytes at byte {at}")
            return kind, view[at + 4 : at + 4 + size], at + 8
        end = at + 8 + size
        if end > len(view):
            raise ValueError(f"an element claims {size} bytes at byte {at}, but {len(view) - at - 8} follow")
        return kind, view[at + 8 : end], at + 8 + size + -size % 8

    def _matrix(self, body: memoryview, path: str, depth: int) -> None:
        """Read one array into the contents, with all arrays inside it."""
        self.elements += 1
        if self.elements > MOST_ELEMENTS or depth > DEEPEST:
            raise LogError(
                f"{self.name}: more than {MOST_ELEMENTS} arrays, or structs more than {DEEPEST} deep; expected "
                "recorded signals. Save the signals as plain arrays.",
                code="too-deep",
            )
        if not body:
            self._add(path, np.empty(0))
            return
        _, flags, at = self._element(body, 0)
        (word,) = struct.unpack_from(self.order + "I", flags)
        kind = word & 0xFF
        if kind == _OPAQUE:
            own, at = self._text(body, at)
            _, at = self._text(body, at)
            class_name, at = self._text(body, at)
            self._refuse(path or own, object_advice(class_name))
            return
        _, dims, at = self._element(body, at)
        shape = tuple(np.frombuffer(dims, self.order + "i4").tolist())
        own, at = self._text(body, at)
        path = path or own
        if len(shape) < 2 or min(shape) < 0:
            raise ValueError(f"{path!r} has the dimensions {shape}")
        if kind in _NUMBERS:
            if word & _COMPLEX:
                self._refuse(path, "holds complex numbers. Save real and imaginary part: re = real(x); im = imag(x).")
            else:
                self._add(path, self._numbers(body, at, path, shape, _NUMBERS[kind]))
        elif kind == _CHAR:
            self._add(path, self._characters(body, at, shape))
        elif kind in (_CELL, _STRUCT, _OBJECT):
            self._container(body, at, path, shape, kind, depth)
        else:
            what = {_SPARSE: "a sparse matrix; save full(x)", _FUNCTION: "a function"}.get(kind, f"of class {kind}")
            self._refuse(path, f"is {what}; expected numbers.")

    def _numbers(self, body: memoryview, at: int, path: str, shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
        kind, values, _ = self._element(body, at)
        # whole numbers are stored in the smallest type that holds them
        flat = np.frombuffer(values, self.order + _DTYPES[kind])
        if len(flat) != prod(shape):
            raise ValueError(f"{path!r} has the dimensions {shape}, but {len(flat)} values")
        self._spend(flat.size * np.dtype(dtype).itemsize)
        return flat.astype(dtype).reshape(shape, order="F")

    def _characters(self, body: memoryview, at: int, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return the rows of a character array as texts."""
        if at >= len(body):
            return np.array([""])
        kind, values, _ = self._element(body, at)
        if kind in (3, 4):
            text = values.tobytes().decode("utf-16-le" if self.order == "<" else "utf-16-be", "replace")
        else:
            text = values.tobytes().decode(_TEXTS[kind], "replace")
        rows = shape[0]
        if rows <= 1:
            return np.array([text])
        self._spend(4 * len(text))
        return np.array([text[row::rows].rstrip() for row in range(min(rows, len(text)))])

    def _container(self, body: memoryview, at: int, path: str, shape: tuple[int, ...], kind: int, depth: int) -> None:
        if kind == _OBJECT:
            class_name, at = self._text(body, at)
            self._refuse(path, object_advice(class_name))
            return
        names = [""]
        if kind == _STRUCT:
            _, length, at = self._element(body, at)
            (width,) = struct.unpack_from(self.order + "i", length)
            _, text, at = self._element(body, at)
            raw = text.tobytes()
            if width <= 0:
                raise ValueError(f"{path!r} has field names of {width} bytes")
            names = ["." + raw[i : i + width].split(b"\0")[0].decode() for i in range(0, len(raw), width)]
        count = prod(shape)
        # each array takes 8 bytes at least, so a claim beyond that is false
        if count * len(names) * 8 > len(body):
            raise ValueError(f"{path!r} claims {shape} elements of {len(names)} fields in {len(body)} bytes")
        texts: list[str] = []
        for number in range(count):
            place = path if count == 1 and kind == _STRUCT else f"{path}[{number}]"
            for suffix in names:
                element, inner, at = self._element(body, at)
                if element != _MATRIX:
                    raise ValueError(f"{place}{suffix} is an element of type {element}, not an array")
                self._matrix(inner, place + suffix, depth + 1)
            if kind == _CELL and isinstance(text_cell := self.contents.attributes.get(place), str):
                texts.append(text_cell)
        if kind == _CELL and len(texts) == count > 1:
            self._text_column(path, texts)

    def _text_column(self, path: str, texts: list[str]) -> None:
        """Keep a cell array of texts as one column."""
        for number in range(len(texts)):
            del self.contents.arrays[f"{path}[{number}]"], self.contents.attributes[f"{path}[{number}]"]
        values = np.array(texts)
        self._spend(values.nbytes)
        self._add(path, values)

    def _add(self, path: str, values: NDArray[Any]) -> None:
        text = values.dtype.kind == "U"
        kind = "text" if text else "number" if values.dtype.kind == "f" else "integer"
        self.contents.arrays[path] = StoredArray(values.shape, kind, lambda: values)
        if values.size == 1:
            value = values.reshape(-1)[0]
            self.contents.attributes[path] = str(value) if text else value.item()

    def _refuse(self, path: str, reason: str) -> None:
        self.contents.refused[path or "(no name)"] = reason

    def _spend(self, count: int) -> None:
        self.left -= count
        if self.left < 0:
            raise LogError(
                f"{self.name}: the arrays take more than {allowed_bytes(len(self.data))} bytes in memory; expected the "
                "log of one step response. Save only the signals that are needed.",
                code="unpacks-too-large",
            )

    def _text(self, body: memoryview, at: int) -> tuple[str, int]:
        _, text, at = self._element(body, at)
        return text.tobytes().decode("utf-8", "replace"), at

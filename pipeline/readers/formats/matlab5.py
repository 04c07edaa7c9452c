"""MATLAB version 5 files (``save -v6``, ``-v7``), which scipy reads: numbers, text, structs and cells by dotted path.

Each variable is read by itself, so that one that scipy cannot read, such as an object, leaves the others.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np

from pipeline.base.errors import LogError
from pipeline.readers.formats.arrays import Contents, stored
from pipeline.readers.limits import DEEPEST, MOST_ELEMENTS

COMPLEX = "holds complex numbers. Save real and imaginary part: re = real(x); im = imag(x)."
SPARSE = "is a sparse matrix; save full(x)."

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
class MatContents(Contents):
    """What a MAT file holds, by paths as ``name``, ``struct.field``, ``structs[1].field``, ``cells[2]``."""

    name: str = ""
    elements: int = 0

    def count(self, depth: int) -> None:
        """Count an array.

        Raises
        ------
        LogError
            If there are more than a log has, or structs too deep.
        """
        self.elements += 1
        if self.elements > MOST_ELEMENTS or depth > DEEPEST:
            raise LogError(
                f"{self.name}: more than {MOST_ELEMENTS} arrays, or structs more than {DEEPEST} deep; expected "
                "recorded signals. Save the signals as plain arrays.",
                code="too-deep",
            )

    def join_texts(self, path: str, count: int) -> None:
        """Keep a cell array of texts as one column."""
        places = [f"{path}[{number}]" for number in range(count)]
        texts = [self.attributes.get(place) for place in places]
        if count > 1 and all(isinstance(text, str) for text in texts):
            for place in places:
                del self.arrays[place], self.attributes[place]
            self.keep(path, stored(np.array(texts)))


def collect_version_5(name: str, data: bytes) -> MatContents:
    """Return what a MATLAB version 5 file holds.

    Raises
    ------
    LogError
        If it claims more parts than a log has.
    Exception
        What scipy raises on damage; call it inside `safety.reading`.
    """
    from scipy.io.matlab import varmats_from_mat

    contents = MatContents(name=name)
    for _, variable in varmats_from_mat(BytesIO(data)):
        for path, value in _load(variable).items():
            if not path.startswith("__"):  # header, and the hidden variable with the insides of objects
                _add(contents, path, value, 0)
    return contents


def _load(variable: BytesIO) -> dict[str, Any]:
    from scipy.io import loadmat

    with warnings.catch_warnings():
        warnings.simplefilter("error", np.exceptions.ComplexWarning)
        try:
            # MATLAB stores whole numbers of type double in the smallest type that holds them
            values: dict[str, Any] = loadmat(variable, mat_dtype=True)
        except np.exceptions.ComplexWarning:  # scipy would drop the imaginary part
            values = loadmat(variable)
    return values


def _add(contents: MatContents, path: str, value: Any, depth: int) -> None:
    """Add a variable, a field of a struct or an element of a cell."""
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque

    contents.count(depth)
    if isinstance(value, MatlabOpaque):
        own, _, kind, _ = (part.decode("utf-8", "replace") if isinstance(part, bytes) else "" for part in value.flat[0])
        contents.refused[path if depth else own] = object_advice(kind)
    elif isinstance(value, MatlabObject):
        contents.refused[path] = object_advice(value.classname)
    elif isinstance(value, MatlabFunction):
        contents.refused[path] = "is a function; expected numbers."
    elif not isinstance(value, np.ndarray):
        contents.refused[path] = SPARSE if hasattr(value, "todense") else f"is of type {type(value)}; expected numbers."
    elif value.dtype.kind == "c":
        contents.refused[path] = COMPLEX
    elif value.dtype.names:
        for number, element in enumerate(value.reshape(-1, order="F")):
            place = path if value.size == 1 else f"{path}[{number}]"
            for key in value.dtype.names:
                _add(contents, f"{place}.{key}", element[key], depth + 1)
    elif value.dtype.kind == "O":
        for number, element in enumerate(value.reshape(-1, order="F")):
            _add(contents, f"{path}[{number}]", element, depth + 1)
        contents.join_texts(path, value.size)
    elif value.dtype.kind == "U":
        rows = [text if len(value) == 1 else text.rstrip() for text in value.reshape(-1)] or [""]
        contents.keep(path, stored(np.array(rows)))
    else:
        contents.keep(path, stored(value))

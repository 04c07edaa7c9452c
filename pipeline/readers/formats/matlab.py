"""Reader of MATLAB files.

Fields of structs have dotted paths. Elements of struct arrays and cells have an index in brackets.

A Simulink "Structure with time" is a struct: ``scope.time``, ``scope.signals[1].values[0]``. A timeseries has
``ts.Time`` [s] and ``ts.Data``. A table or timetable has its variables as ``T.x`` (and ``T.Time``). A Simulink dataset
has its signals as ``logsout.torque.Time`` and ``logsout.torque.Data``. scipy reads files of version 5 (``save``,
``-v6``, ``-v7``) without objects. mat-io reads version 7.3, and objects in both versions.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from pipeline.base.errors import refusal
from pipeline.profiles.profile_model import Profile
from pipeline.readers.file_columns import Array, FileColumns, library

if find_spec("matio"):  # imported here, so that the import does not count as reading time
    import_module("matio")

_SERIES = "s = struct('time', ts.Time, 'data', ts.Data)"
_EXPORTS = {
    "timeseries": _SERIES,
    "Simulink.SimulationData.Dataset": f"ts = logsout{{1}}.Values; {_SERIES}",
    "Simulink.SimulationOutput": f"ts = out.logsout{{1}}.Values; {_SERIES}",
    "table": "s = table2struct(T, 'ToScalar', true)",
    "timetable": "s = table2struct(timetable2table(T), 'ToScalar', true)",
}
"""MATLAB commands that convert objects of private formats to plain arrays, by class."""


def read(path: Path, settings: Profile, contents: FileColumns) -> None:
    """Add the variables. Unreadable variables are listed with the MATLAB command that converts them to plain arrays."""
    head = path.read_bytes()[:128]
    newer, objects = head[124:126] in (b"\x00\x02", b"\x02\x00"), head[116:124].strip(b" \0") != b""
    if not head.startswith(b"MATLAB") and head[126:128] not in (b"IM", b"MI"):
        cure = "A version 4 file must be saved again: save('log.mat', 't', 'x', '-v7'). Otherwise correct `format`."
        raise refusal("unsupported", contents.name, "is not a MATLAB file", "version 5 or 7.3", cure)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        variables = _by_matio(contents, path, newer) if newer or objects else dict(loadmat(path))
    for name, value in variables.items():
        # Internal data of objects have a name with # or __.
        if not name.startswith(("#", "__")):
            _add(contents, name, value)
    for name in contents.columns:
        # Simulink stores the properties of a signal next to its values.
        stem, _, rest = name.rpartition(".values")
        if stem and not rest.strip("[0123456789]") and (label := contents.attributes.get(f"{stem}.label")):
            contents.hints[name] = str(label)


def _by_matio(contents: FileColumns, path: Path, newer: bool) -> dict[str, object]:
    matio = library("matio", "mat")
    try:
        return dict(matio.load_from_mat(path))
    except Exception:  # an unreadable variable must not affect the others
        found: dict[str, object] = {}
        for name, kind in _classes(path, newer).items():
            try:
                found |= matio.load_from_mat(path, variable_names=name)
            except Exception as error:
                plain = kind in ("double", "single", "struct", "cell", "char", "logical") or "int" in kind
                contents.refused[name] = (
                    f"cannot be read ({error or type(error).__name__})." if plain else _advice(kind)
                )
        return found


def _classes(path: Path, newer: bool) -> dict[str, str]:
    """Return the class of each variable, keyed by name."""
    if not newer:
        return {name: kind for name, (_, kind) in library("matio", "mat").whosmat(path).items()}
    with library("h5py", "mat").File(path) as file:
        kinds = {name: item.attrs.get("MATLAB_class", b"") for name, item in file.items() if name[0] != "#"}
        return {name: kind.decode() if isinstance(kind, bytes) else str(kind) for name, kind in kinds.items()}


def _advice(kind: str) -> str:
    """Return a text with the reason why an object of a class is not read, and the command that exports the object."""
    export = _EXPORTS.get(kind, "s = struct('time', <its times>, 'data', <its values>)")
    each = " for each of its elements" if kind.endswith(("Dataset", "Output")) else ""
    text = f"is a MATLAB object of class {kind[:80]}, which only MATLAB can read. Export it in MATLAB{each}: {export}; "
    return text + "save('log.mat', 's', '-v7')."


def _add(contents: FileColumns, path: str, value: Any) -> None:
    """Add a variable, a field of a struct, an element of a cell or the properties of an object."""
    if hasattr(value, "properties"):
        _add_object(contents, path, value)
    elif hasattr(value, "columns"):  # the value is a table or timetable
        frame = value.reset_index() if value.index.name else value
        for name in frame.columns:
            contents.add(f"{path}.{name}", frame[name].to_numpy())
    elif type(value).__name__ == "MatlabOpaque":  # scipy returns this type
        own, _, kind, _ = (part.decode("utf-8", "replace") if isinstance(part, bytes) else "" for part in value.flat[0])
        contents.refused[own if path == "None" else path] = _advice(kind)
    elif hasattr(value, "classname"):
        contents.refused[path] = _advice(str(value.classname))
    elif not isinstance(value, np.ndarray):
        sparse = "is a sparse matrix; save full(x)."
        contents.refused[path] = sparse if hasattr(value, "todense") else f"is {type(value).__name__}, not an array."
    elif value.dtype.names:
        for number, element in enumerate(value.reshape(-1, order="F")):
            place = path if value.size == 1 else f"{path}[{number}]"
            for key in value.dtype.names:
                _add(contents, f"{place}.{key}", element[key])
    elif value.dtype.kind == "O" and not (texts := _texts(value)).size:
        for number, element in enumerate(value.reshape(-1, order="F")):
            _add(contents, f"{path}[{number}]", element)
    elif value.dtype.kind in "UTO":
        found = texts if value.dtype.kind == "O" else value.reshape(-1) if value.size else [""]
        contents.add(path, np.array([str(text).rstrip() if len(found) > 1 else str(text) for text in found]))
    else:
        contents.add(path, value)


def _texts(value: Array) -> Array:
    """Return a cell array of texts as one column. Return an empty array for other values."""
    cells = [cell for cell in value.flat if getattr(cell, "dtype", value.dtype).kind == "U" and cell.size <= 1]
    texts = [cell.item() if cell.size else "" for cell in cells]
    return np.array(texts if 1 < len(texts) == value.size else [])


def _add_object(contents: FileColumns, path: str, value: Any) -> None:
    """Add the times and values of all timeseries in an object. Mark an object without timeseries as unreadable."""
    before = len(contents.columns)
    _add_series(contents, path, value)
    if len(contents.columns) == before:
        contents.refused[path] = _advice(str(value.classname))


def _add_series(contents: FileColumns, path: str, value: Any) -> None:
    """Add the timeseries in an object, a cell or a struct under their names.

    A Simulink dataset is an object that stores a cell of elements. An element is a signal (an object or a struct) whose
    values are a timeseries, a struct of timeseries (a bus), or a struct with samples.
    """
    if isinstance(value, np.ndarray) and value.dtype.names:
        for number, element in enumerate(value.reshape(-1, order="F")):
            place = path if value.size == 1 else f"{path}[{number}]"
            _add_parts(contents, place, {key: element[key] for key in value.dtype.names})
    elif isinstance(value, np.ndarray) and value.dtype.kind == "O":
        for number, element in enumerate(value.reshape(-1, order="F")):
            name = _name_of(element)
            taken = not name or any(key.startswith(f"{path}.{name}.") for key in contents.columns)
            _add_series(contents, f"{path}[{number}]" if taken else f"{path}.{name}", element)
    elif isinstance(properties := getattr(value, "properties", None), dict):
        _add_parts(contents, path, properties)


_TRANSPARENT = ("Storage", "Elements", "Elements_", "Values")
"""Names of the internal levels of a Simulink dataset, which users do not see."""


def _add_parts(contents: FileColumns, path: str, parts: Mapping[str, Any]) -> None:
    """Add samples that properties or fields contain directly, or the timeseries inside them."""
    info = getattr(parts.get("TimeInfo"), "properties", {})
    times = [parts.get("Time_"), parts.get("Time"), info.get("Time_")]
    time = next(
        (np.ravel(each) for each in times if isinstance(each, np.ndarray) and each.dtype.kind in "fiu" and each.size),
        None,
    )
    if time is None and all(key in info for key in _REGULAR):
        time = _regular(*(float(np.ravel(info[key])[0]) for key in _REGULAR))
    if time is None and np.size(packed := parts.get("CompressedTime", ())) == len(_REGULAR):
        time = _regular(*map(float, np.ravel(packed)))
    data = parts.get("Data_", parts.get("Data"))
    if time is not None and isinstance(data, np.ndarray) and data.dtype.kind in "fiub":
        contents.add(f"{path}.Time", time, _text(info.get("Units")) or "seconds")
        contents.add(f"{path}.Data", data, _unit(parts))
        return
    for key, part in parts.items():
        _add_series(contents, path if key in _TRANSPARENT else f"{path}.{key}", part)


_REGULAR = ("Start_", "Increment_", "Length")
"""Properties that define equidistant sample times."""


def _regular(start: float, step: float, rows: float) -> Array:
    return np.asarray(start + step * np.arange(int(rows)))


def _unit(parts: Mapping[str, Any]) -> str:
    """Return the unit of the samples of a timeseries, or an empty text."""
    unit = getattr(parts.get("DataInfo"), "properties", {}).get("Units", parts.get("DataUnits"))
    return _text(getattr(unit, "properties", {}).get("Name", unit))


def _text(value: Any) -> str:
    """Return a MATLAB text as str, or an empty text for other values."""
    found = np.ravel(value)[0] if np.size(value) else ""
    return str(found) if isinstance(found, str) else ""


def _name_of(element: Any) -> str:
    """Return the name of an element of a dataset, or an empty text if no name is valid in a path."""
    named = (
        isinstance(element, np.ndarray) and element.dtype.names and "Name" in element.dtype.names and element.size == 1
    )
    parts = getattr(element, "properties", None)
    name = element.flat[0]["Name"] if named else parts.get("Name", "") if isinstance(parts, dict) else ""
    return _text(name).replace(".", "_")

"""Where a stored number comes from: hashes of inputs, parameters and code, and the package version."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from pipeline import __version__

PACKAGE_FOLDER = Path(__file__).parents[1]


def schema_folder() -> Path:
    """Return the folder with device, profile and schema files: in the package, or beside it in a source checkout."""
    installed = PACKAGE_FOLDER / "_schemas"
    return installed if installed.is_dir() else PACKAGE_FOLDER.parent / "schemas"


USER_FOLDER_VARIABLE = "PIPELINE_DEVICES"
"""Environment variable that names a folder with device files of the user's own."""


def user_device_folder() -> Path | None:
    """Return the folder with the user's own device files; None where none is named."""
    own = os.environ.get(USER_FOLDER_VARIABLE)
    return Path(own) if own else None


def sha256(data: bytes) -> str:
    """Return the SHA-256 of bytes as 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def digest(value: object) -> str:
    """Return a 16-digit hash of anything JSON can hold; equal values give equal hashes on every machine."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return sha256(text.encode())[:16]


def digest_all(parts: Iterable[str]) -> str:
    """Return a 16-digit hash of strings, in order."""
    joined = hashlib.sha256()
    for part in parts:
        joined.update(part.encode())
        joined.update(b"\0")
    return joined.hexdigest()[:16]


@cache
def code_digest(*modules: str, files: tuple[Path, ...] = ()) -> str:
    """Return a hash of the source of some modules of this package, of all that they import, and of other files.

    A stored result is reused only while the code that made it is the same.

    Parameters
    ----------
    *modules : str
        Full names, as in ``__name__`` and ``function.__module__``.
    files : tuple of Path, optional
        What the modules load besides code.

    Raises
    ------
    ModuleNotFoundError
        If a module is none of this package.
    """
    code = (sha256(_source(module)) for module in sorted(reachable(*modules)))
    return digest_all([*code, *(sha256(file.read_bytes()) for file in files)])


def reachable(*modules: str) -> frozenset[str]:
    """Return the names of some modules and of all modules of this package that run with them.

    What a module imports is read from its source, wherever the import stands; what it imports for types alone does not
    count. A module whose name is put together (an f-string, given to `import_module`) may be any in its folder.

    Raises
    ------
    ModuleNotFoundError
        If a module is none of this package.
    """
    found: set[str] = set()
    new = set(modules)
    while new:
        found |= new
        new = {name for module in new for name in _imported(module)} - found
    return frozenset(found)


_ROOT, _PACKAGE = os.path.split(PACKAGE_FOLDER)
_IMPORT = re.compile(rf"\n[ \t]*(?:from ({_PACKAGE}[\w.]*) )?import (\([^)]*\)|.*)")
_NO_NAME = re.compile(r"#.*|[()]")
_BY_NAME = re.compile(rf'import_module\(f"({_PACKAGE}[\w.]*)\.{{')
_FOR_TYPES = re.compile(r"\nif TYPE_CHECKING:.*(?:\n[ \t].*|\n(?=\n))*")


@cache
def _imported(module: str) -> frozenset[str]:
    """Return the modules of this package that a module imports, and the packages around it, which run before it."""
    source = "\n" + _source(module).decode()
    if "TYPE_CHECKING" in source:
        source = _FOR_TYPES.sub("", source)
    parts = module.split(".")
    found = set(filter(_file, (".".join(parts[:end]) for end in range(1, len(parts)))))
    for base, listed in _IMPORT.findall(source):
        if base and not os.path.isdir(_place(base)):
            found.add(base)
            continue
        names = [part.split()[0] for part in _NO_NAME.sub("", listed).split(",") if part.strip()]
        if base:
            found |= {f"{base}.{name}" if _file(f"{base}.{name}") else base for name in names}
        else:
            found |= {name for name in names if name.partition(".")[0] == _PACKAGE}
    return frozenset(found.union(*map(_inside, _BY_NAME.findall(source))))


@cache
def _inside(package: str) -> frozenset[str]:
    """Return all modules of a package and of those in it."""
    files = (file.relative_to(_ROOT).with_suffix("") for file in Path(_place(package)).rglob("*.py"))
    return frozenset(".".join(file.parts).removesuffix(".__init__") for file in files)


def _place(module: str) -> str:
    return os.path.join(_ROOT, *module.split("."))


@cache
def _file(module: str) -> str:
    """Return the source file of a module of this package; empty where there is none."""
    if module.partition(".")[0] != _PACKAGE:
        return ""
    place = _place(module)
    return next(filter(os.path.isfile, (f"{place}.py", os.path.join(place, "__init__.py"))), "")


@cache
def _source(module: str) -> bytes:
    if not _file(module):
        raise ModuleNotFoundError(f"{module!r} is no module of this package", name=module)
    with open(_file(module), "rb") as stream:
        return stream.read()


def stamp(**entries: str) -> Mapping[str, str]:
    """Return metadata for an output file: the given hashes and the package version."""
    return {"pipeline.version": __version__, **{f"pipeline.{key}": value for key, value in entries.items()}}

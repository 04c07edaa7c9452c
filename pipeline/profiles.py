"""Log profiles: how the files of one lab map to SI columns, described in TOML and checked when read.

Shipped profiles lie in ``schemas/profiles``; a user's own is given by file name. A profile names the files
it claims, the partner file where one log is two files, the columns with their units and signs, and the
conditions that the files themselves do not state.
"""

from __future__ import annotations

import json
import re
import tomllib
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, Field, ValidationError, model_validator

from pipeline.errors import ParameterError, ProfileError
from pipeline.models import Grip, Motion, Name, Positive, Record
from pipeline.provenance import schema_folder, sha256
from pipeline.units import factor_to_si

REQUIRED_CONSTANTS = ("device", "experiment", "stiffness", "damping", "step", "sampling_period_s")


class ColumnSource(Record):
    """Where one SI column comes from: file of the pair, column name, unit, and sign of its axis."""

    name: str
    unit: Name
    sign: Literal[1, -1] = 1
    file: Literal["source", "partner"] = "source"


class Columns(Record):
    """The three columns that every log needs, and two that it may have: measured force, logged velocity."""

    time: ColumnSource
    command: ColumnSource
    position: ColumnSource
    force: ColumnSource | None = None
    velocity: ColumnSource | None = None


class Partner(Record):
    """Second file of a log, beside the first: its name is the first one's with a text replaced."""

    replace: Name
    by: Name

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        if self.replace in self.by or self.by in self.replace:
            raise ValueError(f"'replace' and 'by' must not contain each other, found {self.replace!r}, {self.by!r}")
        return self


class Constants(Record):
    """Conditions in SI that hold for all files of a profile; what is None comes from the file name."""

    device: Name | None = None
    experiment: Name | None = None
    stiffness: float | None = None
    damping: float | None = None
    step: float | None = None
    sampling_period_s: Positive | None = None
    motion: Motion = "translation"
    grip: Grip = "none"
    added_delay_samples: Annotated[int, Field(ge=0)] = 0


class Profile(Record):
    """How the files of one lab are read.

    Parameters
    ----------
    name, title : str
    format : {"native", "delimited"}
        Reader; a native log brings columns and conditions itself.
    files : tuple of str
        Patterns of the file names that are claimed (``*``, ``?``, ``[...]``; case does not matter).
    delimiter, decimal : str
        One character each.
    skip_rows : int
        Lines above the line of column names.
    partner : Partner, optional
    columns : Columns, optional
    constants : Constants
    name_pattern : str, optional
        Regular expression with named groups that reads constants out of the file name, such as
        ``B(?P<damping>[-0-9.]+)_K(?P<stiffness>[0-9.]+)``; numbers are SI.
    step_row : int, optional
        Sample, counted from 0, with the step, where a log has no baseline before it; kept beside the trial.
    """

    name: Name
    title: str = ""
    format: Literal["native", "delimited"]
    files: Annotated[tuple[Name, ...], Field(min_length=1)]
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Literal[".", ","] = "."
    skip_rows: Annotated[int, Field(ge=0)] = 0
    partner: Partner | None = None
    columns: Columns | None = None
    constants: Constants = Constants()
    name_pattern: str | None = None
    step_row: Annotated[int, Field(ge=0)] | None = None

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        if self.format == "native":
            foreign = self.model_fields_set - {"name", "title", "format", "files"}
            if foreign:
                raise ValueError(f"a native profile takes all from the log; remove {sorted(foreign)}")
            return self
        if self.columns is None:
            raise ValueError("'columns' is missing; expected [columns.time], [columns.command], [columns.position]")
        if self.delimiter == self.decimal:
            raise ValueError(f"'delimiter' and 'decimal' are both {self.delimiter!r}")
        if self.partner is None and any(c.file == "partner" for c in self.column_sources().values()):
            raise ValueError("a column is taken from the partner file, but there is no [partner] with replace and by")
        try:
            self.factors()
        except ParameterError as error:
            raise ValueError(str(error)) from error
        absent = [
            key for key in REQUIRED_CONSTANTS if getattr(self.constants, key) is None and key not in self.name_groups()
        ]
        if absent:
            raise ValueError(f"[constants] has no {absent}; expected each there or as a group of name_pattern")
        return self

    def name_groups(self) -> frozenset[str]:
        """Return the constants that the file name gives."""
        if self.name_pattern is None:
            return frozenset()
        try:
            groups = frozenset(re.compile(self.name_pattern).groupindex)
        except re.error as error:
            raise ValueError(f"name_pattern is no regular expression: {error}") from error
        unknown = groups - set(REQUIRED_CONSTANTS) - {"added_delay_samples", "grip"}
        if unknown:
            raise ValueError(f"name_pattern has unknown groups {sorted(unknown)}; known are {REQUIRED_CONSTANTS}")
        return groups

    def column_sources(self) -> dict[str, ColumnSource]:
        """Return the columns of a delimited profile by SI name: time, command, position, and what else it has."""
        assert self.columns is not None, "validated: every delimited profile has columns"
        sources = {name: getattr(self.columns, name) for name in Columns.model_fields}
        return {name: source for name, source in sources.items() if source is not None}

    def factors(self) -> dict[str, float]:
        """Return the signed factor to SI of each column.

        Raises
        ------
        ParameterError
            If a unit is not known or does not fit the column or the motion.
        """
        rotation = self.constants.motion == "rotation"
        quantities = {
            "time": ("time",),
            "command": ("torque",) if rotation else ("force",),
            "position": ("angle",) if rotation else ("length",),
            "force": ("torque",) if rotation else ("force",),
            "velocity": ("angular velocity",) if rotation else ("velocity",),
        }
        factors = {}
        for key, source in self.column_sources().items():
            try:
                factors[key] = source.sign * factor_to_si(source.unit, quantities[key])
            except ParameterError as error:
                raise ParameterError(f"columns.{key}.unit: {error} (motion is {self.constants.motion})") from error
        return factors

    def claims(self, name: str) -> bool:
        """Return whether a file name is that of a log (not of a partner) of this profile."""
        return any(fnmatchcase(name.lower(), pattern.lower()) for pattern in self.files)

    def partner_of(self, path: Path) -> Path | None:
        """Return the partner file of a log, or None where a log is one file."""
        if self.partner is None:
            return None
        return path.with_name(path.name.replace(self.partner.replace, self.partner.by))

    def log_of_partner(self, path: Path) -> Path | None:
        """Return the log that a file would be the partner of, or None where it is none."""
        if self.partner is None or self.partner.by not in path.name:
            return None
        name = path.name.replace(self.partner.by, self.partner.replace)
        return path.with_name(name) if self.claims(name) else None

    def digest(self) -> str:
        """Return the SHA-256 of all that decides how a file is read; layout and title of the TOML do not."""
        return sha256(json.dumps(self.model_dump(mode="json", exclude={"title"}), sort_keys=True).encode())


_SECTIONS: dict[tuple[str, ...], type[BaseModel]] = {
    (): Profile,
    ("partner",): Partner,
    ("constants",): Constants,
    ("columns",): Columns,
    **{("columns", key): ColumnSource for key in Columns.model_fields},
}


def read_profile(path: Path) -> Profile:
    """Read and check a profile.

    Raises
    ------
    ProfileError
        If the file cannot be read, is no TOML, or has a wrong, missing or unknown key.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ProfileError(f"{path}: profile cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(f"{path}: profile is no valid TOML (UTF-8): {error}.") from error
    try:
        return Profile.model_validate(values)
    except ValidationError as error:
        raise ProfileError(f"{path}: " + "; ".join(_explain(dict(e)) for e in error.errors())) from error


def _explain(error: dict[str, object]) -> str:
    location = error["loc"]
    assert isinstance(location, tuple)
    key = ".".join(str(part) for part in location)
    section = _SECTIONS.get(tuple(str(part) for part in location[:-1]))
    if error["type"] == "extra_forbidden" and section is not None:
        return f"key {key!r} is not known; expected one of {sorted(section.model_fields)}. Correct or remove it."
    if error["type"] == "missing":
        return f"key {key!r} is missing. Add it."
    message = str(error["msg"]).removeprefix("Value error, ")
    return f"key {key!r}: {message}, found {error['input']!r}." if key else f"{message}."


@cache
def shipped_profiles() -> tuple[Profile, ...]:
    """Return the profiles that come with the package, sorted by name."""
    return tuple(read_profile(path) for path in sorted((schema_folder() / "profiles").glob("*.toml")))


def load_profile(profile: str | Path) -> Profile:
    """Return a profile by the name of a shipped one or by its TOML file.

    Raises
    ------
    ProfileError
        If there is no such name or file, or the file is wrong.
    """
    shipped = {p.name: p for p in shipped_profiles()}
    if str(profile) in shipped:
        return shipped[str(profile)]
    path = Path(profile)
    if path.is_file():
        return read_profile(path)
    raise ProfileError(
        f"profile {str(profile)!r} is neither a file nor a shipped profile; expected one of "
        f"{sorted(shipped)} or the path of a TOML file."
    )


def claim(name: str, profiles: tuple[Profile, ...]) -> Profile | None:
    """Return the profile that claims a log by its file name; a specific one goes before the native one.

    Raises
    ------
    ProfileError
        If two profiles that are not native claim it.
    """
    specific = [p for p in profiles if p.format != "native" and p.claims(name)]
    if len(specific) > 1:
        raise ProfileError(
            f"{name}: claimed by the profiles {[p.name for p in specific]}; expected one. "
            "Choose with --profile, or narrow the `files` patterns."
        )
    if specific:
        return specific[0]
    return next((p for p in profiles if p.format == "native" and p.claims(name)), None)

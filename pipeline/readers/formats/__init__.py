"""One table of file formats: a row is the module that reads it, the first bytes by which it is known, and its library.

A module has ``read_frame(profile, name, data, wanted)`` -> `Frame` and ``list_columns(name, data, profile)``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

from pipeline.profiles.profile_model import Format

HDF5 = b"\x89HDF\r\n\x1a\n"


class FileFormat(NamedTuple):
    """How a format is read: module of this folder, first bytes (none for text), extra that brings its library."""

    module: str
    magic: tuple[bytes, ...] = ()
    extra: str = ""

    @property
    def is_text(self) -> bool:
        """Whether its files have no first bytes of their own."""
        return not self.magic


FORMATS: dict[Format, FileFormat] = {
    "native": FileFormat("native"),
    "delimited": FileFormat("delimited"),
    "json": FileFormat("json_records"),
    "parquet": FileFormat("arrow_tables", (b"PAR1",)),
    "feather": FileFormat("arrow_tables", (b"ARROW1", b"FEA1")),
    "matlab": FileFormat("matlab", (b"MATLAB 5.0", b"MATLAB 7.3"), "mat"),
    "hdf5": FileFormat("hdf5", (HDF5,), "hdf5"),
    "rosbag": FileFormat("rosbag", (b"#ROSBAG", b"SQLite format 3\0"), "bags"),
    "mcap": FileFormat("mcap", (b"\x89MCAP0\r\n",), "bags"),
    "tdms": FileFormat("tdms", (b"TDSm",), "tdms"),
}


def module_of(name: Format) -> Any:
    """Return the module that reads a format."""
    return import_module(f"{__name__}.{FORMATS[name].module}")

"""One table of file formats: a row is the module that reads it, the first bytes by which it is known, its extra.

A module of this folder has ``read(path, settings, contents)``: it adds the arrays of the file at ``path`` to the
`Contents`, by the keys of a profile (``settings``). It runs in a process of its own, which bounds time and memory of
all formats alike (`isolation`); whatever it raises is a damaged file. Native logs have a reader of their own, which
parses many files at once.
"""

from __future__ import annotations

from typing import NamedTuple

from pipeline.profiles.profile_model import Format

HDF5 = b"\x89HDF\r\n\x1a\n"


class FileFormat(NamedTuple):
    """How a format is read.

    Parameters
    ----------
    module : str
        Module of this folder.
    title : str
        What messages call it.
    magic : tuple of bytes
        First bytes; none for text.
    extra : str
        Extra of this package that installs its library; empty where it is always there.
    """

    module: str
    title: str
    magic: tuple[bytes, ...] = ()
    extra: str = ""

    @property
    def place(self) -> str:
        """Full name of the module."""
        return f"{__name__}.{self.module}"

    @property
    def is_text(self) -> bool:
        """Whether its files have no first bytes of their own."""
        return not self.magic


FORMATS: dict[Format, FileFormat] = {
    "native": FileFormat("native", "a native log"),
    "delimited": FileFormat("delimited", "delimited text"),
    "json": FileFormat("json", "JSON"),
    "parquet": FileFormat("arrow", "a Parquet or Feather file", (b"PAR1",)),
    "feather": FileFormat("arrow", "a Parquet or Feather file", (b"ARROW1", b"FEA1")),
    "matlab": FileFormat("matlab", "a MATLAB file", (b"MATLAB 5.0", b"MATLAB 7.3"), "mat"),
    "hdf5": FileFormat("hdf5", "an HDF5 file", (HDF5,), "hdf5"),
    "rosbag": FileFormat("bags", "a ROS bag", (b"#ROSBAG", b"SQLite format 3\0"), "bags"),
    "mcap": FileFormat("bags", "an MCAP file", (b"\x89MCAP0\r\n",), "bags"),
    "tdms": FileFormat("tdms", "a TDMS file", (b"TDSm",), "tdms"),
    "mdf": FileFormat("mdf", "an MDF file", (b"MDF     ",), "mdf"),
}

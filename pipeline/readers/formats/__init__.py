"""One table of file formats: a row is the function that reads it, the first bytes by which it is known, its library.

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
    libraries, extra
        What the module imports (pyarrow first where pandas is imported: it looks for it), and the extra of this package
        that installs it.
    seconds_per_byte : float
        Processor time that reading may take: 3e-9 in most libraries, ten times that where it is packed, and other
        machines are six times slower. Messages, and objects in text, are made one by one: some 20 us for 60 bytes.
    """

    module: str
    title: str
    magic: tuple[bytes, ...] = ()
    libraries: tuple[str, ...] = ()
    extra: str = ""
    seconds_per_byte: float = 2e-7

    @property
    def is_text(self) -> bool:
        """Whether its files have no first bytes of their own."""
        return not self.magic


FORMATS: dict[Format, FileFormat] = {
    "native": FileFormat("native", "a native log"),
    "delimited": FileFormat("delimited", "delimited text", seconds_per_byte=1e-6),
    "json": FileFormat("json", "JSON", seconds_per_byte=1e-6),
    "parquet": FileFormat("arrow", "a Parquet or Feather file", (b"PAR1",), ("pyarrow.parquet",)),
    "feather": FileFormat("arrow", "a Parquet or Feather file", (b"ARROW1", b"FEA1"), ("pyarrow.parquet",)),
    "matlab": FileFormat(
        "matlab", "a MATLAB file", (b"MATLAB 5.0", b"MATLAB 7.3"), ("pyarrow", "scipy.io", "matio"), "mat"
    ),
    "hdf5": FileFormat("hdf5", "an HDF5 file", (HDF5,), ("h5py",), "hdf5"),
    "rosbag": FileFormat(
        "bags", "a ROS bag", (b"#ROSBAG", b"SQLite format 3\0"), ("rosbags.highlevel",), "bags", seconds_per_byte=4e-6
    ),
    "mcap": FileFormat(
        "bags", "an MCAP file", (b"\x89MCAP0\r\n",), ("rosbags.highlevel",), "bags", seconds_per_byte=4e-6
    ),
    "tdms": FileFormat("tdms", "a TDMS file", (b"TDSm",), ("nptdms",), "tdms"),
    "mdf": FileFormat("mdf", "an MDF file", (b"MDF     ",), ("pyarrow", "asammdf"), "mdf"),
}

"""Table of file formats. Each row has the module of a format, the first bytes that identify the format, and the extra
to install.

A module of this folder has ``read(path, settings, contents)``, which adds the arrays of the file at ``path`` to the
`FileColumns`. ``settings`` is the profile. The function runs in a separate process with limited time and memory
(`isolation`), and every exception that it raises means a damaged file. A separate reader for native logs parses many
files together.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from pipeline.base.errors import refusal
from pipeline.profiles.profile_model import Format

HDF5 = b"\x89HDF\r\n\x1a\n"

PACKED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
"""First bytes of compressed files."""

_OTHERS = {
    rb"PK\x03\x04.*xl/": "an Excel workbook",
    rb"PK\x03\x04.*word/": "a Word document",
    rb"PK\x03\x04.*content.xml": "an OpenDocument file",
    rb"PK\x03\x04": "a ZIP archive",
    rb"Rar!\x1a|7z\xbc\xaf|\xfd7zXZ|BZh9.AY": "a packed archive (RAR, 7z, xz, bzip2)",
    rb".{257}ustar": "a packed archive (TAR)",
    rb"\x89PNG|\xff\xd8\xff|GIF8": "a picture (PNG, JPEG, GIF)",
    rb"%PDF-|{\\rtf|\xd0\xcf\x11\xe0": "a document (PDF, RTF, old Excel or Word)",
    rb"(\xef\xbb\xbf)?\s*<(!doctype html|html|\?xml|svg)": "a web page or other markup (HTML, XML)",
}
"""Types of files without samples, by their first bytes."""

_PROBE = 1 << 16
"""Number of bytes inspected at the beginning and at the end. A ZIP archive lists its parts at the end."""


class FileFormat(NamedTuple):
    """Description of a format and its reader.

    Parameters
    ----------
    module, function : str
        Module of this folder, and its function.
    title : str
        Name of the format in messages.
    magic : tuple of bytes
        First bytes of files in this format. Empty for text.
    extra : str
        Extra of this package that installs the library. Empty if the library is always installed.
    library : str
        Library that the function imports.
    """

    module: str
    title: str
    magic: tuple[bytes, ...] = ()
    extra: str = ""
    function: str = "read"
    library: str = ""

    @property
    def place(self) -> str:
        """Full name of the module."""
        return f"{__name__}.{self.module}"


FORMATS: dict[Format, FileFormat] = {
    "native": FileFormat("native", "a native log"),
    "delimited": FileFormat("delimited", "delimited text"),
    "json": FileFormat("json", "JSON"),
    "parquet": FileFormat("arrow", "a Parquet or Feather file", (b"PAR1",)),
    "feather": FileFormat("arrow", "a Parquet or Feather file", (b"ARROW1", b"FEA1")),
    "matlab": FileFormat("matlab", "a MATLAB file", (b"MATLAB 5.0", b"MATLAB 7.3"), "mat"),
    "hdf5": FileFormat("hdf5_tdms_mdf", "an HDF5 file", (HDF5,), "hdf5", "read_hdf5", "h5py"),
    "rosbag": FileFormat("bags", "a ROS bag", (b"#ROSBAG", b"SQLite format 3\0"), "bags"),
    "mcap": FileFormat("bags", "an MCAP file", (b"\x89MCAP0\r\n",), "bags"),
    "tdms": FileFormat("hdf5_tdms_mdf", "a TDMS file", (b"TDSm",), "tdms", "read_tdms", "nptdms"),
    "mdf": FileFormat("hdf5_tdms_mdf", "an MDF file", (b"MDF     ",), "mdf", "read_mdf", "asammdf"),
    "npz": FileFormat("archives", "a numpy archive", function="read_npz"),
    "sheet": FileFormat("archives", "a sheet (XLSX, ODS)", (), "sheets", "read_sheet", "python_calamine"),
}
"""Formats inside ZIP archives. These formats begin with the same bytes, but the names of the parts in the archive
differ (`format_of`)."""


def packed_kind(data: bytes) -> Format | None:
    """Return the format of a ZIP archive from the names of its first and last parts, or None for a file of a different
    kind."""
    probe = data[:_PROBE] + data[-_PROBE:]
    if re.search(rb"xl/work(book|sheets)|opendocument\.spreadsheet", probe):
        return "sheet"
    return "npz" if re.search(rb"\.npy", probe) else None


def format_of(name: str, data: bytes) -> Format:
    """Return the format of a file from its first bytes. The default is delimited text.

    Parameters
    ----------
    name : str
        File name, which determines the format of bags that are compressed as a whole.
    data : bytes
    """
    for kind, form in FORMATS.items():
        if form.magic and data.startswith(form.magic):
            return kind
    # The name is needed, because a MATLAB 7.3 file may lack its text header, and the first bytes of a compressed
    # database do not show its content.
    if HDF5 in (data[512:520], data[1024:1032]):
        return "matlab" if name.lower().endswith(".mat") else "hdf5"
    if ".db3" in name.lower():
        return "rosbag"
    if data.startswith(b"PK\x03\x04") and (packed := packed_kind(data)) is not None:
        return packed
    head = data[:64].replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n")
    if head.startswith(b"{") or (head.startswith(b"[") and head[1:].lstrip()[:1] in (b"{", b"[")):
        return "json"
    if re.search(rb"^#\s*device\s*:", data[:4096], re.MULTILINE) and b"time_s,command,position" in data:
        return "native"
    return "delimited"


def refuse_other_kind(name: str, kind: Format, data: bytes) -> None:
    """Refuse a file that is clearly not a log of the expected format.

    Parameters
    ----------
    name : str
        The file.
    kind : str
        Expected format (``format`` of the profile).
    data : bytes

    Raises
    ------
    LogError
        If the file is an archive, a picture, a document, a web page, or a log of a different format.
    """
    probe = data[:_PROBE] + data[-_PROBE:]
    if kind == packed_kind(data):
        return
    what = next((what for begin, what in _OTHERS.items() if re.match(begin, probe, re.DOTALL | re.IGNORECASE)), "")
    if what:
        cure = "Unpack the file, or export the recorded samples as CSV, and ingest the result."
        raise refusal("unsupported", name, f"is {what}, although its name differs", f"a log of format {kind!r}", cure)
    if FORMATS[kind].magic and data.startswith(tuple(PACKED)):
        raise refusal("unsupported", name, "is compressed as a whole", cure=f"Unpack it: zstd -d {name}")
    actual = "native" if data[:1].isspace() else format_of(name, data[:2048])
    # A MATLAB 7.3 file is also an HDF5 file.
    if actual != kind and FORMATS[actual].magic and {actual, kind} != {"matlab", "hdf5"}:
        line, text = f'format = "{actual}"', f"is a file of format {actual!r}"
        raise refusal("unsupported", name, text, repr(kind), line=line)

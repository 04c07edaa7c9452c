"""What a file is by its first bytes, where that is not what its name or its profile says: an archive, a page, ...

A spreadsheet that was saved under the name ``run.csv`` would otherwise be refused for its column names.
"""

from __future__ import annotations

from pipeline.profiles.profile_model import Format
from pipeline.readers.formats import FORMATS
from pipeline.readers.formats.delimited import PACKED
from pipeline.readers.layout import format_of
from pipeline.readers.refusals import refusal

_KINDS: dict[bytes, str] = {
    b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1": "an old Excel or Word file",
    b"Rar!\x1a\x07": "a RAR archive",
    b"7z\xbc\xaf\x27\x1c": "a 7z archive",
    b"\xfd7zXZ\0": "a file packed by xz",
    b"BZh91AY&SY": "a file packed by bzip2",
    b"\x04\x22\x4d\x18": "a file packed by lz4",
    b"\x89PNG\r\n\x1a\n": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"GIF8": "a GIF picture",
    b"%PDF-": "a PDF document",
    b"{\\rtf": "a text processor's file (RTF)",
    b"\x7fELF": "a program",
    b"PK\x03\x04": "a ZIP archive",
    b"PK\x05\x06": "a ZIP archive",
}
"""First bytes, and what they stand for."""

_OFFICE = {b"xl/": "an Excel workbook", b"word/": "a Word document", b"content.xml": "an OpenDocument file"}
_PROBE = 1 << 16
"""Bytes that are searched for the names of parts of a ZIP archive, which stand at its beginning and end."""

_TAR = slice(257, 262)
_PAGES = (b"<!doctype html", b"<html", b"<?xml", b"<svg")
_CURE = "Unpack it, or export the recorded samples as CSV, and ingest that."


def refuse_other_kind(name: str, kind: Format, data: bytes) -> None:
    """Refuse a file that is plainly something else than a log of its format.

    Parameters
    ----------
    name : str
        The file.
    kind : str
        Format that it is to be read as (``format`` of the profile).
    data : bytes

    Raises
    ------
    LogError
        If it is an archive, a picture, a document, a web page, or a log of another format.
    """
    what = next((what for magic, what in _KINDS.items() if data.startswith(magic)), "")
    if what == "a ZIP archive":
        what = next((office for part, office in _OFFICE.items() if part in data[:_PROBE] + data[-_PROBE:]), what)
    elif data[_TAR] == b"ustar":
        what = "a TAR archive"
    elif data[:64].lstrip(b"\xef\xbb\xbf \t\r\n").lower().startswith(_PAGES):
        what = "a web page or other markup (HTML, XML)"
    if what:
        text = f"is {what}, whatever its name says"
        raise refusal("unsupported", name, text, f"a log of format {kind!r}", _CURE)
    if not FORMATS[kind].is_text and data.startswith(tuple(PACKED)):
        raise refusal("unsupported", name, "is packed as a whole", cure=f"Unpack it: zstd -d {name}")
    actual = "native" if data[:1].isspace() else format_of(name, data[:2048])
    # a MATLAB 7.3 file is an HDF5 file, too
    if actual != kind and not FORMATS[actual].is_text and {actual, kind} != {"matlab", "hdf5"}:
        line = f'format = "{actual}"'
        text = f"is a file of format {actual!r}, whatever its name says"
        raise refusal("unsupported", name, text, repr(kind), line=line)

"""What a file is by its first bytes, where that is not what its name or its profile says: an archive, a page, ...

A spreadsheet that was saved under the name ``run.csv`` would otherwise be refused for its column names.
"""

from __future__ import annotations

from pipeline.profiles.profile_model import Format
from pipeline.readers.formats import FORMATS
from pipeline.readers.formats.delimited import PACKED
from pipeline.readers.layout import format_of
from pipeline.readers.refusals import refusal

_ARCHIVE, _PICTURE, _PAGE = "Unpack it", "Export the numbers behind it", "Save the recorded samples as a file"
_SHEET = "Export its sheet as CSV"
_KINDS: tuple[tuple[bytes, str, str], ...] = (
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an old Excel or Word file", _SHEET),
    (b"Rar!\x1a\x07", "a RAR archive", _ARCHIVE),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive", _ARCHIVE),
    (b"\xfd7zXZ\0", "a file packed by xz", _ARCHIVE),
    (b"BZh91AY&SY", "a file packed by bzip2", _ARCHIVE),
    (b"\x04\x22\x4d\x18", "a file packed by lz4", _ARCHIVE),
    (b"\x89PNG\r\n\x1a\n", "a PNG picture", _PICTURE),
    (b"\xff\xd8\xff", "a JPEG picture", _PICTURE),
    (b"GIF8", "a GIF picture", _PICTURE),
    (b"%PDF-", "a PDF document", _PICTURE),
    (b"{\\rtf", "a text processor's file (RTF)", _PAGE),
    (b"\x7fELF", "a program", _PAGE),
)
"""First bytes, what they stand for, and what to do."""

_ZIP = (b"PK\x03\x04", b"PK\x05\x06")
_OFFICE = (
    (b"xl/", "an Excel workbook", _SHEET),
    (b"word/", "a Word document", _PAGE),
    (b"content.xml", "an OpenDocument file", _SHEET),
)
_PROBE = 1 << 16
"""Bytes that are searched for the names of parts of a ZIP archive, which stand at its beginning and end."""

_TAR = slice(257, 262)
_PAGES = (b"<!doctype html", b"<html", b"<?xml", b"<svg")


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
    what, cure = _other_kind(data)
    if what:
        text = f"is {what}, whatever its name says"
        raise refusal("unsupported", name, text, f"a log of format {kind!r}", f"{cure}, and ingest that.")
    if not FORMATS[kind].is_text and data.startswith(tuple(PACKED)):
        raise refusal("unsupported", name, "is packed as a whole", cure=f"Unpack it: zstd -d {name}")
    actual = "native" if data[:1].isspace() else format_of(name, data[:2048])
    # a MATLAB 7.3 file is an HDF5 file, too
    if actual != kind and not FORMATS[actual].is_text and {actual, kind} != {"matlab", "hdf5"}:
        line = f'format = "{actual}"'
        text = f"is a file of format {actual!r}, whatever its name says"
        raise refusal("unsupported", name, text, repr(kind), f"Describe it by a profile with {line}.", line=line)


def _other_kind(data: bytes) -> tuple[str, str]:
    """Return what the file is, and what to do with it; empty where nothing is known."""
    if data.startswith(_ZIP):
        parts = data[:_PROBE] + data[-_PROBE:]
        office = next(((what, advice) for part, what, advice in _OFFICE if part in parts), None)
        return office or ("a ZIP archive", _ARCHIVE)
    if data[_TAR] == b"ustar":
        return "a TAR archive", _ARCHIVE
    for magic, what, advice in _KINDS:
        if data.startswith(magic):
            return what, advice
    if data[:64].lstrip(b"\xef\xbb\xbf \t\r\n").lower().startswith(_PAGES):
        return "a web page or other markup (HTML, XML)", _PAGE
    return "", ""

"""What a file is by its first bytes: the format of a log, or an archive, a page, ... that is none.

A spreadsheet that was saved under the name ``run.csv`` would otherwise be refused for its column names.
"""

from __future__ import annotations

import re

from pipeline.base.errors import refusal
from pipeline.profiles.profile_model import Format
from pipeline.readers.formats import FORMATS, HDF5

PACKED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
"""First bytes of packed files."""

_KINDS = {
    "a packed archive (RAR, 7z, xz, bzip2)": (b"Rar!\x1a\x07", b"7z\xbc\xaf\x27\x1c", b"\xfd7zXZ\0", b"BZh9"),
    "a picture (PNG, JPEG, GIF)": (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"GIF8"),
    "a document (PDF, RTF, old Excel or Word)": (b"%PDF-", b"{\\rtf", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"),
    "a program": (b"\x7fELF",),
    "a ZIP archive": (b"PK\x03\x04", b"PK\x05\x06"),
}
"""What files are that hold no samples, by their first bytes."""

_OFFICE = {b"xl/": "an Excel workbook", b"word/": "a Word document", b"content.xml": "an OpenDocument file"}
_PROBE = 1 << 16
"""Bytes that are searched for the names of parts of a ZIP archive, which stand at its beginning and end."""

_PAGES = (b"<!doctype html", b"<html", b"<?xml", b"<svg")


def format_of(name: str, data: bytes) -> Format:
    """Return the format of a file by its first bytes; delimited text where they are none of the known.

    Parameters
    ----------
    name : str
        File name: it decides where bags are packed as a whole.
    data : bytes
    """
    for kind, form in FORMATS.items():
        if form.magic and data.startswith(form.magic):
            return kind
    # a MATLAB 7.3 file may lack its text, a packed database says nothing of what is inside
    if HDF5 in (data[512:520], data[1024:1032]):
        return "matlab" if name.lower().endswith(".mat") else "hdf5"
    if ".db3" in name.lower():
        return "rosbag"
    head = data[:64].replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n")
    if head.startswith(b"{") or (head.startswith(b"[") and head[1:].lstrip()[:1] in (b"{", b"[")):
        return "json"
    if re.search(rb"^#\s*device\s*:", data[:4096], re.MULTILINE) and b"time_s,command,position" in data:
        return "native"
    return "delimited"


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
    what = next((what for what, magic in _KINDS.items() if data.startswith(magic)), "")
    if what == "a ZIP archive":
        what = next((office for part, office in _OFFICE.items() if part in data[:_PROBE] + data[-_PROBE:]), what)
    elif data[257:262] == b"ustar":
        what = "a packed archive (TAR)"
    elif data[:64].lstrip(b"\xef\xbb\xbf \t\r\n").lower().startswith(_PAGES):
        what = "a web page or other markup (HTML, XML)"
    if what:
        cure = "Unpack it, or export the recorded samples as CSV, and ingest that."
        raise refusal("unsupported", name, f"is {what}, whatever its name says", f"a log of format {kind!r}", cure)
    if not FORMATS[kind].is_text and data.startswith(tuple(PACKED)):
        raise refusal("unsupported", name, "is packed as a whole", cure=f"Unpack it: zstd -d {name}")
    actual = "native" if data[:1].isspace() else format_of(name, data[:2048])
    # a MATLAB 7.3 file is an HDF5 file, too
    if actual != kind and not FORMATS[actual].is_text and {actual, kind} != {"matlab", "hdf5"}:
        line, text = f'format = "{actual}"', f"is a file of format {actual!r}, whatever its name says"
        raise refusal("unsupported", name, text, repr(kind), line=line)

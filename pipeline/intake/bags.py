"""ROS 2 bags: which files of a folder are one recording.

``ros2 bag record`` makes a folder with ``metadata.yaml`` and one or more ``.db3`` or ``.mcap`` files: a long recording
is split over several. Together they are one log.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.paths import open_regular

METADATA = "metadata.yaml"
ENDINGS = (".db3", ".mcap")

LARGEST_METADATA = 1 << 20
"""Bytes of ``metadata.yaml`` that are read; it has some hundred for each file and topic."""

_MARK = "rosbag2_bagfile_information"
_LISTED = re.compile(
    rf"""(?:[-,\[]|path:)\s*['"]?([^\s'",\[\]][^'",\[\]\n]*?({"|".join(map(re.escape, ENDINGS))})(\.zstd)?)\b"""
)
"""A file in the metadata: an entry of ``relative_file_paths``, or of ``files``, where each has more than its path."""


@dataclass(frozen=True)
class Bag:
    """A folder that is one recording: its files in their order, and why it is not whole."""

    folder: Path
    files: tuple[Path, ...]
    problem: str | None = None


def bag_of(file: Path, within: str | None = None) -> Bag | None:
    """Return the bag that a file belongs to, or None where it stands for itself.

    Parameters
    ----------
    file : Path
        A recorded file, or ``metadata.yaml``. Other files, and those that their folder's metadata does not list, belong
        to no bag.
    within : str, optional
        As for `open_regular`: metadata elsewhere are not opened.
    """
    if file.name != METADATA and file.suffix.lower() not in ENDINGS:
        return None
    folder, own = file.parent, _numbered(file.parent)
    try:
        with open_regular(folder / METADATA, within) as stream:
            text = stream.read(LARGEST_METADATA).decode("utf-8", "replace")
    except OSError:
        if len(own) < 2 or file.name not in own:
            return None
        unlisted = (
            f"{len(own)} files {own[0]}, ... look like one bag, but {METADATA}, which lists its files, is missing. "
            "Run `ros2 bag reindex` on the folder; if each is a recording of its own, rename the folder."
        )
        return Bag(folder, tuple(folder / name for name in own), unlisted)
    if _MARK not in text:
        return None
    # early versions wrote folders; one that was unpacked by hand has lost its second ending
    listed = list(dict.fromkeys(os.path.basename(found[1]) for found in _LISTED.finditer(text)))
    listed = [plain if os.path.exists(folder / (plain := name.removesuffix(".zstd"))) else name for name in listed]
    if not listed:
        return Bag(
            folder, (folder / METADATA,), f"{METADATA} lists no files; expected relative_file_paths. Reindex it."
        )
    if file.name not in {METADATA, *listed, *own}:
        return None
    problem: str | None = None
    # unlike that of a path this takes names that no file system allows
    if lost := [name for name in listed if not os.path.exists(folder / name)]:
        problem = f"{lost} of the bag {_title(folder)} are missing, which {METADATA} lists; expected all together."
    elif more := [name for name in own if name not in listed]:
        problem = f"{more} of the bag {_title(folder)} are not listed in {METADATA}. Run `ros2 bag reindex` on it."
    return Bag(folder, tuple(folder / name for name in listed), problem)


def _title(folder: Path) -> str:
    return os.path.basename(os.path.abspath(folder))


def _numbered(folder: Path) -> list[str]:
    """Return the files that `ros2 bag record` calls by their folder and counts, in that order."""
    try:
        names = os.listdir(folder)
    except OSError:  # whoever opens the file says why
        return []
    pattern = re.compile(rf"{re.escape(_title(folder))}_(\d+)({'|'.join(map(re.escape, ENDINGS))})")
    return [match[0] for match in sorted(filter(None, map(pattern.fullmatch, names)), key=lambda found: int(found[1]))]

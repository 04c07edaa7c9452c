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
_BLOCK = re.compile(r"^[ ]*relative_file_paths:[ ]*\n((?:[ ]*-[^\n]*\n?)+)", re.MULTILINE)
_FLOW = re.compile(r"^[ ]*relative_file_paths:[ ]*\[([^\]]*)\]", re.MULTILINE)


@dataclass(frozen=True)
class Bag:
    """A folder that is one recording.

    Parameters
    ----------
    folder : Path
    files : tuple of Path
        Its recorded files, in their order.
    problem : str or None
        Why it is not whole.
    """

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
    if not may_belong(file):
        return None
    folder = file.parent
    title = os.path.basename(os.path.abspath(folder))
    # `ros2 bag record` calls the files by the folder and counts them from 0
    own = sorted(
        (int(match[1]), name)
        for name in _names(folder)
        if (match := re.fullmatch(rf"{re.escape(title)}_(\d+)({'|'.join(map(re.escape, ENDINGS))})", name))
    )
    try:
        with open_regular(folder / METADATA, within) as stream:
            text = stream.read(LARGEST_METADATA).decode("utf-8", "replace")
    except OSError:
        if len(own) < 2 or file.name not in {name for _, name in own}:
            return None
        unlisted = (
            f"{len(own)} files {own[0][1]}, ... look like one bag, but {METADATA}, which lists its files, is missing. "
            "Run `ros2 bag reindex` on the folder; if each is a recording of its own, rename the folder."
        )
        return Bag(folder, tuple(folder / name for _, name in own), unlisted)
    if _MARK not in text:
        return None
    listed = [_present(folder, name) for name in _listed(text)]
    if not listed:
        return Bag(
            folder, (folder / METADATA,), f"{METADATA} lists no files; expected relative_file_paths. Reindex it."
        )
    if file.name not in {METADATA, *(path.name for path in listed), *(name for _, name in own)}:
        return None
    # unlike that of a path this takes names that no file system allows
    lost = [path.name for path in listed if not os.path.exists(path)]
    more = [name for _, name in own if name not in {path.name for path in listed}]
    problem: str | None = None
    if lost:
        problem = f"{lost} of the bag {title} are missing, which {METADATA} lists; expected all of its files together."
    elif more:
        problem = f"{more} of the bag {title} are not listed in {METADATA}. Run `ros2 bag reindex` on the folder."
    return Bag(folder, tuple(listed), problem)


def may_belong(file: Path) -> bool:
    """Return whether a file may be part of a bag, by its name."""
    return file.name == METADATA or file.suffix.lower() in ENDINGS


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:  # whoever opens the file says why
        return []


def _listed(text: str) -> list[str]:
    """Return the file names that the metadata lists, without folders: early versions wrote some."""
    block, flow = _BLOCK.search(text), _FLOW.search(text)
    entries = re.findall(r"-[ ]*([^\n]*)", block[1]) if block else flow[1].split(",") if flow else []
    names = (os.path.basename(entry.strip().strip("'\"")) for entry in entries)
    return list(dict.fromkeys(name for name in names if name))


def _present(folder: Path, name: str) -> Path:
    """Return the path of a listed file; one that was unpacked by hand has lost its ending."""
    unpacked = folder / name.removesuffix(".zstd")
    return unpacked if os.path.exists(unpacked) else folder / name

"""A disk that fails or loses power: stands for ``os`` in `pipeline.base.disk`, counts its calls, and replays them."""

from __future__ import annotations

import io
import itertools
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np


class Raw(io.FileIO):
    """A file whose writes go through a `FailingOs`."""

    def __init__(self, disk: FailingOs, number: int) -> None:
        super().__init__(number, "wb")
        self.disk = disk

    def write(self, data: Any) -> int:
        return self.disk.write(self.fileno(), data)


@dataclass
class FailingOs:
    """The calls that change something, with the one at which they fail, counted from 1; 0 never."""

    fail_at: int = 0
    calls: list[tuple[Any, ...]] = field(default_factory=list)
    _files: dict[int, int] = field(default_factory=dict)
    _folders: dict[int, str] = field(default_factory=dict)
    _inodes: Iterator[int] = field(default_factory=itertools.count)
    # batches are written by a thread of their own
    _lock: Any = field(default_factory=threading.Lock)

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    def _note(self, *call: Any) -> None:
        with self._lock:
            self.calls.append(call)
            count = len(self.calls)
        if count == self.fail_at:
            raise OSError(28, "No space left on device")

    def open(self, path: Path, flags: int, mode: int = 0o777) -> int:
        folder = os.path.isdir(path)
        if folder:
            number = os.open(path, flags, mode)
            self._folders[number] = str(path)
        else:
            inode = next(self._inodes)
            self._note("create", inode, str(path))
            number = os.open(path, flags, mode)
            self._files[number] = inode
        return number

    def fdopen(self, number: int, mode: str, buffering: int) -> BinaryIO:
        return io.BufferedWriter(Raw(self, number), buffering)

    def write(self, number: int, data: Any) -> int:
        self._note("write", self._files[number], bytes(data))
        return os.write(number, data)

    def fsync(self, number: int) -> None:
        if number in self._folders:
            self._note("sync folder", self._folders[number])
        else:
            self._note("sync file", self._files[number])

    def close(self, number: int) -> None:
        self._folders.pop(number, None)
        os.close(number)

    def replace(self, old: Path, new: Path) -> None:
        self._note("rename", str(old), str(new))
        os.replace(old, new)

    def unlink(self, path: Path) -> None:
        if os.path.lexists(path):
            self._note("unlink", str(path))
        os.unlink(path)

    def mkdir(self, path: Path, mode: int = 0o777) -> None:
        self._note("mkdir", str(path))
        os.mkdir(path, mode)


def after_power_loss(
    before: dict[str, bytes], calls: list[tuple[Any, ...]], root: Path, target: Path, kept: float, rng: Any
) -> None:
    """Write a folder as it may be found after a loss of power.

    Parameters
    ----------
    before : dict of str to bytes
        Files below ``root`` when the calls began, all of them on the disk.
    calls : list
        The calls that were made until then.
    root, target : Path
        The folder that was written to, and where to write what is left of it.
    kept : float
        Probability that what was not synced is on the disk nevertheless.
    rng : numpy.random.Generator
    """
    synced_at: dict[str, int] = {}
    for index, call in enumerate(calls):
        if call[0] == "sync folder":
            synced_at[call[1]] = index

    def lasting(index: int, path: str) -> bool:
        return synced_at.get(os.path.dirname(path), -1) > index or rng.random() < kept

    entries: dict[str, int | str] = {os.path.join(root, name): name for name in before}
    folders = {os.path.dirname(path) for path in entries} | {str(root.parent)}
    for path in list(folders):
        while len(path) > len(str(root)):
            path = os.path.dirname(path)
            folders.add(path)
    real: dict[str, int | str] = dict(entries)
    content: dict[int, list[bytes]] = {}
    synced: set[int] = set()
    for index, call in enumerate(calls):
        kind = call[0]
        if kind == "mkdir":
            if os.path.dirname(call[1]) in folders and lasting(index, call[1]):
                folders.add(call[1])
        elif kind == "create":
            content[call[1]] = []
            real[call[2]] = call[1]
            if lasting(index, call[2]):
                entries[call[2]] = call[1]
        elif kind == "write":
            content[call[1]].append(call[2])
            synced.discard(call[1])
        elif kind == "sync file":
            synced.add(call[1])
        elif kind == "rename":
            inode = real.pop(call[1])
            real[call[2]] = inode
            if lasting(index, call[2]):
                entries.pop(call[1], None)
                entries[call[2]] = inode
        elif kind == "unlink":
            real.pop(call[1], None)
            if lasting(index, call[1]):
                entries.pop(call[1], None)
    for path, inode in entries.items():
        if os.path.dirname(path) not in folders:
            continue
        if isinstance(inode, str):
            data = before[inode]
        else:
            data = b"".join(content[inode])
            if inode not in synced:
                data = data[: int(len(data) * (kept if kept in (0.0, 1.0) else rng.random()))]
        place = target / os.path.relpath(path, root)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(data)


def files_of(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder, by their name relative to it."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def generator(*seed: int) -> np.random.Generator:
    return np.random.default_rng(list(seed))

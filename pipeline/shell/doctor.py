"""Whether this machine has what the package needs, and what to do where it has not; nothing is changed."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement

from pipeline import __version__
from pipeline.base.disk import write_text
from pipeline.base.errors import PipelineError
from pipeline.base.lock import holder, writing
from pipeline.device_data.devices import known_devices
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.records.findings import Record

PACKAGE = "haptic-pipeline"

EXTRAS = {
    "mat": "MATLAB 7.3 files",
    "hdf5": "HDF5 files",
    "bags": "ROS bags",
    "tdms": "TDMS files",
    "mdf": "MDF files",
    "serve": "pipeline serve",
    "cluster": "stores by URL, and clusters",
}
"""What the packages of each extra are for."""

LITTLE = 1 << 30
"""Free space [byte] below which a word is due: a course of 2,200 logs takes some 0.1 GB with its reports."""


class Check(Record):
    """One thing that was looked at.

    ``state`` is ``missing`` for what is optional, and ``wrong`` for what keeps a command from working; ``help`` then
    says what to do.
    """

    name: str
    state: Literal["good", "missing", "wrong"]
    found: str
    help: str = ""


def examine(processed: Path) -> list[Check]:
    """Look at Python, packages, the store's disk and lock, and the descriptions of devices and logs.

    Parameters
    ----------
    processed : Path
        Folder of the stored tables; it need not exist.
    """
    return [
        Check(name="pipeline", state="good", found=f"{__version__}, {Path(__file__).resolve().parents[1]}"),
        Check(name="Python", state="good", found=f"{platform.python_version()}, {platform.platform()}"),
        Check(name="processors", state="good", found=str(os.cpu_count() or 1)),
        *_packages(),
        *_disk(processed),
        *_descriptions(),
    ]


def _packages() -> Iterator[Check]:
    """Packages that are needed, and for each extra those that are not there."""
    lacking: dict[str, list[str]] = {}
    for needed in map(Requirement, requires(PACKAGE) or ()):
        extra = next((name for name in EXTRAS if needed.marker and needed.marker.evaluate({"extra": name})), "")
        if not extra and needed.marker and not needed.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(needed.name)
        except PackageNotFoundError:
            found = ""
        good = bool(found) and needed.specifier.contains(found, prereleases=True)
        if extra:
            lacking.setdefault(extra, []).extend([] if good else [needed.name])
        elif good:
            yield Check(name=needed.name, state="good", found=found)
        else:
            text = f"{found or 'nothing'}; {needed.specifier} is needed"
            yield Check(name=needed.name, state="wrong", found=text, help=f"pip install '{needed}'")
    for extra, names in lacking.items():
        if names:
            what = f"{', '.join(names)} not installed"
            help_text = f"pip install '.[{extra}]' in the project's folder"
            yield Check(name=EXTRAS[extra], state="missing", found=what, help=help_text)
        else:
            yield Check(name=EXTRAS[extra], state="good", found="installed")


def _disk(processed: Path) -> Iterator[Check]:
    """The disk that holds the store, or will: room, permission, locks, and who writes there now."""
    there = next(folder for folder in (processed.absolute(), *processed.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(there).free
    yield Check(
        name="free space",
        state="good" if free > LITTLE else "wrong",
        found=f"{free / 1e9:.1f} GB at {there}",
        help="" if free > LITTLE else "make room: a course of 2,200 logs takes 0.1 GB with its reports",
    )
    try:
        with tempfile.TemporaryDirectory(prefix=".doctor-", dir=there) as name, writing(Path(name), 0.0):
            write_text(Path(name) / "written", "")
        yield Check(name="writing and locks", state="good", found=f"work at {there}")
    except (PipelineError, OSError) as error:
        help_text = "choose a folder on a local disk that you may write to (--processed)"
        yield Check(name="writing and locks", state="wrong", found=str(error), help=help_text)
    writer = holder(processed) if processed.is_dir() else None
    yield Check(name=str(processed), state="good", found=_store_words(processed, str(writer) if writer else ""))


def _store_words(processed: Path, writer: str) -> str:
    if not processed.is_dir():
        return "not there yet: the first ingest makes it"
    return f"{writer} writes there" if writer else "nobody writes there"


def _descriptions() -> Iterator[Check]:
    """Files that describe devices and logs, those of the user included."""
    reads: dict[str, Callable[[], Iterable[str]]] = {
        "devices": known_devices,
        "profiles": lambda: [profile.name for profile in shipped_profiles()],
    }
    for name, names in reads.items():
        try:
            yield Check(name=name, state="good", found=", ".join(sorted(names())))
        except PipelineError as error:
            yield Check(name=name, state="wrong", found=str(error), help="correct the file that is named")

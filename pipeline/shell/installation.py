"""Whether this machine has what the package needs, and what to do where it has not; nothing is changed."""

from __future__ import annotations

import platform
import tempfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement

from pipeline import __version__
from pipeline.base.disk import write_text
from pipeline.base.errors import PipelineError
from pipeline.base.lock import writing
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
    """Look at packages, the disk of the store, and the descriptions of devices and logs.

    Parameters
    ----------
    processed : Path
        Folder of the stored tables; it need not exist.
    """
    here = f"{__version__}, Python {platform.python_version()}, {platform.platform()}"
    return [Check(name="pipeline", state="good", found=here), *_packages(), _disk(processed), *_descriptions()]


def _packages() -> Iterator[Check]:
    """Packages that are needed, and for each extra those that are not there."""
    lacking: dict[str, list[str]] = {extra: [] for extra in EXTRAS}
    for needed in map(Requirement, requires(PACKAGE) or ()):
        wanted_by = [e for e in ("", *EXTRAS) if needed.marker is None or needed.marker.evaluate({"extra": e})]
        if not wanted_by:
            continue
        try:
            found = version(needed.name)
        except PackageNotFoundError:
            found = ""
        good = bool(found) and needed.specifier.contains(found, prereleases=True)
        if "" not in wanted_by:
            lacking[wanted_by[0]] += [] if good else [needed.name]
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


def _disk(processed: Path) -> Check:
    """Look whether the disk that holds the store, or will, can be written and locked."""
    there = next(folder for folder in (processed.absolute(), *processed.absolute().parents) if folder.is_dir())
    try:
        with tempfile.TemporaryDirectory(prefix=".doctor-", dir=there) as name, writing(Path(name), 0.0):
            write_text(Path(name) / "written", "")
    except (PipelineError, OSError) as error:
        help_text = "choose a folder on a local disk that you may write to (--processed)"
        return Check(name="writing and locks", state="wrong", found=str(error), help=help_text)
    return Check(name="writing and locks", state="good", found=f"work at {there}")


def _descriptions() -> Iterator[Check]:
    """Files that describe devices and logs, those of the user included."""
    for name, read in (("devices", known_devices), ("profiles", lambda: [one.name for one in shipped_profiles()])):
        try:
            yield Check(name=name, state="good", found=", ".join(sorted(read())))
        except PipelineError as error:
            yield Check(name=name, state="wrong", found=str(error), help="correct the file that is named")

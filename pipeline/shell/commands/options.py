"""Options that several commands share. A list is given by repeating an option or by separating items with commas."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pipeline.base.errors import ParameterError, UsageError
from pipeline.shell.console import option

if TYPE_CHECKING:
    from pipeline.device.parameters import Motion
    from pipeline.records.models import Device


def _folder(text: str) -> Path:
    from pipeline.store.objects import is_url

    if is_url(text):
        raise typer.BadParameter(
            f"{text}: this command needs a folder; docs/storage.md lists the commands that accept a URL."
        )
    return Path(text)


def _split(given: list[str] | None) -> list[str] | None:
    """Return the items of a list. An item that contains a comma must be in double quotes."""
    return [word for row in csv.reader(given, skipinitialspace=True) for word in row or ("",)] if given else None


def listed(name: str, help_text: str, *more: str, **how: Any) -> Any:
    """Return an option whose value is a list."""
    return option(name, f"{help_text} Repeat or use commas.", *more, callback=_split, **how)


PROCESSED, REPORTS = "PIPELINE_PROCESSED", "PIPELINE_REPORTS"
"""Environment variables for the folders of stored tables and reports. They apply if the option is not given."""

Processed = Annotated[Path, option("--processed", "Folder of the stored tables.", envvar=PROCESSED, parser=_folder)]
Store = Annotated[str, option("--processed", "Stored tables: folder or s3://BUCKET/KEY.", envvar=PROCESSED)]
Reports = Annotated[Path, option("--reports", "Folder of the reports.", envvar=REPORTS)]
ExecutorName = Annotated[str, option("--executor", "Where to compute: local, or dask://HOST:PORT.")]
ProfileFile = Annotated[str | None, option("--profile", "Log profile: name or file (.toml).")]
Ignore = Annotated[list[str] | None, option("--ignore", "Names of files that are not logs, 'cal_*'. Repeatable.")]
LogProfile = Any
"""Profile received by a command: the name or file of `ProfileFile`, or a profile made from column options."""
DeviceName = Annotated[str, option("--device", "Device: name or file (.toml).")]
One = Annotated[str | None, option("--experiment", "Experiment (default: the first).", "-e")]
Experiments = Annotated[list[str] | None, listed("--experiment", "Experiments (default: all).", "-e")]
Criteria = Annotated[list[str] | None, listed("--criteria", "Criteria (default: standard set).")]
Signal = Literal["continuous", "discrete"]
Out = Annotated[Path | None, option("--out", "File to write.", show_default=False)]


def quantity(option: str, text: str, *names: str) -> float:
    """Return the value of an option in SI.

    A number without a unit is in SI. A unit must belong to one of the quantities.
    """
    from pipeline.base.units import quantity_in_si

    try:
        return quantity_in_si(text, names, option)
    except ParameterError as error:
        raise UsageError(str(error)) from error


def stiffness_of(text: str, motion: Motion | None) -> float:
    """Return the value of ``--stiffness`` in SI.

    A number without a unit is in SI. A unit must fit the motion of the device.

    Without a motion, the value is the normalised stiffness alpha.
    """
    from pipeline.base.units import UNITS, find_unit, split_quantity
    from pipeline.device.parameters import is_rotation, unit_of

    found, si = split_quantity(text), unit_of("stiffness", motion) if motion is not None else ""
    if found is None or (motion is None and found[1]):
        expected = f"with or without its unit, as '5 {si}'" if si else "the normalised stiffness, as 0.05"
        raise UsageError(f"--stiffness {text}: expected a number, {expected}.")
    value, symbol = found
    if motion is None:
        return value
    unit = find_unit(symbol or si)
    if unit is None or unit.quantity != UNITS[si].quantity:
        lever = (
            " A stiffness in N/m at a lever of r m corresponds to r^2 times that number in Nm/rad."
            if is_rotation(motion)
            else ""
        )
        raise UsageError(f"--stiffness {text}: expected {si}, because the motion of the device is a {motion}.{lever}")
    return value * unit.factor


def device_of(text: str) -> Device:
    """Return a device by its name or file."""
    from pipeline.device_data.devices import load_device, read_device

    return read_device(Path(text)) if text.endswith(".toml") else load_device(text)


def reports_folder() -> Path:
    """Return the folder of reports of a command without `Reports`."""
    return Path(os.environ.get(REPORTS, "reports"))

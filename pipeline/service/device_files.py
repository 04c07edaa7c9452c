"""Device files of the lab (TOML). From the next comparison on, they take precedence over shipped files with the same
name."""

from __future__ import annotations

import os
from pathlib import Path

from pipeline.base.disk import make_folder, write_text
from pipeline.base.errors import DeviceError
from pipeline.base.provenance import USER_FOLDER_VARIABLE, user_device_folder
from pipeline.device_data.devices import device_file, read_device
from pipeline.records.results import ComparisonResult
from pipeline.service.problems import Problem
from pipeline.service.settings import Settings
from pipeline.store.names import folder_name


def use_folder(settings: Settings) -> None:
    """Set the folder of device files to a folder in the data of the service, if the environment names no folder.

    Workers inherit it.
    """
    if user_device_folder() is None and not settings.read_only:
        make_folder(settings.data / "devices")
        os.environ[USER_FOLDER_VARIABLE] = str(settings.data / "devices")


def text_of(name: str) -> str:
    """Return the TOML of a known device.

    Raises
    ------
    Problem
        If no file describes the device.
    """
    file = device_file(name)
    if file is None:
        raise Problem(404, "No file describes this device. Upload one.", where="device", found=name)
    return file.read_text("utf-8")


def is_of_the_lab(name: str) -> bool:
    """Return True if a device has a file of the lab. Such a file can be removed."""
    own, file = user_device_folder(), device_file(name)
    return own is not None and file is not None and file.parent == own


def keep(name: str, text: str) -> Path:
    """Check a device file, store it in place of an earlier one, and return its path.

    Raises
    ------
    Problem
        If the file is invalid (each wrong field is named) or describes a different device, or if there is no folder for
        device files.
    """
    folder = user_device_folder()
    if folder is None:
        raise Problem(
            409,
            f"The server has no folder for device files. Set {USER_FOLDER_VARIABLE} to a folder, and restart the "
            "server.",
        )
    trial = folder / f".{folder_name(name)}.checked"
    write_text(trial, text)
    try:
        found = read_device(trial).name
    except DeviceError as error:
        raise Problem(422, str(error).replace(str(trial), "the device file"), where="file") from error
    finally:
        trial.unlink(missing_ok=True)
    if found != name:
        raise Problem(422, "The file describes a different device.", where="name", expected=name, found=found)
    file = device_file(name) if is_of_the_lab(name) else None
    target = file or folder / f"{folder_name(name)}.toml"
    write_text(target, text)
    return target


def remove(name: str) -> None:
    """Remove the lab's file of a device. A shipped file with the same name is then used again.

    Raises
    ------
    Problem
        If the lab has no such file.
    """
    file = device_file(name)
    if file is None or not is_of_the_lab(name):
        raise Problem(404, "The lab has no file of this device.", where="device", found=name)
    file.unlink()


def draft(name: str, result: ComparisonResult | None) -> str:
    """Return a draft of a device file. Mass, damping and delay are those identified from the logs, if the logs were
    compared."""
    lines = [f'name = "{name}"', f'motion = "{result.motion if result else "translation"}"']
    first = result.experiments[0] if result else None
    lines.append(f"sampling_period_s = {first.sampling_period_s if first and first.sampling_period_s else 0.001}")
    for each in result.experiments if result else ():
        lines += ["", "[[experiment]]", f'name = "{each.experiment}"']
        loop = each.loop
        for key in ("mass", "damping", "delay_samples") if loop else ():
            found = getattr(loop, key)
            lines.append(f"{key} = {found.value}" if found is not None else f"# {key} = ")
    return "\n".join(lines) + "\n"

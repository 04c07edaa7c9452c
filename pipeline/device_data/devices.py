"""Access to device files (TOML), which ship with the package or are in a folder of the user.

Each file describes a `pipeline.records.models.Device`. Files in ``schemas/devices`` ship with the package. The
environment variable ``PIPELINE_DEVICES`` names a folder with further files. They take precedence over shipped files
that define the same device name.
"""

from __future__ import annotations

import json
import tomllib
from difflib import get_close_matches
from pathlib import Path

from pydantic import ValidationError

from pipeline.base.errors import DeviceError
from pipeline.base.json_object import JsonObject
from pipeline.base.provenance import USER_FOLDER_VARIABLE, digest, schema_folder, user_device_folder
from pipeline.device.parts import LARGEST, SMALLEST
from pipeline.records.models import STATED, Device, Experiment

_FORMER_FILTER = (
    "velocity_filter_s has been replaced: write the filter into [loop], as velocity = "
    '{ kind = "butterworth", order = 1, cutoff_hz = ... }, with cutoff_hz = 1/(2 pi velocity_filter_s); '
    "leave out [controller], and also [loop] if there is no filter"
)
SAMPLES, SAMPLES_OF_REST = 1000, 20
"""Default duration of a simulated trial, and default duration of the rest before its step [samples]."""

FORMER_KEYS = dict.fromkeys(("controller", "velocity_filter_s"), _FORMER_FILTER)
"""Hints for keys in device files of earlier versions."""


def known_devices() -> dict[str, Device]:
    """Return all known devices, sorted by name. A device of the user replaces a shipped device with the same name.

    Raises
    ------
    DeviceError
        If a device file is invalid, if two files of one folder define the same name, or if the folder in
        ``PIPELINE_DEVICES`` does not exist. Other TOML files in the folder are ignored.
    """
    devices = _read_folder(schema_folder() / "devices")
    folder = user_device_folder()
    if folder is not None:
        if not folder.is_dir():
            raise DeviceError(
                f"{folder}: {USER_FOLDER_VARIABLE} must name a folder with device files (*.toml), "
                "but this is not a folder. Create the folder or unset the variable."
            )
        devices |= _read_folder(folder)
    return dict(sorted(devices.items()))


def digest_of(device: Device) -> str:
    """Return a hash of the content of a device file.

    Keys that later versions of the package add do not change the hash.
    """
    return digest(device.model_dump(mode="json", exclude_defaults=True))


def device_file(name: str) -> Path | None:
    """Return the file of a known device, or None if the device is unknown. A user's file takes precedence over a
    shipped file.

    Raises
    ------
    DeviceError
        If a device file is invalid.
    """
    for folder in filter(None, (user_device_folder(), schema_folder() / "devices")):
        for path in _files(folder):
            if read_device(path).name == name:
                return path
    return None


def declared_spring(device: Device | None, experiment: str) -> float:
    """Return the stiffness k of the device's spring as given in its file, per unit of command [N/m, Nm/rad].

    The spring shifts the final position to x_0 + F_0/(K + k). The stiffness k includes that of the operator. The result
    is 0 if the device is unknown or its file does not contain the experiment.
    """
    entry = next((e for e in device.experiments if e.name == experiment), None) if device else None
    return 0.0 if device is None or entry is None else device.loop_for(entry).apparent().stiffness


def load_device(name: str) -> Device:
    """Return a known device by name.

    Raises
    ------
    DeviceError
        If the device is unknown. The message lists the known devices.
    """
    devices = known_devices()
    if name in devices:
        return devices[name]
    meant = "".join(f" Did you mean {near}?" for near in get_close_matches(name.lower(), devices, 1))
    unknown = f"device {name!r} is not known; known devices are {', '.join(devices)}.{meant}"
    own = user_device_folder()
    if own is not None and (file := own / f"{name}.toml").is_file():
        # a copied file still contains the name of the original device
        raise DeviceError(
            f"{unknown} {file}: field name: found {read_device(file).name!r}, expected {name!r}; correct it there."
        )
    raise DeviceError(
        f"{unknown} Put a device file (.toml) with name = {json.dumps(name)} into a folder, and name that folder in "
        f"{USER_FOLDER_VARIABLE}."
    )


def find_experiment(device: Device, name: str | None) -> Experiment:
    """Return an experiment of a device by name. Without a name, return the first experiment.

    Raises
    ------
    DeviceError
        If the device has no such experiment. The message lists its experiments.
    """
    for experiment in device.experiments:
        if not name or experiment.name == name:
            return experiment
    raise DeviceError(
        f"device {device.name!r} has no experiment {name!r}; it has {', '.join(e.name for e in device.experiments)}."
    )


def read_device(path: Path) -> Device:
    """Read a device file.

    Parameters
    ----------
    path : Path
        TOML file with the fields of `pipeline.records.models.Device`. Experiments are ``[[experiment]]`` tables, and
        published tables are ``[[table]]`` tables. Strings and booleans are not accepted as numbers.
        ``sampling_period_s`` is required, and each experiment requires ``mass`` and ``delay_samples``. A device with
        only one experiment may state them at the top level.

    Raises
    ------
    DeviceError
        If the file cannot be read or is not TOML, or if a field is missing, unknown or out of range. The message
        lists every invalid field with the value found and the reason.
    """
    try:
        data = _completed(tomllib.loads(path.read_text(encoding="utf-8")), path.stem)
    except OSError as error:
        raise DeviceError(f"{path}: device file cannot be read ({error.strerror or error}).") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DeviceError(f"{path}: device file is not valid TOML in UTF-8: {error}.") from error
    try:
        # The data are validated as JSON. Strict validation then refuses mass = "0.58" and mass = true, but accepts
        # arrays as tuples.
        return Device.model_validate_json(json.dumps(data, default=str), strict=True, context=STATED)
    except ValidationError as error:
        details = error.errors(include_url=False)
        places = [detail["loc"] for detail in details]
        # pydantic also reports a list as too short if it refused all entries of the list
        found = [
            _describe(dict(detail), data)
            for detail in details
            if detail["type"] != "too_short"
            or not any(
                len(place) > len(detail["loc"]) and place[: len(detail["loc"])] == detail["loc"] for place in places
            )
        ]
        if {"format", "columns"} <= data.keys():
            raise DeviceError(
                f"{path}: this file is a profile of logs, not a device file. Give it to --profile. "
                "`pipeline identify` writes a device file."
            ) from error
        raise DeviceError(
            f"{path}: invalid device file, {len(found)} field(s) to correct:\n" + "\n".join(found)
        ) from error


def _completed(data: JsonObject, name: str) -> JsonObject:
    """Add defaults to the contents of a device file."""
    full = {"name": name, **data}
    full = {"title": full["name"], **full}
    if "experiment" not in full:
        own = [key for key in Experiment.model_fields if key in full and key not in Device.model_fields]
        full["experiment"] = [{"name": "1", **{key: full.pop(key) for key in own}}]
    period = full.get("sampling_period_s")
    # TOML reads 1 as an integer. An invalid period is reported under its own key, not under keys derived from it.
    unit = 1.0
    if isinstance(period, (int, float)) and not isinstance(period, bool) and SMALLEST <= period <= LARGEST / SAMPLES:
        unit = period
    full = {"duration_s": SAMPLES * unit, "baseline_s": SAMPLES_OF_REST * unit, **full}
    return full


def _read_folder(folder: Path) -> dict[str, Device]:
    devices: dict[str, Device] = {}
    origin: dict[str, Path] = {}
    for path in _files(folder):
        device = read_device(path)
        if device.name in devices:
            raise DeviceError(
                f"{path}: field name: found {device.name!r}, which {origin[device.name].name} also defines; "
                "give each device a unique name."
            )
        devices[device.name], origin[device.name] = device, path
    return devices


_OF_DEVICES = frozenset({"experiment", "mass", "damping", "delay_samples", "sampling_period_s", "loop"})
_OF_PROFILES = frozenset({"format", "files", "columns"})
"""Keys that only device files contain, and keys that device files never contain."""


def _files(folder: Path) -> list[Path]:
    """Return the device files of a folder. Other TOML files, such as profiles or settings, are skipped."""
    return [path for path in sorted(folder.glob("*.toml")) if not _is_other(path)]


def _is_other(path: Path) -> bool:
    """Return True if a file is not a device file. An unreadable file is reported later by `read_device`."""
    try:
        keys = tomllib.loads(path.read_text(encoding="utf-8")).keys()
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError):
        return False
    return bool(keys) and (keys.isdisjoint(_OF_DEVICES) or not keys.isdisjoint(_OF_PROFILES))


def _describe(detail: JsonObject, data: JsonObject) -> str:
    """Describe an invalid field in one line that states its path in the file, the value found and the reason."""
    location = detail["loc"]
    field = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    message = detail["msg"].removeprefix("Value error, ")
    if detail["type"] == "extra_forbidden" and location[-1] in FORMER_KEYS:
        return f"  {field}: {FORMER_KEYS[location[-1]]}"
    if detail["type"] == "missing":
        return f"  {field}{_owner(location, data)}: found nothing; field required"
    if not isinstance(detail["input"], dict | list):
        return f"  {field}{_owner(location, data)}: found {detail['input']!r}; {message}"
    return f"  {field or 'entire file'}{_owner(location, data)}: {message}"


def _owner(location: tuple[int | str, ...], data: JsonObject) -> str:
    """Return the name of the experiment or table that contains an invalid field, if the field is in one."""
    if len(location) < 2 or not isinstance(location[1], int):
        return ""
    entry = data[str(location[0])][location[1]]
    name = entry.get("name") if isinstance(entry, dict) else None
    return f" ({location[0]} {name!r})" if name is not None else ""

"""Device files of loops, written by hand: what `read_device` makes of one is the loop again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pipeline.device.loop import Loop
from pipeline.device.parts import Part

NUMBERS = ("mass", "damping", "stiffness", "sampling_period_s", "delay_samples")


def device_text(loop: Loop, **more: Any) -> str:
    """Return the device file of a loop; ``more`` is put at its top."""
    top = {name: getattr(loop, name) for name in NUMBERS} | {"motion": loop.motion, **more}
    if loop.jitter_samples:
        top["jitter_samples"] = list(loop.jitter_samples)
    tables: dict[str, dict[str, Any]] = {
        "loop": {"force_gain": loop.force_gain, "actuator_lag_s": loop.actuator_lag_s},
        **{f"loop.{name}": _of_part(getattr(loop, name)) for name in ("velocity", "mode", "operator", "friction")},
        "sensor": _of_part(loop.sensor),
        "limits": {} if loop.force_limit is None else {"force": loop.force_limit},
        "simulation": {} if loop.constant_force == 0 else {"constant_force": loop.constant_force},
    }
    lines = [_line(*item) for item in top.items()]
    for name, entries in tables.items():
        if entries:
            lines += [f"[{name}]", *(_line(*item) for item in entries.items())]
    return "\n".join(lines) + "\n"


def written(folder: Path, loop: Loop, **more: Any) -> Path:
    """Write the device file ``arm.toml`` of a loop."""
    path = folder / "arm.toml"
    path.write_text(device_text(loop, **more), encoding="utf-8")
    return path


def _of_part(part: Part | None) -> dict[str, Any]:
    return {} if part is None else part.model_dump(exclude_none=True)


def _line(name: str, value: Any) -> str:
    return f"{name} = {json.dumps(value)}"

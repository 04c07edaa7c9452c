"""What the modules of each folder of the package may import."""

from __future__ import annotations

DIRECTLY: dict[str, tuple[str, ...]] = {
    "base": (),
    "device": ("base",),
    "records": ("device",),
    "device_data": ("records",),
    "profiles": ("records",),
    "recording": ("records",),
    "readers": ("profiles", "recording"),
    "store": ("records",),
    "intake": ("readers", "store", "device_data"),
    "loop": ("records",),
    "measured": ("loop", "store", "recording"),
    "theory": ("loop",),
    "simulation": ("device_data", "store", "theory"),
    "explorer": ("records",),
    "rendering": ("theory", "explorer"),
    "planning": ("measured", "simulation"),
    "comparison": ("profiles", "rendering", "planning", "simulation"),
    "surface": ("intake", "simulation", "comparison"),
    "rig": ("surface",),
    # they hold estimators against simulated truth, whose exact costs and limits are those of theory
    "studies": ("measured", "theory", "simulation", "rendering"),
}
"""Folders that the modules of a folder may import from, as in docs/architecture.md; and all that these may."""

DIRECTLY["service"] = tuple(DIRECTLY)
DIRECTLY["shell"] = tuple(DIRECTLY)


def lower(folder: str) -> set[str]:
    return {folder}.union(*(lower(other) for other in DIRECTLY[folder]))


MAY_IMPORT = {folder: lower(folder) for folder in DIRECTLY}

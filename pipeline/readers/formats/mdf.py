"""MDF 3 and 4 files (dSPACE, CANape, INCA): channels as ``0/name`` by the number of their group, time ``0/@time``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from asammdf import MDF

from pipeline.profiles.profile_model import Profile
from pipeline.readers.frame import Contents


def read(path: Path, settings: Profile, contents: Contents) -> None:
    """Add the channels of all groups, with their units; times are in seconds from the start of the measurement."""
    with MDF(path) as file:
        groups: Any = file.groups
        for number, group in enumerate(groups):
            time = f"{number}/@time"
            if contents.asks(time):
                contents.add(time, file.get_master(number), "s", "s")
            master = file.masters_db.get(number)
            for index, channel in enumerate(group.channels):
                name = f"{number}/{channel.name}"
                if index != master and contents.asks(name):
                    signal = file.get(group=number, index=index)
                    contents.add(name, signal.samples, signal.unit or "")

"""Recommendation of the next walls of an experiment, as printed by `pipeline plan`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.planning.campaign import plan_options
from pipeline.planning.planner import Plan
from pipeline.planning.planner import plan as plan_stored
from pipeline.surface.logs import PathLike


def plan(
    device: PathLike,
    processed: PathLike = "processed",
    experiment: str | None = None,
    *,
    goal: str = "boundary",
    count: int = 1,
    dampings: Sequence[float] = (),
    gentle: bool = False,
    limits: Mapping[str, float] | None = None,
) -> Plan:
    """Recommend the next walls to test, and state whether the limits are known, as `pipeline plan` does.

    Parameters
    ----------
    device : str or path
        Device name as in the logs, or a device file (.toml).
    processed : path
        Folder of the stored tables. Without stored trials, the device file determines the initial range. The
        recommended walls are stored in the folder, so that the next plan can compare them with the walls that the rig
        used.
    experiment : str, optional
        By default, the only stored experiment. Without stored trials, the first experiment of the device file.
    goal : str
        ``boundary``, ``optimum`` (the best wall by settle_2pct), or the name of a criterion.
    count : int
        Number of walls to recommend.
    dampings : sequence of float
        B at which the limits are to be found [Ns/m, Nms/rad]. The default is a set that covers the range.
    gentle : bool
        True to prefer stable walls, and to approach limits from below.
    limits : mapping, optional
        Bounds of the recommended walls: ``stiffness`` [N/m, Nm/rad], ``damping`` [Ns/m, Nms/rad], ``force`` [N, Nm] of
        the command, ``travel`` [m, rad] of the start from the centre.

    Returns
    -------
    Plan
        ``next`` (walls with ``stiffness``, ``damping``, ``expected`` and ``why``), ``done``, ``boundary`` (limits found
        so far, with ``damping``, ``estimate``, ``low`` and ``high``), ``trials_used``, ``trials_expected``,
        ``remarks``, ``optimum``, ``left_out``. ``model_dump()`` returns plain values, `print` shows a summary.

    Raises
    ------
    DeviceError
        If neither a device file nor a log provides an initial range, or the experiment is unknown.
    UsageError
        If several experiments are stored and none is named, the bounds exclude every wall, or an argument is invalid.

    Examples
    --------
    >>> first = plan("falcon", "nowhere", "1").next[0]
    >>> first.expected, first.stiffness > 0
    ('undecided', True)
    """
    options = plan_options(goal, count, dampings, gentle, limits or {})
    return plan_stored(os.fspath(device), Path(processed), experiment, options, remembered=True)

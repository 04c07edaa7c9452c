"""The next walls of an experiment, as `pipeline plan` names them."""

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
    """Return which walls to try next, and whether the limits are known, as `pipeline plan` does.

    Parameters
    ----------
    device : str or path
        Name as in the logs, or a device file (.toml).
    processed : path
        Folder of the stored tables; without trials in it, the device file gives the range to start from. The named
        walls are stored there, so that the next plan can compare them with those that the rig set.
    experiment : str, optional
        By default the only stored one, otherwise the first of the device file.
    goal : str
        ``boundary``, ``optimum`` (the best wall by settle_2pct), or a criterion.
    count : int
        Number of walls to name at once.
    dampings : sequence of float
        B at which limits are wanted [Ns/m, Nms/rad]; by default some over the range.
    gentle : bool
        Whether to prefer stable walls and approach limits from below.
    limits : mapping, optional
        Bounds on what is tried: ``stiffness`` [N/m, Nm/rad], ``damping`` [Ns/m, Nms/rad], ``force`` [N, Nm] of the
        command, ``travel`` [m, rad] of the start from the centre.

    Returns
    -------
    Plan
        ``next`` (walls with ``stiffness``, ``damping``, ``expected`` and ``why``), ``done``, ``boundary`` (limits so
        far with ``damping``, ``estimate``, ``low`` and ``high``), ``trials_used``, ``trials_expected``, ``remarks``,
        ``optimum``, ``left_out``; ``model_dump()`` gives plain values, `print` a summary.

    Raises
    ------
    DeviceError
        If neither a device file nor a log gives a range to start from, or the experiment is unknown.
    UsageError
        If several experiments are stored and none is named, a bound leaves no wall to try, or an argument is wrong.

    Examples
    --------
    >>> first = plan("falcon", "nowhere", "1").next[0]
    >>> first.expected, first.stiffness > 0
    ('undecided', True)
    """
    options = plan_options(goal, count, dampings, gentle, limits or {})
    return plan_stored(os.fspath(device), Path(processed), experiment, options, remembered=True)

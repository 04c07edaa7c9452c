"""Interpolate missing or repeated rows of a log, so that each row is a sample of the sampling grid.

Settling times and energies count or sum samples. Without the grid, they would count or sum rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.measured.wall_command.log_rows import LogRows
from pipeline.measured.wall_command.stamps import ODD, read_stamps
from pipeline.measured.wall_command.wall_law import WallLaw
from pipeline.records.trials import Booleans, Floats, Integers, Trial

LONGEST_GAP = 8
"""Largest number of consecutive missing rows that are interpolated: a quarter of a period of the fastest walls."""

MOST_MISSING = 0.1
"""Largest share of interpolated samples."""

LARGEST_UNEXPLAINED = 0.005
"""Largest error of changes that no repeated or missing row explains, relative to the total distance."""


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """A trial with one row for each sample.

    Parameters
    ----------
    trial, response : Trial, Response
        The trial on its grid, interpolated by cubics. It is the trial itself if no row is missing or repeated. If the
        samples cannot be counted, it is also unchanged, the response has no edge, and its ``edge_reason`` is the
        reason.
    straight : Trial, optional
        The trial on its grid with linear interpolation. The difference between both trials bounds the interpolation
        error. None if nothing is interpolated.
    """

    trial: Trial
    response: Response
    straight: Trial | None = None


def sample_grid(trial: Trial, response: Response, law: WallLaw) -> SampleGrid:
    """Return a trial on the grid of its sampling period.

    Parameters
    ----------
    trial : Trial
    response, law : Response, WallLaw
        Response and wall law of the same trial.

    Notes
    -----
    Missing rows are found from the time stamps (`stamps`) or from the wall law. If only the wall law shows them, they
    cannot be counted reliably, and the trial has no edge. A row that repeats the previous row, or its reading, is
    replaced by an interpolated sample.
    """
    account, edge = law.account, response.edge_row
    seen, hidden = np.ones(trial.rows, dtype=np.bool_), 0
    if account is not None and edge > 0:
        skipped = account.stamps.skipped
        seen[account.repeated] = False
        if not skipped.any():
            hidden = account.lost if account.departures is not None else _unexplained(account.log, seen)
    elif (np.abs(np.diff(trial.time) / trial.sampling_period_s - 1) > ODD).any():
        skipped = read_stamps(trial.time, trial.sampling_period_s).skipped
    else:
        return SampleGrid(trial, response)
    index = np.append(0, np.cumsum(skipped + 1))
    filled = int(index[-1] + 1 - seen.sum())
    if reason := _refused(index, edge, filled, hidden):
        return SampleGrid(trial, replace(response, edge_row=NO_ROW, edge_reason=reason))
    if not filled:
        return SampleGrid(trial, response)
    moved = replace(response, edge_row=int(index[edge]) if edge >= 0 else NO_ROW)
    straight, curved = (_interpolated(trial, index, seen, cubic=cubic) for cubic in (False, True))
    return SampleGrid(curved, moved, straight)


def _unexplained(log: LogRows, seen: Booleans) -> int:
    """Return the number of rows that neither the wall law nor a repeated row explains, or 0 if no row is repeated.

    The residual of such a row is the damping force due to the error of its change. Errors that are a small share of the
    total distance are ignored.
    """
    if seen.all():
        return 0
    off = np.abs(log.residual) > log.rounding
    repeated = ~seen
    repeated[1:] |= ~seen[:-1]
    off &= ~repeated & log.after
    wrong = np.abs(log.residual[off]).sum() * log.period
    return int(off.sum()) if wrong > LARGEST_UNEXPLAINED * log.damping * np.abs(log.change).sum() else 0


def _refused(index: Integers, edge: int, filled: int, hidden: int) -> str:
    """Return the reason why the samples of a trial cannot be counted. The result is empty if they can be counted."""
    if hidden:
        return f"{hidden} missing or repeated rows are not visible in the stamps, so samples cannot be counted"
    longest = int(np.diff(index).max(initial=1)) - 1
    if longest > LONGEST_GAP or filled > MOST_MISSING * (index[-1] + 1):
        return f"{filled} of {index[-1] + 1} rows are missing, up to {longest} in succession: too many to interpolate"
    if edge > 0 and index[edge] - index[edge - 1] > 1:
        return "rows are missing just before the step, so the sample in which the step begins is unknown"
    return ""


def _interpolated(trial: Trial, index: Integers, seen: Booleans, *, cubic: bool) -> Trial:
    """Return a trial with one row per sample. ``index`` and ``seen`` mark the samples with readings."""
    from scipy.interpolate import make_interp_spline

    samples, read = np.arange(index[-1] + 1), index[seen]

    def line(values: Floats) -> Floats:
        return np.interp(samples, read, values[seen])

    position = make_interp_spline(read, trial.position[seen])(samples) if cubic else line(trial.position)
    command, time = line(trial.command), line(trial.time)
    return replace(trial, time=time, command=command, position=position, force=None, velocity=None, step_row=None)

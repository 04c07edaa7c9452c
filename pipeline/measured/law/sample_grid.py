"""Logs on the grid of their sampling period: rows that are missing or repeated are interpolated: a row is a sample.

What counts samples or sums them (settling times, energies) would otherwise count rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.law.log_rows import LogRows
from pipeline.measured.law.stamps import ODD, read_stamps
from pipeline.measured.law.wall_law import WallLaw
from pipeline.measured.signal.response import NO_ROW, Response
from pipeline.records.batch import Booleans, Integers, TrialBatch

LONGEST_GAP = 8
"""Missing rows in a row beyond which a motion is not interpolated: a quarter of a period of the fastest walls."""

MOST_MISSING = 0.1
"""Largest share of samples that are interpolated."""

LARGEST_UNTOLD = 0.005
"""Part of the way of a device, there and back, that changes may be wrong by without a row that explains it."""


@dataclass(frozen=True, eq=False)
class SampleGrid:
    """Trials with a row for every sample, and where it is interpolated.

    Parameters
    ----------
    batch, response : TrialBatch, Response
        Trials on their grid, interpolated by cubics. A trial whose samples cannot be counted has no edge, and its
        ``edge_reason`` says why.
    straight : TrialBatch
        The same interpolated by straight lines: between both lies what interpolation leaves open, and more.
    filled : int64, shape (n,)
        Number of samples that are interpolated.
    """

    batch: TrialBatch
    response: Response
    straight: TrialBatch
    filled: Integers


def sample_grid(batch: TrialBatch, response: Response, law: WallLaw) -> SampleGrid:
    """Return trials on the grid of their sampling period.

    Parameters
    ----------
    batch : TrialBatch
    response, law : Response, WallLaw
        Of the same trials.

    Notes
    -----
    Rows are missing where stamps count them (`stamps`), or where the wall law shows it; those that only the law
    shows are not counted reliably, and such a trial has no edge any more. A row that repeats the one before, or a
    reading that was held, stands for a sample that is interpolated. Trials of which no row is in doubt are returned as
    they are.
    """
    with np.errstate(invalid="ignore"):
        odd = np.abs(np.diff(batch.time, axis=1) / batch.sampling_period_s[:, None] - 1) > ODD
    filled, reason, trials = np.zeros(len(batch), dtype=np.int64), {}, {}
    for i, of in enumerate(law.accounts):
        rows, edge = int(batch.rows[i]), int(response.edge_row[i])
        seen, hidden = np.ones(rows, dtype=np.bool_), 0
        if of is not None and edge > 0:
            skipped = of.stamps.skipped
            seen[of.repeated] = False
            hidden = 0 if skipped.any() else of.lost if of.departures is not None else _untold(of.log, seen)
        elif odd[i].any():
            skipped = read_stamps(batch.time[i, :rows], float(batch.sampling_period_s[i])).skipped
        else:
            continue
        index = np.concatenate([[0], np.cumsum(skipped + 1)])
        filled[i] = index[-1] + 1 - seen.sum()
        reason[i] = _refused(index, edge, int(filled[i]), hidden)
        trials[i] = index, seen
    if not filled.any() and not any(reason.values()):
        return SampleGrid(batch, response, batch, filled)
    edges = response.edge_row.copy()
    for i, (index, _) in trials.items():
        edges[i] = NO_ROW if reason[i] or edges[i] < 0 else index[edges[i]]
    text = tuple(reason.get(i) or old for i, old in enumerate(response.edge_reason))
    moved = replace(response, edge_row=edges, edge_reason=text)
    return SampleGrid(_placed(batch, trials, straight=False), moved, _placed(batch, trials, straight=True), filled)


def _untold(log: LogRows, seen: Booleans) -> int:
    """Number of rows off the wall law that no repeated row explains, where there are some.

    The residual of such a row is the damping force of the way that its change is wrong by: a small part of all of the
    way counts as none.
    """
    if seen.all():
        return 0
    off = np.abs(log.residual) > log.rounding
    repeated = ~seen
    repeated[1:] |= ~seen[:-1]
    off &= ~repeated & log.after
    wrong = np.abs(log.residual[off]).sum() * log.period
    return int(off.sum()) if wrong > LARGEST_UNTOLD * log.damping * np.abs(log.change).sum() else 0


def _refused(index: Integers, edge: int, filled: int, hidden: int) -> str:
    """Why the samples of a trial cannot be counted; empty where they can."""
    if hidden:
        return f"{hidden} rows are missing or repeated where the stamps do not show it: samples cannot be counted"
    longest = int(np.diff(index).max(initial=1)) - 1
    if longest > LONGEST_GAP or filled > MOST_MISSING * (index[-1] + 1):
        return f"{filled} of {index[-1] + 1} rows are missing, {longest} of them in a row, too many to interpolate"
    if edge > 0 and index[edge] - index[edge - 1] > 1:
        return "rows are missing just before the step, so that the sample in which it begins is not known"
    return ""


def _placed(batch: TrialBatch, trials: dict[int, tuple[Integers, Booleans]], straight: bool) -> TrialBatch:
    """Return the trials with a row for every sample; those that are not named stay as they are."""
    from scipy.interpolate import make_interp_spline

    rows = batch.rows.copy()
    for i, (index, _) in trials.items():
        rows[i] = index[-1] + 1
    columns = max(batch.position.shape[1], int(rows.max(initial=0)))
    wide = {}
    for name in ("time", "command", "position"):
        values = np.full((len(batch), columns), np.nan)
        values[:, : batch.position.shape[1]] = getattr(batch, name)
        for i, (index, seen) in trials.items():
            own, all_rows = getattr(batch, name)[i, : len(index)][seen], np.arange(rows[i])
            line = straight or name != "position" or len(own) == rows[i]
            at = np.interp(all_rows, index[seen], own) if line else make_interp_spline(index[seen], own)(all_rows)
            values[i, : rows[i]] = at
        wide[name] = values
    return replace(batch, rows=rows, force=None, velocity=None, step_row=None, **wide)  # type: ignore[arg-type]

"""Logs on the grid of their sampling period: rows that are missing or repeated are interpolated: a row is a sample.

What counts samples or sums them (settling times, energies) would otherwise count rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.law.log_rows import LogRows
from pipeline.measured.law.lost_rows import STILL_FLOORS
from pipeline.measured.law.stamps import ODD, read_stamps
from pipeline.measured.law.wall_law import account
from pipeline.measured.signal.response import NO_ROW, Response, external_force
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

LONGEST_GAP = 8
"""Missing rows in a row beyond which a motion is not interpolated: a quarter of a period of the fastest walls."""

MOST_MISSING = 0.1
"""Largest share of samples that are interpolated."""

LARGEST_UNTOLD = 0.005
"""Part of the way of a device, there and back, that changes may be wrong by without a row that explains it."""

DEPARTURE = 1e-3
"""Departure from the wall law, relative to the step, from which on a log is looked at row by row."""


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


def sample_grid(batch: TrialBatch, response: Response) -> SampleGrid:
    """Return trials on the grid of their sampling period.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
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
    suspect = np.flatnonzero(odd.any(axis=1) | _doubtful(batch, response))
    filled, reason, trials = np.zeros(len(batch), dtype=np.int64), {}, {}
    for i in suspect.tolist():
        rows = int(batch.rows[i])
        seen, hidden = np.ones(rows, dtype=np.bool_), 0
        if response.edge_row[i] > 0:
            of = account(LogRows.of(batch, response, i))
            skipped = of.stamps.skipped
            seen[of.repeated] = False
            hidden = 0 if skipped.any() else of.lost if of.departures is not None else _untold(of.log, seen)
        else:
            skipped = read_stamps(batch.time[i, :rows], float(batch.sampling_period_s[i])).skipped
        index = np.concatenate([[0], np.cumsum(skipped + 1)])
        filled[i] = index[-1] + 1 - seen.sum()
        reason[i] = _refused(index, int(response.edge_row[i]), int(filled[i]), hidden)
        trials[i] = index, seen
    if not filled.any() and not any(reason.values()):
        return SampleGrid(batch, response, batch, filled)
    edge = response.edge_row.copy()
    for i, (index, _) in trials.items():
        edge[i] = NO_ROW if reason[i] or edge[i] < 0 else index[edge[i]]
    text = tuple(reason.get(i) or old for i, old in enumerate(response.edge_reason))
    moved = replace(response, edge_row=edge, edge_reason=text)
    return SampleGrid(_placed(batch, trials, straight=False), moved, _placed(batch, trials, straight=True), filled)


def _doubtful(batch: TrialBatch, response: Response) -> Booleans:
    """Where a command departs from the wall law, or a device stands for one row while it moves before and after it."""
    after = np.arange(batch.position.shape[1])[None, :] >= response.edge_row[:, None]
    step = np.abs(batch.step)[:, None]
    off = np.abs(np.nan_to_num(external_force(batch) - after * batch.step[:, None])) > DEPARTURE * step
    change = np.abs(np.nan_to_num(np.diff(batch.position, axis=1)))
    fast = change > STILL_FLOORS * response.floor[:, None]
    stands = (change[:, 1:-1] == 0) & fast[:, 2:] & fast[:, :-2]
    result: Booleans = response.has_edge & ((off & batch.valid).any(axis=1) | stands.any(axis=1))
    return result


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
    rows = batch.rows.copy()
    for i, (index, _) in trials.items():
        rows[i] = index[-1] + 1
    columns = max(batch.position.shape[1], int(rows.max(initial=0)))
    wide = {}
    for name in ("time", "command", "position"):
        values = np.full((len(batch), columns), np.nan)
        values[:, : batch.position.shape[1]] = getattr(batch, name)
        for i, (index, seen) in trials.items():
            own = getattr(batch, name)[i, : len(index)]
            line = straight or name != "position"
            values[i, : rows[i]] = (_lines if line else _cubics)(int(rows[i]), index[seen], own[seen])
        wide[name] = values
    return replace(batch, rows=rows, force=None, velocity=None, step_row=None, **wide)  # type: ignore[arg-type]


def _lines(count: int, index: Integers, values: Floats) -> Floats:
    result: Floats = np.interp(np.arange(count), index, values)
    return result


def _cubics(count: int, index: Integers, values: Floats) -> Floats:
    """Cubic through the two samples before and the two behind each of so many places; a line at the ends."""
    result = _lines(count, index, values)
    known = np.zeros(count, dtype=np.bool_)
    known[index] = True
    missing = np.flatnonzero(~known)
    behind = np.searchsorted(index, missing)
    inner = (behind >= 2) & (behind <= len(index) - 2)
    missing, behind = missing[inner], behind[inner]
    nodes = behind[:, None] + np.arange(-2, 2)
    place, height = index[nodes].astype(np.float64), values[nodes]
    total = np.zeros(len(missing))
    for own in range(4):
        others = [other for other in range(4) if other != own]
        share = np.prod([(missing - place[:, other]) / (place[:, own] - place[:, other]) for other in others], axis=0)
        total += share * height[:, own]
    result[missing] = total
    return result

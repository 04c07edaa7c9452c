"""Compare a logged command with the wall law, and find the cause of a departure, only from the log.

The law is u_k = F_k - K (x_k - x_0) - B (x_k - x_{k-1})/T, with F_k = 0 before the edge and F_k = F_0 from the edge
onward. If the controller applies this law, the residual u + K (x - x_0) + B dx/T - F contains only rounding errors.
Otherwise, the shape of the residual shows the cause: `CANDIDATES` are compared with the command in the order of their
number of free parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.signal.response import Response, external_force
from pipeline.measured.student import ROUNDING
from pipeline.measured.wall_command.command_models import Departure, explanation, hidden
from pipeline.measured.wall_command.log_rows import (
    PLATEAU,
    ROUNDINGS,
    STILL_FLOORS,
    LogRows,
    repeated_rows,
    stands_still,
)
from pipeline.measured.wall_command.stamps import ODD, Stamps, read_stamps
from pipeline.measured.wall_command.velocity_filter import VelocityFilterFound
from pipeline.records.findings import MATTERS
from pipeline.records.trials import Booleans, Integers, Trial

PRINTED_IN_FULL = float(ROUNDINGS**2 * np.finfo(np.float64).eps)
"""Rounding error of the law, relative to its largest force, if all numbers are printed in full (see `LogRows.of`)."""


@dataclass(frozen=True, eq=False)
class WallLaw:
    """Residual of the wall law of a trial, and the reason if it exceeds rounding.

    Parameters
    ----------
    residual : float
        Largest |u + K (x - x_0) + B dx/T - F| relative to |F_0|, or NaN without a command edge.
    rounding : float
        Largest residual that rounding of the printed numbers can cause, relative to |F_0|.
    departures : tuple of Departure
        Reasons for a larger residual, the most certain reason first. The tuple is empty if the law is obeyed.
    account : Account, optional
        Explanation of the rows, if the log was examined row by row.
    """

    residual: float
    rounding: float
    departures: tuple[Departure, ...] = ()
    account: Account | None = None

    @property
    def evidence(self) -> str:
        """Evidence of all departures as one text."""
        return "; ".join(departure.evidence for departure in self.departures)

    @property
    def filter(self) -> VelocityFilterFound | None:
        """Velocity filter of the controller, or None if the log shows none."""
        return next((departure.filter for departure in self.departures if departure.filter is not None), None)

    @property
    def other_wall(self) -> Departure | None:
        """Departure with the wall or step that the command obeys instead of the stated wall or step, or None.

        Such a log contains no information on the stated wall.
        """
        others = (departure for departure in self.departures if departure.obeyed is not None)
        return next(others, None) if self.residual > MATTERS else None

    @property
    def obeyed(self) -> tuple[float, float, float]:
        """K, B and step of the other wall, or NaN if there is none."""
        other = self.other_wall
        return (np.nan, np.nan, np.nan) if other is None or other.obeyed is None else other.obeyed


def wall_law(trial: Trial, response: Response) -> WallLaw:
    """Compare the logged command of a trial with the wall law.

    Parameters
    ----------
    trial : Trial
        Trial with its time stamps as logged.
    response : Response
        Response of this trial.

    Returns
    -------
    WallLaw

    Notes
    -----
    A residual within the rounding of command, position, K and B is not a departure (`log_rows`). Logged positions on a
    decimal grid may be rounded, or may be the exact output of a sensor with that resolution. Each law is therefore
    first tried with exact positions.

    Source: Hulin 2017, eqs. 3.9 and 3.10 (wall), sec. 6.1.1 (command as logged).
    """
    if response.steps > 1:
        return WallLaw(np.nan, np.nan, (Departure("several_steps", response.edge_reason, trial.rows),))
    edge, size = response.edge_row, abs(trial.step)
    if edge < 0 or size == 0:
        return WallLaw(np.nan, np.nan)
    residuals = external_force(trial)
    rounding = PRINTED_IN_FULL * float(np.abs(residuals).max())
    residuals[edge:] -= trial.step
    residual = float(np.abs(residuals).max())
    if residual <= rounding and not _has_odd_rows(trial, response):
        return WallLaw(residual / size, rounding / size)
    log = LogRows.of(trial, response)
    rows = account(log)
    return WallLaw(residual / size, float(log.rounding.max()) / size, tuple(_departures(rows, log)), rows)


def _has_odd_rows(trial: Trial, response: Response) -> bool:
    """Return whether the stamps of a log show skipped rows, or its position is constant in single rows."""
    steps = (trial.time[1:] - trial.time[:-1]) / trial.sampling_period_s
    if (np.abs(steps - 1) > ODD).any():
        return True
    change = np.diff(trial.position, prepend=trial.position[:1])
    least = STILL_FLOORS * response.floor + ROUNDING * float(np.ptp(trial.position))
    return len(stands_still(change, response.edge_row, least)) >= PLATEAU


@dataclass(frozen=True, eq=False)
class Account:
    """Explanation of a log row by row.

    Parameters
    ----------
    log : LogRows
        Log with the period and the rows that the time stamps show.
    stamps : Stamps
    repeated : int64
        Rows that repeat the previous row or its reading.
    lost : int
        Number of rows after missing rows that the law implies, but the stamps do not show.
    departures : tuple of Departure, or None
        Departures of the law that explains all other rows, or None if no law explains them.
    """

    log: LogRows
    stamps: Stamps
    repeated: Integers
    lost: int
    departures: tuple[Departure, ...] | None


def account(log: LogRows) -> Account:
    """Explain a log by a law with all rows as logged, without repeated rows, or with lost rows."""
    stamps = read_stamps(log.time, log.period)
    log = log.without(np.append(0, stamps.skipped) > 0)
    if stamps.period != log.period and explanation(log) != ():  # without departures, the stated period is correct
        log = replace(log, period=stamps.period)
    still, repeated = repeated_rows(log)
    departures = explanation(log)
    if departures is not None:
        return Account(log, stamps, still, 0, departures)
    if len(repeated):
        departures = explanation(log.without(_with_next(repeated, len(log.command))))
        if departures is not None:
            return Account(log, stamps, repeated, 0, departures)
    departures = hidden(replace(log, kept=np.ones_like(log.kept)))
    if departures is not None:
        return Account(log, stamps, still[:0], departures[0].rows, departures)
    return Account(log, stamps, still, 0, None)


def _departures(rows: Account, log: LogRows) -> Iterator[Departure]:
    """Yield the departures from the law.

    Departures of the stamps come first, followed by departures of the rows and of the law.
    """
    if rows.departures and rows.departures[0].code == "decimated_rows":
        yield from rows.departures  # both time stamps and header may be correct
        return
    by_stamps = tuple(_by_stamps(rows.stamps, log))
    yield from by_stamps
    if rows.departures is not None:
        codes = {departure.code for departure in by_stamps}
        others = (*_repeated(log, rows.repeated), *rows.departures)
        yield from (departure for departure in others if departure.code not in codes)
        return
    log = rows.log
    off = log.kept & (np.abs(log.residual) > log.rounding)
    largest = np.abs(log.residual[log.kept]).max(initial=0.0)
    text = f"the logged command departs from the wall law by up to {largest:.3g}"
    yield Departure("unknown", f"{text}, in {int(off.sum())} of {len(off)} rows", int(off.sum()))


def _with_next(rows: Integers, count: int) -> Booleans:
    """Return the rows and their successors. A change that is too small makes the next change too large."""
    result = np.zeros(count + 1, dtype=np.bool_)
    result[rows] = result[rows + 1] = True
    return result[:count]


def _by_stamps(stamps: Stamps, log: LogRows) -> Iterator[Departure]:
    gaps = np.flatnonzero(stamps.skipped)
    if stamps.period != log.period:
        text = f"the stamps show a period of {stamps.period:.4g} s, but the header states {log.period:.4g} s"
        yield Departure("sampling_period", text, len(log.time))
    if len(gaps):
        lost = int(stamps.skipped.sum())
        yield Departure("missing_rows", f"the stamps skip {lost} rows, first after row {gaps[0]}", len(gaps))
    elif stamps.odd and stamps.scatters:
        text = f"the stamps scatter by {stamps.scatter:.2g} of a period about even stamps, and no row is missing"
        yield Departure("scattered_stamps", text, stamps.odd)


def _repeated(log: LogRows, rows: Integers) -> tuple[Departure, ...]:
    if not len(rows):
        return ()
    whole = int((log.command[rows] == log.command[rows - 1]).sum()) > len(rows) / 2
    what = "rows repeat the previous row" if whole else "readings of the position are repeated"
    text = f"{len(rows)} {what} while the device moves, first row {rows[0]}"
    return (Departure("repeated_rows", text, len(rows)),)

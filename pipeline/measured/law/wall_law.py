"""Does a logged command obey the wall law, and if not, why: seen in the log alone, before anything rests on it.

The law is u_k = F_k - K (x_k - x_0) - B (x_k - x_{k-1})/T with F_k = 0 before the edge and F_0 from it on. Of a
controller that applies it nothing but rounding is left in u + K (x - x_0) + B dx/T - F. What is left otherwise has a
shape by which its cause is known: `candidates` are held against the command in the order of what they leave free.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.measured.law.candidates import Departure, explanation, hidden
from pipeline.measured.law.log_rows import PLATEAU, ROUNDINGS, STILL_FLOORS, LogRows, repeated_rows, stands_still
from pipeline.measured.law.stamps import ODD, Stamps, read_stamps
from pipeline.measured.law.velocity_filter import VelocityFilterFound
from pipeline.measured.signal.response import Response, external_force
from pipeline.measured.student import ROUNDING
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch
from pipeline.records.findings import MATTERS

PRINTED_IN_FULL = float(ROUNDINGS**2 * np.finfo(np.float64).eps)
"""Rounding of the law relative to its largest force where all numbers are printed in full, as `LogRows.of` has it."""


@dataclass(frozen=True, eq=False)
class WallLaw:
    """Residual of the law of each trial, shape (n,), and why it is not rounding.

    Parameters
    ----------
    residual : float64
        Largest |u + K (x - x_0) + B dx/T - F| relative to |F_0|; NaN without a command edge.
    rounding : float64
        What rounding of the printed numbers leaves of it at most.
    departures : tuple of tuple of Departure
        Why it is more, most certain first; empty where the law holds.
    accounts : tuple of Account or None
        What explains the rows of each log that was looked at row by row.
    """

    residual: Floats
    rounding: Floats
    departures: tuple[tuple[Departure, ...], ...]
    accounts: tuple[Account | None, ...]

    @property
    def evidence(self) -> list[str]:
        """Evidence of the departures of each trial, as one text."""
        return ["; ".join(each.evidence for each in departures) for departures in self.departures]

    @property
    def filters(self) -> list[VelocityFilterFound | None]:
        """Velocity filter of each trial, None where its log shows none."""
        return [next((each.filter for each in shown if each.filter is not None), None) for shown in self.departures]


@dataclass(frozen=True, eq=False)
class OtherWalls:
    """Of each trial K, B and step that its command obeys, shape (n, 3), NaN where the stated ones; and this in words.

    ``reason`` is empty where the command obeys what its header states.
    """

    obeyed: Floats
    reason: tuple[str, ...]


def other_walls(law: WallLaw) -> OtherWalls:
    """Return which commands obey another wall or step than stated: nothing in K and B rests on them."""
    obeyed, reason = np.full((len(law.departures), 3), np.nan), [""] * len(law.departures)
    for i, found in enumerate(law.departures):
        other = next((each for each in found if each.obeyed is not None), None)
        if other is not None and law.residual[i] > MATTERS:
            obeyed[i], reason[i] = other.obeyed, other.evidence
    return OtherWalls(obeyed, tuple(reason))


def wall_law(batch: TrialBatch, response: Response) -> WallLaw:
    """Hold the logged command of each trial against the wall law.

    Parameters
    ----------
    batch : TrialBatch
    response : Response
        Of the same trials.

    Returns
    -------
    WallLaw

    Notes
    -----
    What the digits of command, position, K and B leave open in a row is no departure (`digits`). A quantum of a sensor
    is on a grid of decimals, too, and is what the controller saw: a law is tried with positions as they are first.

    Source: Hulin 2017, eqs. 3.9 and 3.10 (wall), sec. 6.1.1 (command as logged).
    """
    n = len(batch)
    residual, rounding = np.full(n, np.nan), np.full(n, np.nan)
    departures: list[tuple[Departure, ...]] = [()] * n
    accounts: list[Account | None] = [None] * n
    for place, some in batch.portions():
        of, external = response.select(place), external_force(some)
        seen = of.has_edge & (some.step != 0)
        size = np.abs(np.where(seen, some.step, np.nan))
        off, least = _largest_residual(some, of, external)
        residual[place], rounding[place] = off / size, least / size
        for i in np.flatnonzero(seen & ((off > least) | _odd_rows(some, of))):
            log = LogRows.of(some, of, int(i))
            rounding[place.start + i] = log.rounding.max() / size[i]
            accounts[place.start + i] = of_rows = account(log)
            departures[place.start + i] = tuple(_departures(of_rows, log))
    for i in np.flatnonzero(response.steps > 1):
        found = Departure("several_steps", response.edge_reason[i], int(batch.rows[i]))
        departures[i] = (found,)
    return WallLaw(residual, rounding, tuple(departures), tuple(accounts))


def _largest_residual(batch: TrialBatch, response: Response, external: Floats) -> tuple[Floats, Floats]:
    """Return the largest residual of each log, and what rounding leaves of it where all is printed in full [N, Nm]."""
    after = np.arange(external.shape[1]) >= response.edge_row[:, None]
    off = np.abs(external - batch.step[:, None] * after)
    return np.fmax.reduce(off, axis=1), PRINTED_IN_FULL * np.fmax.reduce(np.abs(external), axis=1)


def _odd_rows(batch: TrialBatch, response: Response) -> Booleans:
    """Return which logs skip rows by their stamps, or stand still in single rows, shape (n,)."""
    steps = np.diff(batch.time, axis=1) / batch.sampling_period_s[:, None]
    odd: Booleans = np.any(np.abs(steps - 1) > ODD, axis=1, keepdims=True)[:, 0]
    change = np.diff(batch.position, axis=1, prepend=batch.position[:, :1])
    # most logs of a device that is read exactly never stand still after the step
    after = np.arange(change.shape[1]) >= response.edge_row[:, None]
    some = np.flatnonzero(((change == 0) & after).any(axis=1))
    span = np.fmax.reduce(batch.position[some], axis=1) - np.fmin.reduce(batch.position[some], axis=1)
    still = stands_still(change[some], after[some], (STILL_FLOORS * response.floor[some] + ROUNDING * span)[:, None])
    odd[some] |= still.sum(axis=1) >= PLATEAU
    return odd


@dataclass(frozen=True, eq=False)
class Account:
    """What explains a log, row by row.

    Parameters
    ----------
    log : LogRows
        With the period and the rows that the stamps show.
    stamps : Stamps
    repeated : int64
        Rows that repeat the one before, or hold its reading.
    lost : int
        Rows before which others are missing by the law, which the stamps do not show.
    departures : tuple of Departure, or None
        Of the law that explains all other rows; None where no law does.
    """

    log: LogRows
    stamps: Stamps
    repeated: Integers
    lost: int
    departures: tuple[Departure, ...] | None


def account(log: LogRows) -> Account:
    """Return what explains a log: a law with its rows as they are, then without repeated or with lost ones."""
    stamps = read_stamps(log.time, log.period)
    log = log.without(np.append(0, stamps.skipped) > 0)
    if stamps.period != log.period and explanation(log) != ():  # else the control keeps the time of the header
        log = replace(log, period=stamps.period)
    held, repeats = repeated_rows(log, by_law=False), repeated_rows(log)
    found = explanation(log)
    if found is None and len(repeats):
        found = explanation(log.without(_beside(repeats, len(log.command))))
        held = held if found is None else repeats
    if found is not None:
        return Account(log, stamps, held, 0, found)
    found = hidden(replace(log, kept=np.ones_like(log.kept)))
    return Account(log, stamps, held[: 0 if found else None], found[0].rows if found else 0, found)


def _departures(of: Account, log: LogRows) -> Iterator[Departure]:
    """Yield what departs from the law: what the stamps show, then the rows and the law that explain the command."""
    if of.departures and of.departures[0].code == "decimated_rows":
        yield from of.departures  # stamps and header may both be right
        return
    yield from (told := [*_by_stamps(of.stamps, log)])
    codes = {each.code for each in told}
    if of.departures is not None:
        yield from (each for each in (*_repeated(log, of.repeated), *of.departures) if each.code not in codes)
        return
    off = of.log.kept & (np.abs(of.log.residual) > of.log.rounding)
    largest = np.abs(of.log.residual[of.log.kept]).max(initial=0.0)
    text = f"the logged command departs from the wall law by up to {largest:.3g}"
    yield Departure("unknown", f"{text}, in {int(off.sum())} of {len(off)} rows", int(off.sum()))


def _beside(rows: Integers, count: int) -> Booleans:
    """Return those rows and the ones behind them: a change that is too small makes the next too large."""
    result = np.zeros(count + 1, dtype=np.bool_)
    result[rows] = result[rows + 1] = True
    return result[:count]


def _by_stamps(stamps: Stamps, log: LogRows) -> Iterator[Departure]:
    gaps = np.flatnonzero(stamps.skipped)
    if stamps.period != log.period:
        text = f"rows are {stamps.period:.4g} s apart by their stamps, the header says {log.period:.4g} s"
        yield Departure("sampling_period", text, len(log.time))
    if len(gaps):
        lost = int(stamps.skipped.sum())
        yield Departure("missing_rows", f"the stamps skip {lost} rows, first after row {gaps[0]}", len(gaps))
    elif stamps.odd and stamps.scatters:
        text = f"stamps scatter by {stamps.scatter:.2g} of a period about even ones, and no row is missing"
        yield Departure("scattered_stamps", text, stamps.odd)


def _repeated(log: LogRows, rows: Integers) -> Iterator[Departure]:
    if len(rows):
        both = int((log.command[rows] == log.command[rows - 1]).sum())
        what = "rows repeat the one before" if both > len(rows) / 2 else "readings of the position are held"
        text = f"{len(rows)} {what} while the device moves, first row {rows[0]}"
        yield Departure("repeated_rows", text, len(rows))

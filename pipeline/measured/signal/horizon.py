"""From which sample to which a measured response is summed, and the energies in between.

Shared by the costs and by their intervals: where cost index 0 lies, which trials can have costs at all, and
where the response sinks into what its sensor shows of a device at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import REST_FLOORS, Verdicts
from pipeline.records.batch import Booleans, Floats, Integers, TrialBatch

HORIZON_FACTOR = 2.0
"""Distance, in amplitudes of the rest, above which the response stands: it leaves room for a beat."""

LASTING = 0.7
"""Amplitude of the last fifth relative to the fifth before from which on an oscillation lasts."""


WEIGHTS = (0, 1, 2)
"""Exponents w of the weighting by time."""


@dataclass(frozen=True, eq=False)
class EnergyTerms:
    """Energies of each sample from cost index 0 to the horizon, relative to E_0 = F_0^2/(2 K).

    Parameters
    ----------
    first, stop : int64, shape (n,)
        Row of cost index 0, and first row behind the horizon; equal where a trial has no cost.
    usable : bool, shape (n,)
        Trials that can have a cost.
    index : float64, shape (n, N)
        Cost index k; 0 outside the horizon.
    error : float64, shape (n, N)
        Distance from x_0 + F_0/K [m, rad]; 0 outside the horizon.
    change : float64, shape (n, N)
        Change since the sample before [m, rad]; 0 at cost index 0 and outside the horizon.
    potential, kinetic : float64, shape (n, N)
        Potential energy [1] and kinetic energy per mass [1/kg, 1/(kg m^2)] of each sample.
    reason : tuple of str
        Why a trial cannot have a cost.
    """

    first: Integers
    stop: Integers
    usable: Booleans
    index: Floats
    error: Floats
    change: Floats
    potential: Floats
    kinetic: Floats
    reason: tuple[str, ...]

    def summed(self, mass: float) -> Floats:
        """Return the plain sums of k^w E_k/E_0 up to the horizon, shape (n, 3); NaN where a trial can have no cost."""
        energy = self.potential + mass * self.kinetic
        # 0^0 = 1 outside the horizon meets energies of 0
        sums = np.stack([(self.index**w * energy).sum(axis=1) for w in WEIGHTS], axis=1)
        return np.where(self.usable[:, None], sums, np.nan)


def cost_start(
    batch: TrialBatch, response: Response, verdicts: Verdicts, delay_samples: int
) -> tuple[Integers, Booleans, tuple[str, ...]]:
    """Return the row of cost index 0, which trials can have costs, and why the others have none.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    delay_samples : int
        Integer delay factor d of the experiment.

    Raises
    ------
    ParameterError
        If the delay is negative.

    Source: Hulin 2017, sec. 6.1.4 (first d samples dropped).
    """
    if delay_samples < 0:
        raise ParameterError(f"delay of {delay_samples} samples: expected an integer >= 0.")
    first = np.maximum(response.edge_row, 0) + delay_samples
    reasons = []
    for edge, edge_reason, k, verdict, start, rows in zip(
        response.edge_row, response.edge_reason, batch.stiffness, verdicts.verdict, first, batch.rows, strict=True
    ):
        if verdict == "unstable":
            reasons.append("unstable: no cost")
        elif edge < 0:
            reasons.append(f"no start of the response: {edge_reason}")
        elif k <= 0:
            reasons.append(f"no final position: x_0 + F_0/K needs K > 0, found K = {k:g}")
        elif start >= rows:
            reasons.append(f"the log of {rows} rows ends before the command takes effect in row {start}")
        else:
            reasons.append("")
    usable = np.array([not text for text in reasons], dtype=np.bool_)
    return first.astype(np.int64), usable, tuple(reasons)


def energy_terms(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    delay_samples: int,
    level: Floats | None = None,
) -> EnergyTerms:
    """Return the energies of each sample up to the horizon.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    delay_samples : int
        Integer delay factor d of the experiment.
    level : float64, shape (n,), optional
        Distance from the final position above which the response stands [m, rad]; `HORIZON_FACTOR` times what is
        left at rest where it is not given.

    Raises
    ------
    ParameterError
        If the delay is negative.

    Notes
    -----
    E_k = K/2 (x_k - x_inf)^2 + m/2 ((x_k - x_{k-1})/T)^2 with x_{-1} = x_0. The horizon is where the response
    sinks below `HORIZON_FACTOR` sensor floors (or amplitudes of the limit cycle that quanta keep up) for good,
    since the floor times k^2 over a long log would swamp the sum, or below a level that is given; ideal logs are
    taken to their end.

    Source: Hulin 2017, eqs. 5.7 and 5.14 (sampled), sec. 6.1.4.
    """
    first, usable, why = cost_start(batch, response, verdicts, delay_samples)
    columns = batch.position.shape[1]
    column = np.arange(columns)[None, :]
    final = np.where(usable, response.position_final_expected, 0.0)
    stiffness = np.where(usable, batch.stiffness, 1.0)
    counted = batch.valid & (column >= first[:, None]) & usable[:, None]
    error = np.where(counted, batch.position - final[:, None], 0.0)
    level = HORIZON_FACTOR * _rest(batch, first, response.floor) if level is None else level
    above = counted & (np.abs(error) > level[:, None])
    stop = np.where(above.any(axis=1), columns - np.argmax(above[:, ::-1], axis=1), first)
    stop = np.where(response.floor > 0, stop, batch.rows)
    stop = np.where(usable, stop, first)
    counted &= column < stop[:, None]
    error = np.where(counted, error, 0.0)
    change = np.diff(batch.position, axis=1, prepend=batch.position[:, :1])
    # chi_{-1} = chi_0 (DEFINITIONS: the response is at rest at its index 0)
    change = np.where(counted & (column > first[:, None]), change, 0.0)
    # a trial without a step is not usable, as one without a wall
    start_energy = (np.where(usable, batch.step, 1.0) ** 2 / (2 * stiffness))[:, None]
    return EnergyTerms(
        first=first,
        stop=stop.astype(np.int64),
        usable=usable,
        index=np.where(counted, column - first[:, None], 0).astype(np.float64),
        error=error,
        change=change,
        potential=0.5 * stiffness[:, None] * error**2 / start_energy,
        kinetic=0.5 * (change / batch.sampling_period_s[:, None]) ** 2 / start_energy,
        reason=why,
    )


def _rest(batch: TrialBatch, first: Integers, floor: Floats) -> Floats:
    """Return what is left when the response is over: the sensor floor, or the limit cycle that quanta keep up."""
    before, amplitude = _amplitude(batch, first, 0.6, 0.8), _amplitude(batch, first, 0.8, 1.0)
    limit_cycle = (amplitude >= LASTING * before) & (amplitude > 0) & (amplitude <= REST_FLOORS * floor)
    return np.maximum(floor, np.where(limit_cycle, amplitude, 0.0))


def _amplitude(batch: TrialBatch, first: Integers, since: float, until: float) -> Floats:
    """Half the range of the positions in a part of the response, 0 where it has no samples, shape (n,)."""
    column = np.arange(batch.position.shape[1])[None, :]
    length = batch.rows - first
    part = (column >= (first + since * length)[:, None]) & (column < (first + until * length)[:, None])
    highest = np.max(np.where(part, batch.position, -np.inf), axis=1, initial=-np.inf)
    amplitude = 0.5 * (highest - np.min(np.where(part, batch.position, np.inf), axis=1, initial=np.inf))
    result: Floats = np.where(np.isfinite(amplitude), amplitude, 0.0)
    return result

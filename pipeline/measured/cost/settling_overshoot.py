"""Discrete costs of measured step responses: settling time and overshoot; `energy_intervals` has the energy.

Cost index 0 is sample k0 + d: the response starts at the command edge k0, and its first d samples pass before
the command reaches the device. Each cost has its own function that asks for no more than it needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.measured.signal.horizon import cost_start
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.criteria import SETTLING_BANDS

SETTLED_SAMPLES = 5
"""Samples inside the band at the end: fewer may be a mere passage of the band."""


@dataclass(frozen=True, eq=False)
class Settling:
    """Discrete settling time by criterion, each of shape (n,) [samples]; NaN where there is a reason."""

    samples: Mapping[str, Floats]
    reason: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Overshoot:
    """Overshoot, and what of it sensor and chatter can feign, shape (n,) [1]; NaN where there is a reason."""

    overshoot: Floats
    floor: Floats
    reason: tuple[str, ...]


def settling(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    delay_samples: int,
    *,
    bands: Mapping[str, float] = SETTLING_BANDS,
) -> Settling:
    """Return the discrete settling time: the smallest k from which on all samples are inside the band.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    delay_samples : int
        Integer delay factor d of the experiment.
    bands : mapping of str to float
        Half width relative to the final displacement, by criterion.

    Returns
    -------
    Settling

    Raises
    ------
    ParameterError
        If the delay is negative.

    Notes
    -----
    The band lies about x_0 + F_0/K, not about the last sample. It is not judged where it is narrower than
    what quantum and noise alone cause.

    Source: Hulin 2017, secs. 5.1.1 and 6.1.4 (discrete settling time, first d samples dropped).
    """
    first, usable, why = cost_start(batch, response, verdicts, delay_samples)
    final, travel = response.position_final_expected, batch.step / np.where(usable, batch.stiffness, 1.0)
    column = np.arange(batch.position.shape[1])[None, :]
    counted = batch.valid & (column >= first[:, None])
    distance = np.abs(batch.position - final[:, None])
    samples: dict[str, Floats] = {}
    missing = [[text] if text else [] for text in why]
    for name, band in bands.items():
        width = band * np.abs(travel)
        outside = counted & ~(distance <= width[:, None])
        after = np.where(outside.any(axis=1), column.size - np.argmax(outside[:, ::-1], axis=1), first)
        resolved = width >= response.floor
        settled = batch.rows - after >= SETTLED_SAMPLES
        good = usable & resolved & settled
        samples[name] = np.where(good, after - first, np.nan).astype(np.float64)
        for i in np.flatnonzero(usable & ~good):
            missing[i].append(
                f"{name}: not settled at the end of the log"
                if resolved[i]
                else f"{name}: band of {width[i]:.3g} is below the sensor floor {response.floor[i]:.3g}"
            )
    return Settling(samples, tuple("; ".join(parts) for parts in missing))


def overshoot(batch: TrialBatch, response: Response, verdicts: Verdicts) -> Overshoot:
    """Return the overshoot over the whole response, max(0, max (x - x_inf)/(x_inf - x_0)).

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.

    Notes
    -----
    Neither delay nor mass is needed. Below ``floor`` an overshoot cannot be told from quantum and noise, nor
    from the motion before the step, which goes on after it: a chatter that the sensor does not explain is
    added to the floor with its peak to peak.

    Source: Hulin 2017, sec. 5.1.1; footnote 4 of 5.2.2 for the tolerance 1e-12 of "no overshoot".
    """
    first, usable, why = cost_start(batch, response, verdicts, 0)
    travel = np.where(usable, response.position_final_expected - response.position_start, 1.0)
    counted = batch.valid & (np.arange(batch.position.shape[1])[None, :] >= first[:, None])
    relative = (batch.position - response.position_final_expected[:, None]) / travel[:, None]
    largest = np.max(np.where(counted & usable[:, None], relative, 0.0), axis=1, initial=0.0)
    floor = np.where(usable, (response.floor + response.baseline_motion) / np.abs(travel), 0.0)
    return Overshoot(np.where(usable, largest, np.nan), floor, why)

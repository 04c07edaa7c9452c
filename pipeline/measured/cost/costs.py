"""Discrete costs of measured step responses: settling time, overshoot, energy.

Cost index 0 is sample k0 + d: the response starts at the command edge k0, and its first d samples pass before
the command reaches the device. Each cost has its own function that asks for no more than it needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import percent
from pipeline.measured.signal.horizon import EndOfLog, cost_start, energy_terms
from pipeline.measured.signal.response import Response
from pipeline.measured.signal.verdict import Verdicts
from pipeline.records.batch import Floats, Integers, TrialBatch
from pipeline.records.criteria import SETTLING_BANDS

SETTLED_SAMPLES = 5
"""Samples inside the band at the end: fewer may be a mere passage of the band."""

UNSETTLED = 0.05
"""Lasting amplitude relative to the final displacement from which on a response never settles: the widest
settling band."""

TAIL_FRACTION = 0.01
"""Estimate of what lies beyond the horizon, relative to the potential part, from which on it is reported."""

LARGEST_TAIL = 0.05
"""As `TAIL_FRACTION`, from which on the sum is no cost: the optima of one criterion differ by no more."""

WEIGHTS = (0, 1, 2)
"""Exponents w of the weighting by time."""


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


@dataclass(frozen=True, eq=False)
class Energy:
    """Parts of the discrete energy cost for w = 0, 1, 2, shape (n, 3); NaN where there is no value.

    The cost is ``potential + mass * kinetic``. A reason may concern single exponents w.

    Parameters
    ----------
    potential : float64
        Potential part [1].
    kinetic : float64
        Kinetic part per mass [1/kg, 1/(kg m^2)].
    horizon_samples : int64, shape (n,)
        Number of samples summed.
    reason : tuple of str
        Why values are missing, or that more than 1 % of them may lie beyond the horizon.
    """

    potential: Floats
    kinetic: Floats
    horizon_samples: Integers
    reason: tuple[str, ...]


def settling(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    delay_samples: int,
    *,
    bands: Mapping[str, float] = SETTLING_BANDS,
    settled_samples: int = SETTLED_SAMPLES,
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
    settled_samples : int
        Samples inside the band that the log must hold at least.

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
        settled = batch.rows - after >= settled_samples
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


def energy(batch: TrialBatch, response: Response, verdicts: Verdicts, delay_samples: int) -> Energy:
    """Return the parts of the discrete energy cost.

    Parameters
    ----------
    batch : TrialBatch
    response, verdicts : Response, Verdicts
        Of the same trials.
    delay_samples : int
        Integer delay factor d of the experiment.

    Returns
    -------
    Energy

    Raises
    ------
    ParameterError
        If the delay is negative.

    Notes
    -----
    sum of k^w E_k / E_0 with E_k = K/2 (x_k - x_inf)^2 + m/2 ((x_k - x_{k-1})/T)^2, x_{-1} = x_0 and
    E_0 = F_0^2/(2 K): left rectangle rule and backward difference. The sum ends where the response sinks
    below the sensor floor (or the limit cycle that quanta keep up) for good, since the floor times k^2 over a
    long log would swamp it; ideal logs are summed to their end. What lies beyond is estimated from the
    envelope there and its decay, relative to the potential part: two to five times too much for a motion that
    swings, since half of its energy is kinetic and it mostly lies within its envelope.

    A sum is a cost only where it is nearly the whole: a motion that lasts to the end of the log with more
    than `UNSETTLED` of the final displacement has no cost at all, and an exponent w for which more than
    `LARGEST_TAIL` of the sum lies beyond the horizon has none while the others keep theirs. `energy_intervals`
    takes the bias by noise off, and carries the response on beyond the horizon.

    Source: Hulin 2017, eqs. 5.7 and 5.14 (sampled), sec. 6.1.4.
    """
    terms = energy_terms(batch, response, verdicts, delay_samples)
    first, stop, usable, end = terms.first, terms.stop, terms.usable, terms.end
    stiffness = np.where(usable, batch.stiffness, 1.0)
    step = np.where(usable, batch.step, 1.0)
    start_energy = step**2 / (2 * stiffness)
    k = terms.index
    # 0^0 = 1 outside the horizon meets energies of 0
    sums = [np.stack([(k**w * part).sum(axis=1) for w in WEIGHTS], axis=1) for part in (terms.potential, terms.kinetic)]
    horizon = stop - first
    envelope = _envelope(terms.error, stop, horizon)
    decay = _decay_per_sample(batch, response, verdicts, end, envelope, terms.error, stop)
    tail = _tail(envelope, horizon, decay, 0.5 * stiffness / start_energy)
    lasting = end.amplitude / np.abs(step / stiffness)
    settles = ~(end.lasts & (lasting > UNSETTLED))
    # a sum of zero has no tail to be compared with
    trusted = ~(tail > LARGEST_TAIL * sums[0])
    there = (usable & settles)[:, None] & trusted
    reason = tuple(
        text
        or ("" if good else f"never settles: {percent(size)} of the final displacement lasts to the end of the log")
        or _tail_reason(beyond, total, count)
        for text, good, size, beyond, total, count in zip(
            terms.reason, settles, lasting, tail, sums[0], horizon, strict=True
        )
    )
    return Energy(
        potential=np.where(there, sums[0], np.nan),
        kinetic=np.where(there, sums[1], np.nan),
        horizon_samples=horizon.astype(np.int64),
        reason=reason,
    )


def _envelope(error: Floats, stop: Integers, horizon: Integers) -> Floats:
    """Largest distance over the last eighth of what was summed, shape (n,)."""
    column = np.arange(error.shape[1])[None, :]
    last = (column >= (stop - np.maximum(horizon // 8, 1))[:, None]) & (column < stop[:, None])
    envelope: Floats = np.max(np.where(last, np.abs(error), 0.0), axis=1, initial=0.0)
    return envelope


def _decay_per_sample(
    batch: TrialBatch,
    response: Response,
    verdicts: Verdicts,
    end: EndOfLog,
    envelope: Floats,
    error: Floats,
    stop: Integers,
) -> Floats:
    """Decay of the amplitude beyond the horizon per sample, shape (n,), 0 where none is known.

    An ideal log tells its slowest mode. With noise that mode may be the noise: there it is the mean decay from
    the largest distance to the horizon if the response is over well before the end of the log, else the decay
    over the last two fifths of the log.
    """
    by_mode = -np.nan_to_num(verdicts.growth_per_s) * batch.sampling_period_s
    size = np.abs(error)
    largest = size.max(axis=1, initial=0.0)
    elapsed = np.maximum(stop - np.argmax(size, axis=1), 1)
    fall = np.where(envelope > 0, envelope, largest)
    mean = np.log(np.where(fall > 0, largest, 1.0) / np.where(fall > 0, fall, 1.0)) / elapsed
    moves = (end.before > 0) & (end.amplitude > 0)
    ratio = np.where(moves, end.before, 1.0) / np.where(moves, end.amplitude, 1.0)
    fifth = np.maximum(batch.rows - end.since, 1.0)
    at_end = np.where(moves, np.log(ratio) / fifth, mean)
    seen = np.where(stop <= end.since, mean, at_end)
    decay: Floats = np.maximum(np.where((response.floor > 0) | (by_mode <= 0), seen, by_mode), 0.0)
    return decay


def _tail(envelope: Floats, horizon: Integers, decay: Floats, potential: Floats) -> Floats:
    """Estimate of sum k^w E_k/E_0 beyond the horizon, shape (n, 3); infinite where no decay is known.

    The energy of the envelope decays at twice the rate.
    """
    known = decay > 0
    ratio = np.exp(-2 * np.where(known, decay, 1.0))
    rest = -np.expm1(-2 * np.where(known, decay, 1.0))
    # sum over j >= 0 of (h + j)^w r^j
    h = horizon.astype(np.float64)
    plain, once, twice = 1 / rest, ratio / rest**2, ratio * (1 + ratio) / rest**3
    moments = np.stack([plain, h * plain + once, h * h * plain + 2 * h * once + twice], axis=1)
    start = (potential * envelope**2)[:, None]
    result: Floats = np.where(known[:, None] | (start == 0), start * moments, np.inf)
    return result


def _tail_reason(tail: Floats, total: Floats, horizon: int) -> str:
    large = [w for w in WEIGHTS if tail[w] > TAIL_FRACTION * total[w]]
    if not large:
        return ""
    shares = ", ".join(
        f"w = {w}: {100 * tail[w] / total[w]:.2g} %" if np.isfinite(tail[w]) and total[w] > 0 else f"w = {w}: unknown"
        for w in large
    )
    lost = [str(w) for w in large if tail[w] > LARGEST_TAIL * total[w]]
    text = f"summed over {horizon} samples; beyond them lie up to {shares} of the sum"
    if lost:
        text += f"; above {percent(LARGEST_TAIL)} there is no value (w = {', '.join(lost)}): record longer"
    return text

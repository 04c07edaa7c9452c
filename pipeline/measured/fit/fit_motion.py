"""Exact motion of a model between two rows of a log, with its derivatives, for all trials at once.

Time is counted in samples, so that the damping is the normalised delta = b T/m (Table 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.records.batch import Floats, Integers

LARGEST_RATE = 3.0
"""Largest |delta|: beyond it the motion changes by a factor of 20 within a sample and is not sampled.
It also keeps the power series below exact to 1e-13."""

SERIES_TERMS = 32
"""Terms of the power series: with `LARGEST_RATE` the next one is below 1e-15 of the sum."""

NEGLIGIBLE = 1e-19
"""Coefficient of the power series below which the terms left change no digit: slow devices need ten terms."""

DIFFERENCE = 1e-4
"""Step in delta for the central differences of the coefficients: truncation and rounding are 1e-9."""


@dataclass(frozen=True, eq=False)
class Step:
    """Coefficients of the motion over one sample, shape (n,) each.

    Parameters
    ----------
    xv, vv : float64
        What a velocity adds to the position, and what is left of it.
    old_x, old_v : float64
        Effect of the command that still acts at the row, until the switch.
    new_x, new_v : float64
        Effect of the command that acts from the switch on.
    jump_x, jump_v : float64
        Derivative of both effects by the delay, for a unit change of the command at the switch.
    hold_x, hold_v : float64
        Effect of a command over the whole sample.
    """

    xv: Floats
    vv: Floats
    old_x: Floats
    old_v: Floats
    new_x: Floats
    new_v: Floats
    jump_x: Floats
    jump_v: Floats
    hold_x: Floats
    hold_v: Floats

    def minus(self, other: Step, span: float) -> Step:
        """Return the difference of all coefficients, divided by a span."""
        names = self.__dataclass_fields__
        return Step(*((getattr(self, name) - getattr(other, name)) / span for name in names))


def step_of(delta: Floats, part: Floats) -> Step:
    """Return the motion over a sample in which the command switches after a part of it.

    Parameters
    ----------
    delta : float64, shape (..., n)
        At most `LARGEST_RATE` in size, of any sign.
    part : float64, shape (n,)
        Fraction of the sample before the switch, in [0, 1).

    Notes
    -----
    The command of sample k acts on [k + d, k + 1 + d), so that a fractional d switches inside a sample.

    Source: Hulin 2017, eqs. 3.3 to 3.8; fractional delay as in the modified z-transform (sec. 7.2).
    """
    times = np.stack([part, 1 - part, np.ones_like(part)])
    impulse, derivative, integral = (np.moveaxis(values, -2, 0) for values in _impulse(delta, times))
    (early_v, late_v, hold_v), (_, late_slope, slope), (early_x, late_x, hold_x) = impulse, derivative, integral
    return Step(
        xv=hold_v,
        vv=slope,
        old_x=early_x + late_v * early_v,
        old_v=late_slope * early_v,
        new_x=late_x,
        new_v=late_v,
        jump_x=late_v,
        jump_v=late_slope,
        hold_x=hold_x,
        hold_v=hold_v,
    )


def step_change(delta: Floats, part: Floats) -> Step:
    """Return the derivatives of all coefficients by delta."""
    h = DIFFERENCE
    return step_of(delta + h, part).minus(step_of(delta - h, part), 2 * h)


def acting(force: Floats, whole: Integers) -> Floats:
    """Return the command that acts before row 0 and from each row on, 0 where it was sent before the log, (N + 1, n).

    Parameters
    ----------
    force : float64, shape (N, n)
        Command of each row, time along the first axis.
    whole : int64, shape (n,)
        Delay in whole samples, may be negative: then the last command holds on.
    """
    N, n = force.shape
    sent = np.concatenate([np.zeros((1, n)), force])
    row = np.clip(np.arange(N + 1)[:, None] - whole, 0, N)
    row *= n
    row += np.arange(n)
    result: Floats = sent.ravel().take(row)
    return result


def _impulse(delta: Floats, times: Floats) -> tuple[Floats, Floats, Floats]:
    """Return impulse response h, its derivative and its integral at some times <= 1 [sample], by power series.

    Shape (..., n) of delta, (t, n) of the times, (..., t, n) of the results.

    h = sum s_n t^n with s_1 = 1 and (n + 1) s_{n+1} = -delta s_n, which holds for any sign and needs no special case at
    zero.
    """
    before, now = np.zeros_like(delta), np.ones_like(delta)
    power = times
    impulse, slope, gain = power.copy(), np.ones_like(power), 0.5 * power * times
    for n in range(1, SERIES_TERMS):
        before, now = now, -n * delta * now / (n * (n + 1))
        term = now[..., None, :] * power
        slope = slope + (n + 1) * term
        power = power * times
        term = term * times
        impulse = impulse + term
        gain = gain + term * times / (n + 2)
        if max(np.abs(now).max(initial=0.0), np.abs(before).max(initial=0.0)) * (n + 1) < NEGLIGIBLE:
            break
    return impulse, slope, gain

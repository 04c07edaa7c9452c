"""The curves on which a pole pair lies on the unit circle, to rounding for every plant and angle.

With z = exp(j theta), h = delta/2 and q^2 = h^2 - gamma (q = j omega for a plant that swings), the delayed plant behind
its hold is, for integer d,

    -1/G(z) = -z^(d + 1/2) (gamma F - 2 sin^2(theta/2) cosh h + j sin theta sinh h)
              / (F cos(theta/2) + j h H sin(theta/2))

with the divided differences F = (cosh h - cosh q)/gamma and H = (sinh h/h - sinh q/q)/gamma. Both are positive and
known to rounding, also for gamma = 0 or delta = 0; nothing cancels for theta -> 0, and near theta = pi, where a plant
with gamma -> pi^2 has its poles, angles are counted from pi. A fractional delay changes the denominator only.

Source: Hulin 2017, eqs. 3.3 to 3.11 on |z| = 1, in another form; modified z-transform for fractional d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from pipeline.loop.loop import Loop
from pipeline.records.batch import Booleans, Floats

FOLD = 2.5
"""Angle [rad] from which on angles are counted from pi, as negative numbers: close to pi that keeps their digits."""

Indices = NDArray[np.intp]

_GAUSS = leggauss(60)
"""60 points integrate exp(-80 x) over [0, 1] to rounding; no integrand here varies more."""

_LAYER = 40.0
"""Exponents beyond which an integrand is below rounding, exp(-40) = 4e-18."""

_SMOOTH = 20.0
"""Largest h t at which the position gain is integrated; beyond, its closed form no longer cancels."""

_STRONG = 5.0
"""Largest h at which the value at z = -1 needs the integral; beyond, the plain difference keeps its digits."""

_PI_SQUARED = (math.pi**2, 6.265295508739711e-16)
"""pi^2 as a sum of two doubles."""

_PI_LOW = 1.2246467991473532e-16
"""pi minus its double."""


@dataclass(frozen=True)
class Curve:
    """The constants of -1/G on the unit circle, G being the delayed plant of a loop.

    Parameters
    ----------
    gamma, delay : float
        As of the loop.
    chi : float
        pi - omega for a plant that swings (gamma > delta^2/4), to full relative precision; nan for one that does not.
    h : float
        delta/2.
    cosh, sinh, f, k : float
        cosh h, sinh h, F and h H, all times exp(-h).
    total, skew, last : float
        For a fractional delay the denominator is last + 2 total cos^2(theta/2) + j skew sin theta; 0 otherwise.
    """

    gamma: float
    delay: float
    chi: float
    h: float
    cosh: float
    sinh: float
    f: float
    k: float
    total: float = 0.0
    skew: float = 0.0
    last: float = 0.0

    @property
    def whole(self) -> int:
        """Whole samples of the delay."""
        return math.floor(self.delay)

    @property
    def fractional(self) -> bool:
        """Whether the input switches inside a sampling interval."""
        return self.delay != self.whole

    @property
    def start(self) -> float:
        """Damping beta at which the first branch starts on alpha = -gamma (theta -> 0)."""
        turn = self.delay_turn - (0.5 * self.skew if self.fractional else 0.5 * self.k) / self.f
        return -(self.gamma * turn + self.sinh / self.f)

    @property
    def delay_turn(self) -> float:
        """Power of z in front of the closed form."""
        return self.whole + (1.0 if self.fractional else 0.5)

    @property
    def level(self) -> float:
        """Value of alpha + 2 beta at which a real pole lies at z = -1; infinite where no finite wall puts one there."""
        if math.isnan(self.chi):
            top = -2 * self.cosh + self.gamma * self.f
        else:
            top = -2 * (math.exp(-self.h) * math.sin(0.5 * self.chi) ** 2 + 0.25 * math.expm1(-self.h) ** 2)
        sign = -1.0 if self.whole % 2 else 1.0
        bottom = self.last if self.fractional else self.k
        if bottom == 0:
            return math.inf
        return 2 * sign * top / bottom if self.fractional else -sign * top / bottom

    def zeros_outside(self) -> int:
        """Number of zeros of the delayed plant outside the unit circle; one at z = -1 itself does not count."""
        if not self.fractional or self.last == 0:
            return 0
        if self.last > 0:
            return 1
        return 0 if self.skew > 0 else 2


@dataclass(frozen=True, eq=False)
class CurvePoints:
    """Points of the curves, shape (n,): alpha, beta and their derivatives with respect to theta."""

    alpha: Floats
    beta: Floats
    alpha_slope: Floats
    beta_slope: Floats


def curve(loop: Loop) -> Curve:
    """Return the constants of a loop's curves.

    Source: Hulin 2017, eqs. 3.3 to 3.8 and appendix A.2, in another form.
    """
    gamma, h = loop.gamma, 0.5 * loop.delta
    fraction = loop.delay - math.floor(loop.delay)
    q_squared = h * h - gamma
    chi = math.nan
    if q_squared <= 0:
        omega = math.sqrt(-q_squared)
        chi = max((_PI_SQUARED[0] - gamma + h * h) + _PI_SQUARED[1], 0.0) / (math.pi + omega)
    f = float(_f(gamma, h, np.array([1.0]))[0])
    s, weight = _nodes(max(0.0, 1 - _LAYER / h) if h > 0 else 0.0, 1.0)
    k = h * float(weight @ (s * s * np.exp(-h * (1 - s)) * _f(gamma, h, s)))
    cosh, sinh = 0.5 * (1 + math.exp(-2 * h)), -0.5 * math.expm1(-2 * h)
    whole = Curve(gamma, loop.delay, chi, h, cosh, sinh, f, k)
    if fraction == 0:
        return whole
    first, late = fraction, 1 - fraction
    a0 = _gain(gamma, h, late)
    s, weight = _nodes(max(0.0, first - _LAYER / h) if h > 0 else 0.0, first)
    a2 = float(weight @ (np.exp(-2 * h * (1 - s)) * _impulse(gamma, h, s)))
    last = 2 * (f - a0 - a2) if h > _STRONG else _last(gamma, h, first, late, k, chi)
    return Curve(gamma, loop.delay, chi, h, cosh, sinh, f, k, a0 + a2, a0 - a2, last)


def folded(theta: Floats) -> Floats:
    """Return angles in (0, pi) [rad] with those beyond `FOLD` counted from pi, as `points` takes them."""
    return np.where(theta <= FOLD, theta, (theta - math.pi) - _PI_LOW)


def curve_points(c: Curve, angle: Floats) -> CurvePoints:
    """Return the points (alpha, beta) with poles on the unit circle at +- an angle, and their derivatives.

    Parameters
    ----------
    c : Curve
    angle : float64, shape (n,)
        Folded angle: theta where it is not negative, theta - pi where it is.

    Notes
    -----
    With W = -1/G: beta = Im W/sin theta, alpha = Re W - beta (1 - cos theta). At angle 0 the limit is given.
    """
    upper = angle < 0
    folds = bool(upper.any())
    half_sine, half_cosine = np.sin(0.5 * angle), np.cos(0.5 * angle)
    if folds:
        half_sine, half_cosine = np.where(upper, half_cosine, half_sine), np.where(upper, -half_sine, half_cosine)
    sine, cosine = 2 * half_sine * half_cosine, (half_cosine - half_sine) * (half_cosine + half_sine)
    square = 2 * half_sine**2
    real = c.gamma * c.f - square * c.cosh
    if folds and not math.isnan(c.chi):  # close to pi the two terms above nearly cancel
        swing = 2 * math.exp(-c.h) * np.sin(0.5 * (c.chi - angle)) * np.sin(-0.5 * (angle + c.chi))
        real = np.where(upper, swing + cosine * 0.5 * math.expm1(-c.h) ** 2, real)
    top, top_slope = real + 1j * (c.sinh * sine), -c.cosh * sine + 1j * (c.sinh * cosine)
    power = c.delay_turn
    if c.fractional:
        bottom = c.last + 2 * c.total * half_cosine**2 + 1j * (c.skew * sine)
        bottom_slope = -c.total * sine + 1j * (c.skew * cosine)
        at_pi, factor = (-1.0) ** (c.whole + 1) + 0j, -2.0
    else:
        bottom = c.f * half_cosine + 1j * (c.k * half_sine)
        bottom_slope = -0.5 * c.f * half_sine + 0.5j * (c.k * half_cosine)
        at_pi, factor = 1j * (-1.0) ** c.whole, -1.0
    turn = np.exp(1j * power * angle)
    if folds:
        turn *= np.where(upper, at_pi, 1.0)
    lever = factor * turn / bottom
    w = lever * top
    slope = lever * (1j * power * top + top_slope - top * (bottom_slope / bottom))
    flat = sine == 0
    safe = np.where(flat, 1.0, sine)
    beta = np.where(flat, slope.imag, w.imag / safe)
    beta_slope = np.where(flat, 0.0, (slope.imag - beta * cosine) / safe)
    return CurvePoints(
        alpha=w.real - beta * square,
        beta=beta,
        alpha_slope=slope.real - beta_slope * square - beta * sine,
        beta_slope=beta_slope,
    )


@dataclass(frozen=True, eq=False)
class Cells:
    """Stretches of the branches on which beta is monotone: folded angles, beta and alpha at both ends, shape (n,)."""

    low: Floats
    high: Floats
    beta_low: Floats
    beta_high: Floats
    alpha_low: Floats
    alpha_high: Floats
    rises: Booleans
    """Whether alpha grows (or falls: False in both) along the whole cell."""
    falls: Booleans

    @cached_property
    def stretch(self) -> Indices:
        """Number of the stretch between two extrema of beta that a cell belongs to."""
        rising = self.beta_high > self.beta_low
        return np.cumsum(np.append(False, rising[1:] != rising[:-1])).astype(np.intp)


def cells_between(c: Curve, angle: Floats) -> Cells:
    """Cells between successive angles; the pair that stands for the fold itself is left out."""
    p = curve_points(c, angle)
    keep = (angle[:-1] < 0) == (angle[1:] < 0)
    a, b, slope = p.alpha, p.beta, np.where(angle == 0, np.sign(p.alpha_slope[1]), p.alpha_slope)
    return Cells(
        low=angle[:-1][keep],
        high=angle[1:][keep],
        beta_low=b[:-1][keep],
        beta_high=b[1:][keep],
        alpha_low=a[:-1][keep],
        alpha_high=a[1:][keep],
        rises=((slope[:-1] > 0) & (slope[1:] > 0))[keep],
        falls=((slope[:-1] < 0) & (slope[1:] < 0))[keep],
    )


def beta_above_start(c: Curve, angle: Floats) -> Floats:
    """Return beta + delta on the curves of a plant without stiffness, to full relative precision.

    Parameters
    ----------
    c : Curve
        With gamma = 0, whose first branch starts at beta = -delta.
    angle : float64, shape (n,)
        Angle theta, not folded: in [0, `FOLD`] [rad].

    Notes
    -----
    Near the start alpha is small and so is this, where the difference of beta and its start would leave few digits.
    """
    sine, cosine = np.sin(0.5 * angle), np.cos(0.5 * angle)
    turn = c.delay_turn * angle
    turned = -2 * np.sin(0.5 * turn) ** 2 + 1j * np.sin(turn)
    if c.fractional:
        factor, start = -2.0, c.last + 2 * c.total
        change = -2 * c.total * sine**2 + 2j * (c.skew * sine * cosine)
    else:
        factor, start = -1.0, c.f
        change = -2 * c.f * np.sin(0.25 * angle) ** 2 + 1j * (c.k * sine)
    lever = factor / (start + change)
    real = (lever * (start * turned - change)).real / start
    return np.asarray(real * c.sinh - (lever * (1 + turned)).imag * (sine / cosine) * c.cosh)


def _nodes(low: float, high: float) -> tuple[Floats, Floats]:
    """Gauss points and weights of an interval."""
    half = 0.5 * (high - low)
    return low + half * (_GAUSS[0] + 1), half * _GAUSS[1]


def _phi1(x: Floats) -> Floats:
    """(exp(x) - 1)/x, 1 at 0."""
    return np.where(x == 0, 1.0, np.expm1(x) / np.where(x == 0, 1.0, x))


def _f(gamma: float, h: float, time: Floats) -> Floats:
    """exp(-h t) F of a plant seen for a time t, per t^2: gamma t^2 and h t in place of gamma and h."""
    q_squared = h * h - gamma
    if q_squared >= 0:
        q = math.sqrt(q_squared)
        slow = gamma / (h + q) if h + q > 0 else 0.0
        return 0.5 * _phi1(-(h + q) * time) * _phi1(-slow * time)
    omega = math.sqrt(-q_squared)
    swing = np.exp(-h * time) * np.sin(0.5 * omega * time) ** 2
    result: Floats = 2 * (0.25 * np.expm1(-h * time) ** 2 + swing) / (gamma * time**2)
    return result


def _impulse(gamma: float, h: float, time: Floats) -> Floats:
    """Impulse response exp(-h t) sinh(q t)/q."""
    q_squared = h * h - gamma
    if q_squared >= 0:
        q = math.sqrt(q_squared)
        slow = gamma / (h + q) if h + q > 0 else 0.0
        return time * np.exp(-slow * time) * _phi1(-2 * q * time)
    omega = math.sqrt(-q_squared)
    return np.exp(-h * time) * np.sin(omega * time) / omega


def _gain(gamma: float, h: float, time: float) -> float:
    """Position after a time of unit force from rest: the integral of the impulse response."""
    if h * time <= _SMOOTH:
        s, weight = _nodes(0.0, time)
        return float(weight @ _impulse(gamma, h, s))
    q = math.sqrt(max(h * h - gamma, 0.0))
    if q > 0.5 * h:
        slow, fast = (float(_phi1(np.array(-r * time))) for r in (gamma / (h + q), h + q))
        return time * (slow - fast) / (2 * q)
    impulse = float(_impulse(gamma, h, np.array(time)))
    omega = math.sqrt(max(gamma - h * h, 0.0))
    cosine = math.exp(-h * time) * (math.cos(omega * time) if omega > 0 else math.cosh(q * time))
    return (1 - cosine - h * impulse) / gamma


def _last(gamma: float, h: float, first: float, late: float, k: float, chi: float) -> float:
    """Denominator at z = -1 for an input that switches ``first`` samples into an interval.

    -+2 h H at a whole delay, plus an integral over the shorter part, in which the difference S(1 - x) - S(x) of the
    undamped impulse response is a product.
    """
    x, weight = _nodes(0.0, min(first, late))
    if math.isnan(chi):
        q = math.sqrt(h * h - gamma)
        difference = (
            math.cosh(0.5 * q) * (1 - 2 * x) * np.sinh(_away(0.5 * q * (1 - 2 * x))) / _away(0.5 * q * (1 - 2 * x))
        )
    else:
        omega = math.sqrt(gamma - h * h)
        cosine = math.sin(0.5 * chi) if chi < 1 else math.cos(0.5 * omega)
        difference = cosine * (1 - 2 * x) * np.sinc(0.5 * omega * (1 - 2 * x) / math.pi)
    plain = np.exp(h * x) * _impulse(gamma, h, x)
    lost = -math.expm1(-h)
    if first <= late:
        return 2 * (float(weight @ (np.exp(-h * (1 - x)) * (difference + lost * plain))) - k)
    return 2 * (float(weight @ (np.exp(-h * x) * (math.exp(-h) * difference - lost * plain))) + k)


def _away(x: Floats) -> Floats:
    """Keep the argument of sinh(x)/x from 0, where it is 1 to rounding."""
    return np.where(np.abs(x) < 1e-9, 1e-9, x)

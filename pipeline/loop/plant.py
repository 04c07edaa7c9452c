"""Exact motion of a mass-spring-damper between two changes of its input.

The plant is ``x'' = u - delta x' - gamma x`` (3.3). With a constant input over a time t its state moves to
``[x, v](t) = transition @ [x, v](0) + gain * u``. Every entry keeps full relative precision where the printed
formula (3.5) divides by zero or cancels: gamma -> 0, delta -> 0, delta^2 -> 4 gamma and delta >> 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss

from pipeline.base.errors import ParameterError
from pipeline.records.batch import Floats

_QUADRATURE_ORDER = 48
"""Gauss points for the position gain; the integrand is entire, and 48 points reach 1e-15 while delta t <= 40."""

_GAUSS = leggauss(_QUADRATURE_ORDER)
"""Nodes and weights; computed once, as they take a hundred times as long as their use."""

_SERIES_LIMIT = 0.25
"""Largest gamma and delta for the power series in t <= 1; its terms then fall at least fourfold each."""

_SERIES_TERMS = 16
"""Terms of the power series: with the limit above, the next one is below 1e-17 of the sum."""

_NEGLIGIBLE = 1e-18
"""Term of the power series that no longer changes a double near 1."""

_QUADRATURE_LIMIT = 20.0
"""Largest delta t / 2 that the quadrature is used for; beyond it the closed form no longer cancels."""


@dataclass(frozen=True, eq=False)
class Flow:
    """State transition (…, 2, 2) and input gain (…, 2) of the plant over a time t."""

    transition: Floats
    gain: Floats


def flow(gamma: float, delta: float, time: float | Floats) -> Flow:
    """Return the exact motion of the plant over a time, or over each of several times.

    Parameters
    ----------
    gamma : float
        Stiffness per mass, k/m [1/s^2], or normalised k T^2/m (Table 3.1); >= 0.
    delta : float
        Damping per mass, b/m [1/s], or normalised b T/m; >= 0.
    time : float or array
        Time [s], or normalised t/T; >= 0, and below half a period of an underdamped plant.

    Raises
    ------
    ParameterError
        If gamma or delta is negative or not finite.

    Notes
    -----
    With h = delta t/2 and q^2 = h^2 - gamma t^2, the impulse response is t exp(-h) sinh(q)/q. Its integral, the
    position gain, is t^2 times the integral of s exp(-h s) sinh(q s)/(q s) over s in [0, 1], whose integrand is
    positive, so that Gauss quadrature cannot cancel.

    Source: Hulin 2017, eqs. 3.3 to 3.8 and appendix A.2 (discrete-time equivalent), in another form.
    """
    if not (np.isfinite(gamma) and np.isfinite(delta)) or gamma < 0 or delta < 0:
        raise ParameterError(
            f"plant with gamma = {gamma}, delta = {delta}: both must be finite and not negative "
            "(physical stiffness and damping divided by the mass)."
        )
    t = np.asarray(time, dtype=np.float64)
    if gamma == 0 and delta == 0:
        one, zero = np.ones_like(t), np.zeros_like(t)
        return _assemble(one, t, zero, one, 0.5 * t * t)
    series = motion_series(gamma, delta)
    if series is not None and t.max(initial=0.0) <= 1:
        return _by_series(series, gamma, t)
    h = 0.5 * delta * t
    q_squared = h * h - gamma * t * t
    q = np.sqrt(np.abs(q_squared))
    slow = gamma * t * t / (h + q + np.where(h + q == 0, 1.0, 0.0))
    real = q_squared > 0
    # exp(-h) cosh(q) and exp(-h) sinh(q)/q by the slow root h - q = gamma t^2 / (h + q), which does not overflow
    shrink = np.where(real, np.exp(-np.where(real, slow, 0.0)), np.exp(-h))
    double = np.exp(np.where(real, -2 * q, 0.0))
    cosine = np.where(real, 0.5 * (1 + double), np.cos(q)) * shrink
    safe_q = np.where(q == 0, 1.0, q)
    ratio = np.where(real, -np.expm1(np.where(real, -2 * q, 0.0)) / (2 * safe_q), np.sin(q) / safe_q)
    impulse = t * shrink * np.where(q == 0, 1.0, ratio)
    position_gain = _position_gain(gamma, t, h, q_squared, impulse, cosine)
    # (r1 e^r1 + (h + q) e^r2) / 2q with r1 = -slow: the plain difference loses the fast mode when delta is large
    apart = real & (q > 0.5)
    separate = (-slow * shrink + (h + q) * np.exp(-(h + q))) / (2 * safe_q)
    velocity = np.where(apart, separate, cosine - 0.5 * delta * impulse)
    return _assemble(1 - gamma * position_gain, impulse, -gamma * impulse, velocity, position_gain)


def motion_series(gamma: float, delta: float) -> tuple[list[float], list[float]] | None:
    """Return the coefficients of S(t)/t and G(t)/t^2 for t <= 1, S and G being velocity and position gain.

    None where gamma or delta is too large for a short power series. The impulse response has s_1 = 1 and
    n (n+1) s_{n+1} = -n delta s_n - gamma s_{n-1}. For the small normalised parameters of real devices this is many
    times faster than the closed form, and as exact.
    """
    if gamma > _SERIES_LIMIT or delta > _SERIES_LIMIT:
        return None
    s = [0.0, 1.0]
    for n in range(1, _SERIES_TERMS):
        s.append(-(n * delta * s[n] + gamma * s[n - 1]) / (n * (n + 1)))
        if max(abs(s[n]), abs(s[n + 1])) * (n + 1) < _NEGLIGIBLE:
            break
    return s[1:], [value / (n + 1) for n, value in enumerate(s) if n > 0]


def turning_time(gamma: float, delta: float, e: Floats, v: Floats, u: Floats, duration: float) -> Floats:
    """Return when the velocity changes sign inside a segment, in closed form; 0 or the duration where it does not.

    v(t) exp(delta t/2) = v c(t) + (a + delta v/2) s(t), with a the acceleration at the start, c and s the (hyperbolic)
    cosine and sine of the plant's own motion.

    Parameters
    ----------
    gamma, delta : float
        Normalised stiffness and damping of the plant.
    e, v, u : float64, shape (n,)
        Position, velocity and force at the segment's start, normalised (thesis table 3.2).
    duration : float
        Length of the segment [samples].

    Returns
    -------
    float64, shape (n,)
        Time from the segment's start [samples].

    """
    slope = u - gamma * e - 0.5 * delta * v
    square = 0.25 * delta * delta - gamma
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if square > 0:
            root = np.sqrt(square)
            time = np.arctanh(np.clip(-v * root / slope, -1, 1)) / root
        elif square < 0:
            root = np.sqrt(-square)
            time = np.arctan2(root * np.abs(v), -np.sign(v) * slope) / root
        else:
            time = -v / slope
    bounded: Floats = np.clip(np.nan_to_num(time, nan=0.0), 0.0, duration)
    return bounded


def horner(coefficients: list[float], t: Floats) -> Floats:
    """Return the polynomial with these coefficients, lowest power first."""
    result = np.full_like(t, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = result * t + coefficient
    return result


def _by_series(series: tuple[list[float], list[float]], gamma: float, t: Floats) -> Flow:
    impulse, gain = t * horner(series[0], t), t * t * horner(series[1], t)
    slope = horner([(n + 1) * value for n, value in enumerate(series[0])], t)
    return _assemble(1 - gamma * gain, impulse, -gamma * impulse, slope, gain)


def _position_gain(gamma: float, t: Floats, h: Floats, q_squared: Floats, impulse: Floats, cosine: Floats) -> Floats:
    stiff = gamma * t * t >= 1
    by_balance = (1 - cosine - np.where(t > 0, h / np.where(t > 0, t, 1.0), 0.0) * impulse) / (gamma or 1.0)
    nodes, weights = _GAUSS
    s = 0.5 * (nodes + 1)
    z = q_squared[..., None] * s * s
    root = np.sqrt(np.abs(z))
    safe = np.where(root == 0, 1.0, root)
    inside = np.minimum(h, _QUADRATURE_LIMIT)[..., None]
    with np.errstate(over="ignore"):
        growth = np.where(z > 0, np.sinh(np.minimum(root, 2 * _QUADRATURE_LIMIT)) / safe, np.sin(root) / safe)
    kernel = s * np.exp(-inside * s) * np.where(root == 0, 1.0, growth)
    by_quadrature = t * t * (kernel @ (0.5 * weights))
    q = np.sqrt(np.maximum(q_squared, 0.0))
    slow = gamma * t * t / np.where(h + q == 0, 1.0, h + q)
    far = (h > _QUADRATURE_LIMIT) & (q > 0.5 * h)
    by_roots = t * t * (_phi1(-slow) - _phi1(-(h + q))) / np.where(far, 2 * q, 1.0)
    return np.where(far, by_roots, np.where(stiff, by_balance, by_quadrature))


def _phi1(z: Floats) -> Floats:
    """(exp(z) - 1)/z, 1 at z = 0."""
    return np.where(z == 0, 1.0, np.expm1(z) / np.where(z == 0, 1.0, z))


def _assemble(xx: Floats, xv: Floats, vx: Floats, vv: Floats, gain: Floats) -> Flow:
    transition = np.stack([np.stack([xx, xv], -1), np.stack([vx, vv], -1)], -2)
    return Flow(transition, np.stack([gain, xv], -1))

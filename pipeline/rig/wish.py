"""Requirements on a wall, and the margin of a rig to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Floats
from pipeline.rig.quantities import with_damping
from pipeline.surface.physical_loop import Loop
from pipeline.theory.boundary import stiffness_limit
from pipeline.theory.crossings import first_branch
from pipeline.theory.poles import spectral_radius
from pipeline.theory.settling_overshoot import transient_costs

OVERSHOOT_SEEN = 1e-3
"""Largest overshoot that counts as none: in a sampled loop, no optimal wall has exactly zero overshoot."""

_FAINT = 0.1
"""Amplitude down to which motion is simulated, relative to `OVERSHOOT_SEEN`."""

_DAMPINGS, _STIFFNESSES = 32, 20
_NARROWER = 2
"""Number of walls of the first grid, over three decades of damping (and two of stiffness), and number of finer grids
after it."""

_ASIDE, _BESIDE = 2.0, 97
"""Largest factor of damping to either side in the search of the fastest wall, and number of walls tried."""

_SOFTEST, _SOFTER = 1e-3, 16
"""Stiffness of the softest wall examined below a given one, relative to it, and number of softer walls examined."""

_NARROW = 1e-6
"""Missing margin of a wall beyond an unstable stretch that is narrower than the spacing of these walls."""

_BISECTIONS = 40
"""Number of bisections for the frequency at which a damping becomes unstable: to 1e-12 of it."""

_NOTHING = -10.0
"""Margin of a stable wall whose settling time is too long to be computed; its negative is the margin without any
bound."""


@dataclass(frozen=True)
class DesignTarget:
    """Requirements on a wall.

    Parameters
    ----------
    stiffness : float, optional
        K [N/m, Nm/rad]; any if not given.
    settling_s : float, optional
        Longest settling time to 2 % [s].
    overshoot : float, optional
        Largest overshoot, as a fraction; below 0.001 counts as none.
    margin : float
        Gain margin: the wall stays stable with ``margin`` times its stiffness, >= 1.
    tolerance : float
        Relative error of mass, damping and delay, in either direction, for which the wish is still met; 0 to 0.9.

    Raises
    ------
    ParameterError
        If a number is out of range, or no requirement is given.
    """

    stiffness: float | None = None
    settling_s: float | None = None
    overshoot: float | None = None
    margin: float = 1.0
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        if self.stiffness is None and self.settling_s is None:
            raise ParameterError("no requirement given: state a stiffness, a settling time, or both.")
        for name, low in (("stiffness", 0.0), ("settling_s", 0.0)):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > low):
                raise ParameterError(f"{name} = {value}: expected a positive number.")
        if self.overshoot is not None and not 0 <= self.overshoot <= 1:
            raise ParameterError(f"overshoot = {self.overshoot}: expected a fraction from 0 to 1, as 0.05 for 5 %.")
        if not 1 <= self.margin < math.inf:
            raise ParameterError(f"margin = {self.margin}: expected 1 or more.")
        if not 0 <= self.tolerance <= 0.9:
            raise ParameterError(f"tolerance = {self.tolerance}: expected a fraction from 0 to 0.9, as 0.05.")


@dataclass(frozen=True)
class RigWall:
    """The wall of a rig closest to a wish: K, B, and the remaining margin, >= 0 if the wish is met."""

    stiffness: float
    damping: float
    room: float


def best_wall(loop: Loop, wish: DesignTarget, *, enough: bool = False) -> RigWall:
    """Return the wall that meets the requirements with the largest margin; with ``enough``, any that meets them.

    The margin of a wall is the smallest of three numbers: -ln of the spectral radius (at ``margin`` times the
    stiffness), ln of the allowed over the actual settling time, and allowed minus actual overshoot. A wall counts as
    stable only if all softer ones of its damping are stable, too: a device in contact passes through them.
    """
    rigs = _corners(loop, wish.tolerance)
    K, B = _first_look(loop, wish)
    found = RigWall(math.nan, math.nan, -math.inf)
    for _ in range(1 + _NARROWER):
        walls = np.array(list(product(K, B)))
        room = _room(rigs, wish, walls, found.room)
        at = int(np.argmax(room))
        if room[at] > found.room:
            found = RigWall(float(walls[at, 0]), float(walls[at, 1]), float(room[at]))
        if enough and found.room >= 0:
            break
        K, B = (_between(axis, value) for axis, value in ((K, found.stiffness), (B, found.damping)))
    return found


def quickest(loop: Loop, wish: DesignTarget, best: RigWall) -> RigWall:
    """Return the wall of the same stiffness with the shortest settling time, among those near the best one that fulfil
    the wish."""
    B = best.damping * np.geomspace(1 / _ASIDE, _ASIDE, _BESIDE)
    walls = np.column_stack([np.full(len(B), best.stiffness), B])
    room = _room(_corners(loop, wish.tolerance), wish, walls, -math.inf)
    settling = loop.points(walls[:, 0], B, ("settle_2pct",))["settle_2pct"].to_numpy(float)
    settling = np.where((room >= 0) & np.isfinite(settling), settling, np.inf)
    at = int(np.argmin(settling))
    return RigWall(best.stiffness, float(B[at]), float(room[at])) if settling[at] < np.inf else best


def decay(loop: Loop, wish: DesignTarget) -> float:
    """Return the largest decay rate [1/s] of the slowest mode over the walls of the first grid.

    It is faster to compute than the margin, and a large rate means early settling and little overshoot.
    """
    unit = loop.units
    K, B = np.array(list(product(*_first_look(loop, wish)))).T
    with np.errstate(divide="ignore"):
        rates = -np.log(spectral_radius(loop.normalised_loop, K / unit.stiffness, B / unit.damping))
    return float(rates.max()) / loop.sampling_period_s


def _first_look(loop: Loop, wish: DesignTarget) -> tuple[Floats, Floats]:
    """Return stiffness and damping of the first grid of walls."""
    largest = 2.5 * loop.apparent().mass / loop.sampling_period_s / (0.5 + loop.delay_samples)
    largest = max(largest, _largest_damping(loop))
    B = np.append(0.0, np.geomspace(1e-3 * largest, largest, _DAMPINGS))
    if wish.stiffness is not None:
        return np.array([wish.stiffness]), B
    stiffest = loop.boundary(16).attrs["stiffness_max"]
    return np.geomspace(1e-2 * stiffest, stiffest, _STIFFNESSES), B


def _largest_damping(loop: Loop) -> float:
    """Return approximately the largest stable B of a device with lag: |(m s + b)(tau s + 1)| at the phase -pi.

    With the delay of d + 1/2 samples, the phase condition is atan(w m/b) + atan(w tau) + w (d + 1/2) T = pi.
    """
    device, lag = loop.apparent(), loop.actuator_lag_s
    m, b, delay = device.mass, device.damping, (0.5 + loop.delay_samples) * loop.sampling_period_s
    low, high = 0.0, math.pi / delay
    for _ in range(_BISECTIONS):
        w = 0.5 * (low + high)
        behind = math.atan2(w * m, b) + math.atan(w * lag) + w * delay > math.pi
        low, high = (low, w) if behind else (w, high)
    return math.hypot(m * low, b) * math.hypot(lag * low, 1.0)


def _between(axis: Floats, value: float) -> Floats:
    """Return points between the two grid neighbours of a value on an axis."""
    if len(axis) == 1:
        return axis
    i = int(np.argmin(np.abs(axis - value)))
    return np.linspace(axis[max(i - 1, 0)], axis[min(i + 1, len(axis) - 1)], 13)


def _corners(loop: Loop, tolerance: float) -> list[Loop]:
    """Return the rigs at the corners of a tolerance; a mode's load keeps its share of the mass."""
    if tolerance == 0:
        return [loop]
    rigs = []
    for m, b, d in product((1 - tolerance, 1 + tolerance), repeat=3):
        changes: dict[str, float | None] = {"mass": m * loop.mass, "delay_samples": d * loop.delay_samples}
        if loop.mode:
            changes["mode.mass"] = m * loop.mode.mass
        try:
            rigs.append(with_damping(loop, b * loop.damping).replace(changes))
        except ParameterError as error:
            numbers = f"mass {m * loop.mass:.4g}, damping {b * loop.damping:.4g}, delay {d * loop.delay_samples:.4g}"
            raise ParameterError(f"tolerance = {tolerance:g}: leads to {numbers} samples. {error}") from None
    return rigs


def _room(rigs: Sequence[Loop], wish: DesignTarget, walls: Floats, above: float) -> Floats:
    """Return the margin of each wall, shape (n,), for the worst-case rig; not exact where it is below ``above``."""
    room = np.full(len(walls), np.inf)
    for rig in rigs:
        loop, unit = rig.normalised_loop, rig.units
        alpha, beta = walls.T / [[unit.stiffness], [unit.damping]]
        with np.errstate(divide="ignore"):
            left = -np.log(spectral_radius(loop, wish.margin * alpha, beta))
        left = _softer(loop, wish.margin * alpha, beta, left)
        if wish.settling_s is not None or wish.overshoot is not None:
            stable = left > 0
            left = np.where(stable, -_NOTHING, left + 2 * _NOTHING)  # any stable wall precedes any unstable one
            left[stable] = np.minimum(left[stable], _spare(rig, wish, alpha[stable], beta[stable], above))
        room = np.minimum(room, left)
    return room


def _softer(loop: NormalisedLoop, alpha: Floats, beta: Floats, left: Floats) -> Floats:
    """Return the smallest -ln of the spectral radius over each wall and the softer ones that are unstable, shape
    (n,)."""
    if first_branch(loop) is not None:  # softer walls are stable
        return left
    share = np.geomspace(_SOFTEST, 1.0, _SOFTER, endpoint=False)
    with np.errstate(divide="ignore"):
        softer = -np.log(spectral_radius(loop, np.outer(alpha, share).ravel(), np.repeat(beta, _SOFTER)))
    least = softer.reshape(len(alpha), _SOFTER).min(axis=1)
    result = np.where(least < 0, np.minimum(left, least), left)
    # an unstable stretch may be narrower than the steps between softer walls
    levels, of = np.unique(beta, return_inverse=True)
    island = (result > 0) & (alpha > stiffness_limit(loop, levels)[of])
    return np.where(island, -_NARROW, result)


def _spare(rig: Loop, wish: DesignTarget, alpha: Floats, beta: Floats, above: float) -> Floats:
    """Return the margins of stable walls to the allowed settling time and overshoot."""
    bands, swings = (0.02,) * (wish.settling_s is not None), wish.overshoot is not None
    longest = (wish.settling_s or math.inf) / rig.sampling_period_s * math.exp(-max(above, _NOTHING))
    found = transient_costs(
        rig.normalised_loop, alpha, beta, bands, overshoot=swings, quiet=_FAINT * OVERSHOOT_SEEN, cutoff=1.01 * longest
    )
    spare = np.full(len(alpha), np.inf)
    if wish.settling_s is not None:
        # a response that is given up settles too late
        settled = np.nan_to_num(found["settle_2pct"], nan=math.inf) * rig.sampling_period_s
        spare = np.maximum(math.log(wish.settling_s) - np.log(settled), _NOTHING)
    if wish.overshoot is not None:
        spare = np.fmin(spare, wish.overshoot + OVERSHOOT_SEEN - found["overshoot"])
    return np.asarray(np.nan_to_num(spare, nan=_NOTHING))

"""Requirements on a wall, and the margin by which a rig meets them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Floats
from pipeline.surface.physical_loop import Loop
from pipeline.theory.boundary import boundary, soft_interval, stiffness_limit
from pipeline.theory.cases import Case, costs_of_walls
from pipeline.theory.crossings import first_branch
from pipeline.theory.poles import spectral_radius
from pipeline.theory.settling_overshoot import transient_costs

OVERSHOOT_SEEN = 1e-3
"""Largest overshoot that counts as no overshoot. In a sampled loop, no optimal wall has exactly zero overshoot."""

_FAINT = 0.1
"""Amplitude down to which the motion is simulated, relative to `OVERSHOOT_SEEN`."""

_DAMPINGS, _STIFFNESSES = 32, 20
_NARROWER = 2
"""Numbers of dampings and stiffnesses in the first grid of walls, and number of finer grids after it. The dampings span
three decades, the stiffnesses two."""

_ASIDE, _BESIDE = 2.0, 97
"""Largest factor of the damping in the search for the fastest wall, and number of walls in this search."""

_SOFTEST, _SOFTER = 1e-3, 16
"""Smallest stiffness of the softer walls that are checked for a wall, relative to this wall, and number of softer
walls."""

_NARROW = 1e-6
"""Magnitude of the negative margin of a wall above an unstable interval, if none of the checked softer walls lies in
the interval."""

_BISECTIONS = 40
"""Number of bisections for the frequency at which a damping becomes unstable. The relative error is then 1e-12."""

_NOTHING = -10.0
"""Smallest margin of a stable wall, used if its settling time is too long to be computed. The largest margin is minus
this value."""


@dataclass(frozen=True)
class DesignTarget:
    """Requirements on a wall.

    Parameters
    ----------
    stiffness : float, optional
        Stiffness K [N/m, Nm/rad]. It is arbitrary if omitted.
    settling_s : float, optional
        Longest settling time to 2 % [s].
    overshoot : float, optional
        Largest overshoot as a fraction. A value below 0.001 counts as no overshoot.
    margin : float
        Gain margin >= 1. The wall must be stable with ``margin`` times its stiffness.
    tolerance : float
        Relative error of mass, damping and delay for which the requirements must still be met, from 0 to 0.9.

    Raises
    ------
    ParameterError
        If a number is out of range, or if neither a stiffness nor a settling time is given.
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
            raise ParameterError(f"overshoot = {self.overshoot}: expected a fraction from 0 to 1, such as 0.05.")
        if not 1 <= self.margin < math.inf:
            raise ParameterError(f"margin = {self.margin}: expected 1 or more.")
        if not 0 <= self.tolerance <= 0.9:
            raise ParameterError(f"tolerance = {self.tolerance}: expected a fraction from 0 to 0.9, such as 0.05.")


@dataclass(frozen=True)
class RigWall:
    """Wall of a rig that is closest to the requirements, with its margin ``room``, which is not negative if they are
    met."""

    stiffness: float
    damping: float
    room: float


def best_wall(loop: Loop, wish: DesignTarget, *, enough: bool = False) -> RigWall:
    """Find the wall that meets the requirements with the largest margin.

    If ``enough`` is true, the search ends as soon as a wall meets the requirements.

    The margin of a wall is the smallest of three numbers: the negative logarithm of the spectral radius (at ``margin``
    times the stiffness), the logarithm of the ratio of the allowed to the actual settling time, and the allowed minus
    the actual overshoot. A wall counts as stable only if all softer walls with its damping are also stable, because a
    device that comes into contact passes through the softer walls.
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
    """Find the fastest wall with the stiffness of the best wall. Only nearby walls that meet the requirements are
    considered."""
    B = best.damping * np.geomspace(1 / _ASIDE, _ASIDE, _BESIDE)
    walls = np.column_stack([np.full(len(B), best.stiffness), B])
    room = _room(_corners(loop, wish.tolerance), wish, walls, -math.inf)
    settling = costs_of(loop, walls, "settle_2pct")["settle_2pct"]
    settling = np.where((room >= 0) & np.isfinite(settling), settling, np.inf)
    at = int(np.argmin(settling))
    return RigWall(best.stiffness, float(B[at]), float(room[at])) if settling[at] < np.inf else best


def costs_of(loop: Loop, walls: object, *criteria: str) -> dict[str, Floats]:
    """Compute the costs of walls, given as rows of stiffness and damping. A missing cost is NaN."""
    case = Case(loop.normalised_loop, loop.units)
    return costs_of_walls(case, np.asarray(walls, dtype=np.float64), criteria).costs


def stiffness_max(loop: Loop) -> float:
    """Compute the largest stable stiffness."""
    return boundary(loop.normalised_loop, 16).alpha_max * loop.units.stiffness


def decay(loop: Loop, wish: DesignTarget) -> float:
    """Compute the largest decay rate [1/s] of the slowest mode over the walls of the first grid.

    This rate is faster to compute than the margin. A large rate implies early settling and little overshoot.
    """
    unit = loop.units
    K, B = np.array(list(product(*_first_look(loop, wish)))).T
    with np.errstate(divide="ignore"):
        rates = -np.log(spectral_radius(loop.normalised_loop, K / unit.stiffness, B / unit.damping))
    return float(rates.max()) / loop.sampling_period_s


def _first_look(loop: Loop, wish: DesignTarget) -> tuple[Floats, Floats]:
    """Return the stiffnesses and the dampings of the first grid of walls."""
    largest = 2.5 * loop.apparent().mass / loop.sampling_period_s / (0.5 + loop.delay_samples)
    largest = max(largest, _largest_damping(loop))
    B = np.append(0.0, np.geomspace(1e-3 * largest, largest, _DAMPINGS))
    if wish.stiffness is not None:
        return np.array([wish.stiffness]), B
    stiffest = stiffness_max(loop)
    return np.geomspace(1e-2 * stiffest, stiffest, _STIFFNESSES), B


def _largest_damping(loop: Loop) -> float:
    """Estimate the largest stable B of a device with lag.

    The result is |(m s + b)(tau s + 1)| at the frequency w with a phase of -pi. With a delay of d + 1/2 samples, this
    frequency follows from atan(w m/b) + atan(w tau) + w (d + 1/2) T = pi.
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
    """Return points between the two neighbours of a value on a grid axis."""
    if len(axis) == 1:
        return axis
    i = int(np.argmin(np.abs(axis - value)))
    return np.linspace(axis[max(i - 1, 0)], axis[min(i + 1, len(axis) - 1)], 13)


def _corners(loop: Loop, tolerance: float) -> list[Loop]:
    """Return the rigs at the corners of the tolerances. The load of a mode keeps its share of the mass."""
    if tolerance == 0:
        return [loop]
    rigs = []
    for m, b, d in product((1 - tolerance, 1 + tolerance), repeat=3):
        changes: dict[str, float | None] = {"mass": m * loop.mass, "delay_samples": d * loop.delay_samples}
        if loop.mode:
            changes["mode.mass"] = m * loop.mode.mass
        try:
            rigs.append(loop.with_damping(b * loop.damping).replace(changes))
        except ParameterError as error:
            numbers = f"mass {m * loop.mass:.4g}, damping {b * loop.damping:.4g}, delay {d * loop.delay_samples:.4g}"
            raise ParameterError(f"tolerance = {tolerance:g}: leads to {numbers} samples. {error}") from None
    return rigs


def _room(rigs: Sequence[Loop], wish: DesignTarget, walls: Floats, above: float) -> Floats:
    """Compute the margin of each wall for the worst rig, shape (n,). Values below ``above`` are not exact, nor is -inf
    if a wall is stable."""
    room = np.min([_room_of_stable(rig, wish, walls, above) for rig in rigs], axis=0)
    if room.max() > -math.inf:
        return np.asarray(room)
    return np.asarray(np.min([_room_of_unstable(rig, wish, walls) for rig in rigs], axis=0))


def _room_of_stable(rig: Loop, wish: DesignTarget, walls: Floats, above: float) -> Floats:
    """Compute the margins of walls for a rig, shape (n,). They are -inf if a wall or a softer wall is unstable."""
    loop, room = rig.normalised_loop, np.full(len(walls), -math.inf)
    alpha, beta = walls.T / [[rig.units.stiffness], [rig.units.damping]]
    levels, of = np.unique(beta, return_inverse=True)
    stable = np.flatnonzero(wish.margin * alpha < soft_interval(loop, levels)[1][of])
    if len(stable) and (wish.settling_s is not None or wish.overshoot is not None):
        room[stable] = np.minimum(-_NOTHING, _spare(rig, wish, alpha[stable], beta[stable], above))
    elif len(stable):
        room[stable] = -np.log(spectral_radius(loop, wish.margin * alpha[stable], beta[stable]))
    return room


def _room_of_unstable(rig: Loop, wish: DesignTarget, walls: Floats) -> Floats:
    """Compute the margin of each wall for a rig, shape (n,). It is used if no wall is stable for all rigs."""
    alpha, beta = walls.T / [[rig.units.stiffness], [rig.units.damping]]
    with np.errstate(divide="ignore"):
        left = -np.log(spectral_radius(rig.normalised_loop, wish.margin * alpha, beta))
    left = _softer(rig.normalised_loop, wish.margin * alpha, beta, left)
    if wish.settling_s is None and wish.overshoot is None:
        return left
    # Unstable walls rank below all stable walls. The best of them is a wall at its limit, whose radius rounds below 1.
    return np.where(left > 0, _NOTHING, left + 2 * _NOTHING)


def _softer(loop: NormalisedLoop, alpha: Floats, beta: Floats, left: Floats) -> Floats:
    """Compute the negative logarithm of the spectral radius for each wall, shape (n,). If softer walls are unstable,
    the smallest value over the wall and the softer walls is used."""
    if first_branch(loop) is not None:  # all softer walls are stable
        return left
    share = np.geomspace(_SOFTEST, 1.0, _SOFTER, endpoint=False)
    with np.errstate(divide="ignore"):
        softer = -np.log(spectral_radius(loop, np.outer(alpha, share).ravel(), np.repeat(beta, _SOFTER)))
    least = softer.reshape(len(alpha), _SOFTER).min(axis=1)
    result = np.where(least < 0, np.minimum(left, least), left)
    # an unstable interval may be narrower than the spacing of the softer walls
    levels, of = np.unique(beta, return_inverse=True)
    island = (result > 0) & (alpha > stiffness_limit(loop, levels)[of])
    return np.where(island, -_NARROW, result)


def _spare(rig: Loop, wish: DesignTarget, alpha: Floats, beta: Floats, above: float) -> Floats:
    """Compute the margins of stable walls to the allowed settling time and overshoot."""
    bands, swings = (0.02,) * (wish.settling_s is not None), wish.overshoot is not None
    longest = (wish.settling_s or math.inf) / rig.sampling_period_s * math.exp(-max(above, _NOTHING))
    found = transient_costs(
        rig.normalised_loop, alpha, beta, bands, overshoot=swings, quiet=_FAINT * OVERSHOOT_SEEN, cutoff=1.01 * longest
    )
    spare = np.full(len(alpha), np.inf)
    if wish.settling_s is not None:
        # if the simulation was stopped early, the response settles too late
        settled = np.nan_to_num(found["settle_2pct"], nan=math.inf) * rig.sampling_period_s
        spare = np.maximum(math.log(wish.settling_s) - np.log(settled), _NOTHING)
    if wish.overshoot is not None:
        spare = np.fmin(spare, wish.overshoot + OVERSHOOT_SEEN - found["overshoot"])
    return np.asarray(np.nan_to_num(spare, nan=_NOTHING))

"""Determine whether a rig can render a required wall, and find the smallest changes that make it possible.

A rig is a device with its control loop. The size of a change is the logarithm of the ratio of the larger to the smaller
of the two values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations, count, product
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.base.json_object import JsonObject
from pipeline.device.parameters import Motion, unit_of
from pipeline.rig.quantities import Quantity, present
from pipeline.rig.wish import DesignTarget, RigWall, best_wall, costs_of, decay, quickest, stiffness_max
from pipeline.surface.physical_loop import Loop

if TYPE_CHECKING:  # loading it takes longer than computing a design
    import pandas as pd

_LOOKS = 8
"""Number of points between the rig and the largest change at which the margin is evaluated before bisection."""

_SHOWN = 6
"""Largest number of changes in the summary. The JSON document contains all changes."""

_EDGE = 5
"""Number of evaluations between the last valid rig and a change that makes the rig invalid, such as a cut-off above
half the sampling rate."""

_TOP_LOOKS = 8
"""Largest number of golden-section evaluations in the search for a bracketed maximum."""

_GOLDEN = 0.5 * (3 - math.sqrt(5))
"""Fraction at which a golden-section search divides the larger part of an interval."""

_HALVINGS = 9
"""Number of bisections of the interval between two points. The resulting change is accurate to 1e-3 in its logarithm
(0.1 %)."""

_NUDGE = 0.02
"""Trial change of the logarithm of a quantity. It shows in which direction the quantity increases the margin."""

_WORTH = 0.95
"""Largest size of a pair of changes, relative to the smaller single change, for which the pair is reported."""

_PAIRED = 4
"""Number of quantities that are combined in pairs. These quantities increase the margin most."""

_CLIMBED = 3
"""Number of pairs of quantities for which hill climbing starts. These pairs have the largest margins at the best point
of a coarse grid."""

_UPHILL = 40
"""Largest number of rigs that one run of hill climbing evaluates."""

_DIFFERENCE = 1e-4
"""Relative step of a numerical derivative. Limits are accurate to 1e-9, and sensitivities therefore to about 1e-7."""


@dataclass(frozen=True)
class Change:
    """Joint change of quantities, with their old and new values and units by name, and with the resulting wall."""

    before: dict[str, float]
    after: dict[str, float]
    units: dict[str, str]
    size: float
    wall: dict[str, float | None]


@dataclass(frozen=True)
class DesignAnswer:
    """Result of `design` with sensitivities as rows instead of a data frame, so that pandas is not needed."""

    wish: DesignTarget
    reached: bool
    wall: dict[str, float | None]
    stiffness_reached: float | None
    changes: tuple[Change, ...]
    out_of_reach: dict[str, str]
    sensitivities: Any
    left_out: tuple[str, ...] = ()
    motion: Motion = "translation"

    def __str__(self) -> str:
        """Return a summary in lines of text: whether the rig meets the requirements, the wall, and the changes."""
        k, wanted, reached = unit_of("stiffness", self.motion), self.wish.stiffness, self.reached
        lines = [] if wanted is None else [f"Wanted: K = {wanted:.5g} {k}."]
        largest = f" Largest K that can be reached: {self.stiffness_reached:.5g} {k}." if self.stiffness_reached else ""
        lines.append(f"Reached: {'yes' if reached else 'no'}." + (largest if wanted is not None else ""))
        lines.append(f"{'Wall' if reached else 'Nearest wall'}: {_text(self.wall, self.motion)}")
        lines += ["", "Changes that meet the requirements, smallest first:"] if self.changes else []
        for change in self.changes[:_SHOWN]:
            after = change.after.items()
            parts = (f"{name} {change.before[name]:.4g} -> {new:.4g} {change.units[name]}" for name, new in after)
            lines.append(f"  {' and '.join(parts)}: {_text(change.wall, self.motion)}")
        if len(self.changes) > _SHOWN:
            lines.append(f"  ({len(self.changes) - _SHOWN} more: --json)")
        if any("sampling_period_s" in change.after for change in self.changes[:_SHOWN]):
            lines.append(
                "  (The delay keeps its number of samples, so a shorter sampling period also shortens the delay."
            )
            lines.append(
                "  If the delay is fixed in seconds, write a device file with `identify --period`, or keep "
                "sampling_period_s.)"
            )
        lines += [f"  {name} alone: {why}" for name, why in self.out_of_reach.items()]
        if not reached and not self.changes:
            lines.append("No single change meets the requirements, and no pair of changes that meets them was found.")
        return "\n".join(lines)

    def document(self) -> JsonObject:
        """Return the result as a JSON document."""
        rows = [{name: None if value != value else value for name, value in row.items()} for row in self._rows()]
        return asdict(replace(self, sensitivities=())) | {"sensitivities": rows}

    def _rows(self) -> list[JsonObject]:
        return list(self.sensitivities)


@dataclass(frozen=True)
class Design(DesignAnswer):
    """Result of `design`.

    Parameters
    ----------
    wish : DesignTarget
        Requirements on the wall.
    reached : bool
        Whether the unchanged rig meets the requirements.
    wall : dict
        Wall of the unchanged rig that is closest to the requirements, or the fastest wall if only overshoot is
        limited. Its entries are ``stiffness``, ``damping``, ``stiffness_limit`` at this damping, ``settling_s``,
        ``settling_samples`` and ``overshoot``. Entries are None if the wall is not stable.
    stiffness_reached : float or None
        Largest K [N/m, Nm/rad] that meets the other requirements. If these requirements include a settling time, this
        is the admissible K that is closest to the required K.
    changes : tuple of Change
        Single and paired changes that meet the requirements, in order of size. The size is the Euclidean norm of the
        logarithmic changes.
    out_of_reach : dict
        Quantities whose change alone is not sufficient, with the range that was searched. Pairs are searched along
        lines. If no change is found, pairs are also searched by hill climbing from the best point of a coarse grid. The
        search may miss a solution.
    sensitivities : pandas.DataFrame
        For each ``quantity`` its ``value`` and ``unit``, the largest stable stiffness ``stiffness_max`` and the
        derivative ``stiffness_max_per_unit``. Two columns state the change in percent per percent of the quantity:
        ``stiffness_max_percent``, and ``settling_percent`` for the settling time of ``wall``.
    left_out : tuple of str
        Parts of the rig that theory does not include.
    motion : str
        Type of motion, which determines the units of K and B.
    """

    sensitivities: pd.DataFrame

    def _rows(self) -> list[JsonObject]:
        rows: list[JsonObject] = self.sensitivities.to_dict("records")
        return rows


def design(
    loop: Loop,
    stiffness: float | None = None,
    *,
    settling_s: float | None = None,
    overshoot: float | None = None,
    margin: float = 1.0,
    tolerance: float = 0.0,
    keep: Sequence[str] = (),
) -> Design:
    """Determine whether a rig can render a required wall. If not, find the smallest changes that make it possible.

    Parameters
    ----------
    loop : Loop
        Rig. The ``operator`` of the loop, if any, is a hand on the device.
    stiffness, settling_s, overshoot, margin, tolerance
        Requirements, as in `DesignTarget`.
    keep : sequence of str
        Names of quantities that cannot be changed (`quantities.QUANTITIES`).

    Raises
    ------
    ParameterError
        If a number is out of range, or if a name in ``keep`` is unknown.

    Examples
    --------
    >>> rig = Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=4)
    >>> answer = design(rig, 20000.0)
    >>> answer.reached, [list(change.after) for change in answer.changes][0]
    (False, ['sampling_period_s', 'delay_samples'])
    """
    import pandas as pd

    found = answer(loop, DesignTarget(stiffness, settling_s, overshoot, margin, tolerance), keep)
    return Design(**vars(found) | {"sensitivities": pd.DataFrame(found.sensitivities)})


def answer(loop: Loop, wish: DesignTarget, keep: Sequence[str] = ()) -> DesignAnswer:
    """Return the result of `design` with sensitivities as rows. Pandas is not needed, and scipy only for hill
    climbing."""
    stiffness = wish.stiffness
    quantities = present(loop, tuple(keep))
    best = best_wall(loop, wish)
    changes: list[Change] = []
    out_of_reach: dict[str, str] = {}
    if best.room < 0:
        changes, out_of_reach = _changes(loop, wish, quantities, best)
    reached = _stiffness_reached(loop, wish, best)
    if best.room < 0 and reached is not None:
        best = best_wall(loop, replace(wish, stiffness=reached))
    elif best.room >= 0 and wish.settling_s is None and wish.overshoot is not None:
        best = quickest(loop, wish, best)
    return DesignAnswer(
        wish=wish,
        reached=reached is not None and (stiffness is None or reached >= stiffness),
        wall=_wall(loop, best),
        stiffness_reached=reached,
        changes=tuple(sorted(changes, key=lambda change: change.size)),
        out_of_reach=out_of_reach,
        sensitivities=_sensitivities(loop, quantities, best),
        left_out=loop.left_out,
        motion=loop.motion,
    )


def _text(wall: dict[str, float | None], motion: Motion) -> str:
    """Describe a wall in a line of text."""
    K, limit, k = wall["stiffness"] or 0.0, wall["stiffness_limit"], unit_of("stiffness", motion)
    words = [f"K = {K:.5g} {k}, B = {wall['damping']:.4g} {unit_of('damping', motion)}"]
    words.append("unstable" if limit is None or limit < K else f"limit {limit:.5g} {k}")
    if (settling := wall["settling_s"]) is not None:
        words.append(f"settles in {settling:.3g} s")
    if (overshoot := wall["overshoot"]) is not None:
        words.append(f"overshoot {100 * overshoot:.2g} %")
    return ", ".join(words)


def _wall(loop: Loop, best: RigWall) -> dict[str, float | None]:
    """Compute the properties of the wall that is closest to the requirements."""
    K, B = best.stiffness, best.damping
    limit = float(loop.linear_limits(np.array([B]))[0])
    costs = costs_of(loop, [[K, B]], "settle_2pct", "overshoot").values()
    wall = {"stiffness": K, "damping": B, "stiffness_limit": None if math.isnan(limit) else limit}
    samples, overshoot = (float(cost[0]) if math.isfinite(cost[0]) else None for cost in costs)
    settling = None if samples is None else samples * loop.sampling_period_s
    return wall | {"settling_s": settling, "settling_samples": samples, "overshoot": overshoot}


def _stiffness_reached(loop: Loop, wish: DesignTarget, best: RigWall) -> float | None:
    """Find the stiffness closest to the required stiffness at which the other requirements are met."""
    wanted = wish.stiffness
    if wanted is None:
        return best.stiffness if best.room >= 0 else None
    upward = best.room >= 0
    side = -1.0 if upward else 1.0

    def room(x: float) -> float:
        return side * best_wall(loop, replace(wish, stiffness=wanted * math.exp(x)), enough=not upward).room

    ends = [-side * math.log(100.0) * i / (2 * _LOOKS) for i in range(1, 2 * _LOOKS + 1)]
    turn = _turn(room, side * best.room, ends)
    if turn is None:
        return wanted * 100.0 if upward else None
    return wanted * math.exp(turn[0 if upward else 1])


def _turn(room: Callable[[float], float], at_0: float, looks: Sequence[float]) -> tuple[float, float] | None:
    """Find a narrow interval in which a margin that is negative at 0 becomes positive.

    Return None if the margin is negative at all given points and at the maxima between them.
    """
    trail = [(0.0, at_0)]
    for behind in looks:
        over, edge = room(behind), behind
        for _ in range(_EDGE if over == -math.inf < trail[-1][1] else 0):
            # the requirements may be met only just before the rigs become invalid
            middle = 0.5 * (trail[-1][0] + edge)
            found = room(middle)
            if found >= 0:
                behind, over = middle, found
                break
            if found == -math.inf:
                edge = middle
            else:
                trail.append((middle, found))
        if over < 0 and len(trail) > 1 and trail[-1][1] > max(trail[-2][1], over):
            # because the margin jumps, it may become positive and then negative again between two points
            top = _top(room, trail[-2][0], trail[-1], behind)
            if top[1] >= 0:
                trail.pop()
                behind, over = top
        if over >= 0:
            return _narrowed(room, trail[-1], (behind, over))
        trail.append((behind, over))
    return None


def _top(
    room: Callable[[float], float], before: float, best: tuple[float, float], behind: float
) -> tuple[float, float]:
    """Search for the best point between two ends by golden-section search. Return this point and its margin.

    The search stops as soon as a margin is not negative.
    """
    x, highest = best
    for _ in range(_TOP_LOOKS):
        ahead = abs(behind - x) > abs(x - before)
        trial = x + _GOLDEN * ((behind if ahead else before) - x)
        found = room(trial)
        if found > highest:
            before, behind = (x, behind) if ahead else (before, x)
            x, highest = trial, found
        else:
            before, behind = (before, trial) if ahead else (trial, behind)
        if highest >= 0:
            break
    return x, highest


def _narrowed(
    room: Callable[[float], float], outside: tuple[float, float], inside: tuple[float, float]
) -> tuple[float, float]:
    """Return the ends of a narrow interval around the zero of a margin, which is negative at the point ``outside``.

    The interval is narrowed by regula falsi (Illinois). Every third step is a bisection because margins may jump.
    """
    (before, short), (behind, over) = outside, inside
    narrow = abs(behind - before) / 2**_HALVINGS
    for number in count(1):  # terminates because every third step halves the interval
        if abs(behind - before) <= narrow:
            break
        share = short / (short - over) if number % 3 and math.isfinite(short) else 0.5
        middle = before + min(max(share, 0.05), 0.95) * (behind - before)
        found = room(middle)
        if found < 0:
            before, short, over = middle, found, 0.5 * over
        else:
            behind, over, short = middle, found, 0.5 * short
    return before, behind


def _room_of(
    loop: Loop, wish: DesignTarget, quantities: Sequence[Quantity], x: Sequence[float], *, roughly: bool = False
) -> float:
    """Return the margin after a change of quantities by the factors exp(x).

    The search for the largest margin ends as soon as a wall meets all requirements. The margin of an invalid rig is
    -inf. With ``roughly``, return the `decay` of the rig, by which distant points are compared.
    """
    try:
        for quantity, change in zip(quantities, x, strict=True):
            loop = quantity.changed(loop, change)
        return decay(loop, wish) if roughly else best_wall(loop, wish, enough=True).room
    except ParameterError:
        return -math.inf


def _changes(
    loop: Loop, wish: DesignTarget, quantities: Sequence[Quantity], best: RigWall
) -> tuple[list[Change], dict[str, str]]:
    """Find the single and paired changes that meet the requirements, and the quantities whose change alone is not
    sufficient.

    If there is no such change, also search for changes of pairs far from the values of the rig.
    """
    found: list[Change] = []
    out_of_reach, helps = {}, {}
    for quantity in quantities:
        rooms = [_room_of(loop, wish, [quantity], [sign * _NUDGE]) for sign in (-1, 1)]
        if max(rooms) > best.room:
            helps[quantity] = (max(rooms) - best.room) * (1.0 if rooms[1] > rooms[0] else -1.0)
        sizes = []
        for sign, factor in zip((-1.0, 1.0), quantity.factors, strict=True):
            size = _smallest(loop, wish, best.room, [quantity], [sign], abs(math.log(factor)))
            sizes += [] if size is None else [sign * size]
        if sizes:
            found.append(_change(loop, wish, [quantity], [min(sizes, key=abs)]))
        else:
            ends = ((quantity.read(loop) or 0.0) + quantity.scale(loop) * (f - 1) for f in quantity.factors)
            low, high = (f"{end:.3g}" for end in ends)
            out_of_reach[quantity.name] = (
                f"the requirements are not met anywhere between {low} and {high} {quantity.unit(loop)}".rstrip()
            )
    most = sorted(helps, key=lambda quantity: -abs(helps[quantity]))[:_PAIRED]
    for pair in combinations(most, 2):
        way = np.array([helps[quantity] for quantity in pair])
        way /= math.hypot(*way)
        reach = min(abs(math.log(q.factors[int(w > 0)])) / abs(w) for q, w in zip(pair, way, strict=True) if w)
        alone = [change.size for change in found if set(change.after) < {quantity.name for quantity in pair}]
        size = _smallest(loop, wish, best.room, pair, way.tolist(), reach)
        if size is not None and size < _WORTH * min(alone, default=math.inf):
            found.append(_change(loop, wish, pair, (size * way).tolist()))
    if not found:
        starts = [(*_best_of_grid(loop, wish, pair), pair) for pair in combinations(quantities, 2)]
        for _, start, pair in sorted(starts, key=lambda place: -place[0])[:_CLIMBED]:
            x = _uphill(loop, wish, pair, start)
            if x is not None:
                whole = math.hypot(*x)
                size = _smallest(loop, wish, best.room, pair, [part / whole for part in x], whole) or whole
                found.append(_change(loop, wish, pair, [part * size / whole for part in x]))
    return found, out_of_reach


def _best_of_grid(loop: Loop, wish: DesignTarget, pair: Sequence[Quantity]) -> tuple[float, list[float]]:
    """Return the margin and the changes at the point of a coarse grid at which the motion decays fastest."""
    share = (np.arange(2, _LOOKS + 1, 2) / _LOOKS) ** 2
    axes = ([float(x) for factor in quantity.factors for x in math.log(factor) * share] for quantity in pair)
    best = max(product(*axes), key=lambda x: _room_of(loop, wish, pair, x, roughly=True))
    return _room_of(loop, wish, pair, best), list(best)


def _uphill(loop: Loop, wish: DesignTarget, pair: Sequence[Quantity], start: list[float]) -> list[float] | None:
    """Search for changes of two quantities that meet the requirements, by hill climbing. Return None if none is
    found."""
    from scipy.optimize import minimize

    def short(x: Sequence[float]) -> float:
        return -_room_of(loop, wish, pair, x)

    def stop(intermediate_result: Any) -> None:
        if intermediate_result.fun <= 0:
            raise StopIteration

    bounds = [[math.log(factor) for factor in quantity.factors] for quantity in pair]
    options = {"maxfev": _UPHILL}
    found = minimize(short, start, method="Nelder-Mead", bounds=bounds, callback=stop, options=options)
    return list(found.x) if found.fun <= 0 else None


def _smallest(
    loop: Loop, wish: DesignTarget, room: float, quantities: Sequence[Quantity], way: Sequence[float], reach: float
) -> float | None:
    """Return the size of the smallest change along a direction that meets the requirements, or None."""
    looks = reach * (np.arange(1, _LOOKS + 1) / _LOOKS) ** 2

    def room_at(size: float) -> float:
        return _room_of(loop, wish, quantities, [size * part for part in way])

    turn = _turn(room_at, room, looks.tolist())
    return None if turn is None else turn[1]


def _change(loop: Loop, wish: DesignTarget, quantities: Sequence[Quantity], x: Sequence[float]) -> Change:
    rig = loop
    for quantity, part in zip(quantities, x, strict=True):
        rig = quantity.changed(rig, part)
    return Change(
        before={quantity.name: quantity.read(loop) or 0.0 for quantity in quantities},
        after={quantity.name: quantity.read(rig) or 0.0 for quantity in quantities},
        units={quantity.name: quantity.unit(loop) for quantity in quantities},
        size=math.hypot(*x),
        wall=_wall(rig, best_wall(rig, wish)),
    )


def _sensitivities(loop: Loop, quantities: Sequence[Quantity], best: RigWall) -> tuple[dict[str, float | str], ...]:
    """Compute the sensitivities of the largest stable stiffness and of the settling time of the nearest wall."""
    rows = []
    largest, wall = stiffness_max(loop), [[best.stiffness, best.damping]]
    for quantity in quantities:
        ends = -_DIFFERENCE if quantity.read(loop) else 0.0, _DIFFERENCE  # a quantity that is 0 cannot decrease
        sides = [quantity.changed(loop, end) for end in ends]
        limits = [stiffness_max(side) for side in sides]
        samples = [float(costs_of(side, wall, "settle_2pct")["settle_2pct"][0]) for side in sides]
        settling = [count * side.sampling_period_s for count, side in zip(samples, sides, strict=True)]
        values = [quantity.read(side) or 0.0 for side in sides]
        rise = math.log(limits[1] / limits[0]) / (ends[1] - ends[0])
        row: dict[str, float | str] = {
            "quantity": quantity.name,
            "value": quantity.read(loop) or 0.0,
            "unit": quantity.unit(loop),
            "stiffness_max_per_unit": (limits[1] - limits[0]) / (values[1] - values[0]),
            "stiffness_max_percent": rise,
            "settling_percent": math.log(settling[1] / settling[0]) / (ends[1] - ends[0]),
            "stiffness_max": largest,
        }
        rows.append(row)
    return tuple(rows)

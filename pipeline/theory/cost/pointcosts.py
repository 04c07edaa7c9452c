"""Which costs of single points are computed together, by name."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.loop.device_loop import DeviceLoop
from pipeline.loop.loop import Loop
from pipeline.records.batch import Floats
from pipeline.theory.cost.energy import WEIGHTS, energy_costs
from pipeline.theory.cost.march import step_transients
from pipeline.theory.cost.transient import QUIET, transient_costs

SETTLING = ("settle_1pct", "settle_2pct", "settle_5pct")
"""Settling times; a test holds them equal to those of `records.models`, whose import takes as long as a whole map."""

_MANY = 256
"""Points from which on the march in blocks is faster."""

_LARGEST_DELAY = 32
"""Delay up to which its buffers fit a cache."""

STEP_ENERGIES = tuple(f"energy_step_w{w}" for w in WEIGHTS)
IMPULSE_ENERGIES = tuple(f"energy_impulse_w{w}" for w in WEIGHTS)


def point_costs_by_name(
    loop: Loop,
    alpha: Floats,
    beta: Floats,
    names: Sequence[str],
    longest: int,
    quiet: float = QUIET,
    *,
    part: bool = False,
) -> dict[str, Floats]:
    """Return costs of stable points by name, computing no more than what is asked for.

    Parameters
    ----------
    loop : Loop
    alpha, beta : float64, shape (n,)
        Stable points with alpha + gamma > 0.
    names : sequence of str
        Settling times, overshoot and energy costs, each also with ``_discrete`` appended.
    longest : int
        Samples after which a response that still moves gets NaN for settling time and overshoot.
    quiet : float
        Deviation below which a response without overshoot is no longer followed.
    part : bool
        Whether the points are part of very many: then their number does not choose the method, since the march in
        blocks tells costs of slow points that the plain one gives up.
    """
    bases = {name.removesuffix("_discrete") for name in names}
    result: dict[str, Floats] = {}
    for signal, energies in (("step", STEP_ENERGIES), ("impulse", IMPULSE_ENERGIES)):
        if bases & set(energies):
            result |= energy_costs(loop, alpha, beta, signal)
    bands = [float(name.removeprefix("settle_").removesuffix("pct")) / 100 for name in SETTLING if name in bases]
    if not bands and "overshoot" not in bases:
        pass
    elif len(alpha) >= (1 if part else _MANY) and len(bands) == 1 and _can_march(loop):
        found = step_transients(loop, alpha, beta, bands[0], longest=longest, quiet=quiet)
        settle = f"settle_{100 * bands[0]:g}pct"
        result |= {settle: found["settle"], f"{settle}_discrete": found["settle_discrete"]}
        result |= {name: found[name] for name in ("overshoot", "overshoot_discrete")}
    else:
        result |= transient_costs(
            loop,
            alpha,
            beta,
            bands,
            overshoot="overshoot" in bases,
            continuous=any(name in (*SETTLING, "overshoot") for name in names),
            longest=longest,
            quiet=quiet,
        )
    return {name: result[name] for name in names}


def _can_march(loop: Loop) -> bool:
    return not isinstance(loop, DeviceLoop) and loop.oldest_force == loop.delay <= _LARGEST_DELAY

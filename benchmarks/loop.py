"""Loops that are not ideal: how right limits and costs are, and how long they take.

    python benchmarks/loop.py [--quick]

Limits of 300 random and 60 extreme devices (`tests/support/general_devices.py`) are held against poles in 60 digits at
K (1 - 1e-9) and K (1 + 1e-9); the general loop against the ideal one; then processor times, of the simulator too.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from general_devices import EXTREMES, Example, ManyDigits, random_device

from pipeline.device_data.devices import load_device
from pipeline.loop.device_loop import DeviceLoop, Vibration, general, loop_of, wall_units
from pipeline.loop.loop import Loop
from pipeline.records.loop_parts import Butterworth, Friction, LoopParts, Mode, Operator
from pipeline.records.simulation_parts import SimulationParts
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.theory.cost.energy import energy_costs
from pipeline.theory.cost.settling_overshoot import transient_costs
from pipeline.theory.cost.theory_map import CostMap
from pipeline.theory.device.crossings import branches, on_circle
from pipeline.theory.device.outline import limits, outline
from pipeline.theory.stability.boundary import boundary
from pipeline.theory.stability.region import stiffness_limit

RICH = {
    "lag": 1.5,
    "mode": Vibration(0.3, 0.5, 0.01, sensor_far=False),
    "velocity": Butterworth(kind="butterworth", order=2, cutoff_hz=0.08),
}
"""Lag, mode and filter of a device whose map and boundary are timed, d = 3."""


LINEAR: dict[str, Any] = {
    "velocity": Butterworth(kind="butterworth", order=4, cutoff_hz=80.0),
    "actuator_lag_s": 1e-3,
    "force_gain": 0.9,
    "mode": Mode(frequency_hz=60.0, damping_ratio=0.03, mass=0.1),
    "operator": Operator(mass=0.15, damping=5.0, stiffness=300.0),
}
HIDDEN: dict[str, Any] = {
    "one_sided_wall": True,
    "constant_force": 0.5,
    "gain_error": 0.02,
    "clock_error": 1e-4,
    "lost_rows": 0.01,
    "held_samples": 0.01,
    "repeated_rows": 0.01,
    "ramp_samples": 5,
}
"""All that the simulator knows of a device."""


def right(example: Example, rng: np.random.Generator) -> bool | None:
    """Whether the limit at a random damping is right to 1e-9; None without one."""
    loop = general(loop_of(*example.arguments))
    found, units = outline(loop, 8), wall_units(example.mass, example.sampling_period_s, example.parts)
    if not len(found.beta):
        return None
    beta = found.beta[0] + (found.beta[-1] - found.beta[0]) * rng.uniform(0.05, 0.95)
    alpha = limits(loop, np.array([beta])).alpha[0]
    if not np.isfinite(alpha):
        return None
    K, B = float(alpha * units.stiffness), float(beta * units.damping)
    truth = ManyDigits(example)
    return [truth.stable(K * (1 + side * 1e-9), B) for side in (-1, 1)] == [True, False]


def many_limits(random: int, extreme: int) -> None:
    rng = np.random.default_rng(17)
    with mp.workdps(60):
        for kind, count in (("", random), *((name, extreme) for name in EXTREMES)):
            verdicts = [right(random_device(rng, kind), rng) for _ in range(count)]
            told = [verdict for verdict in verdicts if verdict is not None]
            print(f"limits, {kind or 'random'}: {sum(told)} of {len(told)} right to 1e-9, {count - len(told)} without")


def like_the_ideal_one() -> None:
    worst = dict.fromkeys(("limit", "energy", "settling time, overshoot"), 0.0)
    for gamma, delta, delay in ((0.0, 0.01, 2.0), (1e-3, 0.05, 3.4), (0.0, 0.2, 0.6), (0.0, 0.0, 8.0)):
        ideal, loop = Loop(gamma, delta, delay), DeviceLoop(gamma, delta, delay)
        beta = np.linspace(0.1, 0.9, 60) * boundary(ideal).beta_max
        limit = stiffness_limit(ideal, beta)
        worst["limit"] = max(worst["limit"], float(np.nanmax(np.abs(stiffness_limit(loop, beta) / limit - 1))))
        pairs = [(energy_costs(one, 0.4 * limit, beta), "energy") for one in (ideal, loop)]
        pairs += [(transient_costs(one, 0.4 * limit, beta), "settling time, overshoot") for one in (ideal, loop)]
        for (first, name), (second, _) in (pairs[:2], pairs[2:]):
            off = max(float(np.max(np.abs(second[c] - first[c]) / np.maximum(first[c], 1e-3))) for c in first)
            worst[name] = max(worst[name], off)
    for name, off in worst.items():
        print(f"general beside ideal loop, {name}: {off:.1e} (wanted 1e-10)")


def timed(name: str, task: Callable[[], object], wanted: float | None = None) -> None:
    start = time.process_time()
    task()
    print(f"{name}: {time.process_time() - start:.3f} s" + (f" (wanted {wanted:g} s)" if wanted else ""))


def times(size: int) -> None:
    loop = DeviceLoop(0.0, 0.006, 3.0, **RICH)
    top = outline(loop).beta[-1]

    def afresh() -> object:
        for known in (branches, on_circle):
            known.cache_clear()
        return limits(DeviceLoop(0.0, 0.006, 3.0, **RICH), np.linspace(0, top, 251))

    timed("limits at 251 dampings", afresh, 0.1)
    energies, transients = ("energy_step_w0", "energy_step_w1", "energy_step_w2"), ("settle_2pct", "overshoot")
    for names in (energies, transients, (*energies, *transients)):
        wanted = 5.0 if size == 251 and len(names) > len(energies) else None
        timed(f"map {size} x {size}, {', '.join(names)}", lambda n=names: list(CostMap(loop, size, n).blocks()), wanted)


def simulator(trials: int) -> None:
    """Time of a batch of trials with all parts, relative to one without any; noise and quantum as of the Falcon."""
    device = load_device("falcon")
    experiment = device.experiments[0].model_copy(update={"jitter_samples": (), "delay_samples": 4.0})
    K, B = np.random.default_rng(3).uniform((100, 5), (9000, 80), (trials, 2)).T
    seconds = {}
    for name, parts, hidden, delay in (
        ("ideal", {}, {}, 4.0),
        ("richest without friction", LINEAR, HIDDEN, 4.4),
        ("richest", LINEAR | {"friction": Friction(coulomb=0.1, stiction=0.15)}, HIDDEN, 4.4),
    ):
        one = device.model_copy(update={"loop": LoopParts(**parts), "simulation": SimulationParts(**hidden)})
        setup = setup_of(one, experiment.model_copy(update={"delay_samples": delay}))
        best = min(spent(lambda s=setup: simulate(s, K, B)) for _ in range(3))
        seconds[name] = best
        ratio = f", {best / seconds['ideal']:.1f} of the ideal one (wanted 5)" if seconds["ideal"] != best else ""
        print(f"simulator, {trials} trials, {name}: {best:.3f} s{ratio}")


def spent(task: Callable[[], object]) -> float:
    start = time.process_time()
    task()
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="30 random and 6 extreme devices, and a small map")
    quick = parser.parse_args().quick
    like_the_ideal_one()
    times(41 if quick else 251)
    simulator(100 if quick else 1000)
    many_limits(30 if quick else 300, 1 if quick else 10)


if __name__ == "__main__":
    main()

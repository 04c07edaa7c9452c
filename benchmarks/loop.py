"""Loops that are not ideal: how long limits, maps and the simulator take.

    python benchmarks/loop.py [--quick]

How right they are is tested (docs/verification.md). Times are those of the processor.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pipeline.device_data.devices import load_device
from pipeline.loop.loop import Loop, Vibration
from pipeline.records.loop_parts import Butterworth, Friction, LoopParts, Mode, Operator
from pipeline.records.simulation_parts import SimulationParts
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.theory.cost.theory_map import CostMap
from pipeline.theory.device.crossings import branches, on_circle
from pipeline.theory.device.outline import limits, outline

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


def timed(name: str, task: Callable[[], object], wanted: float | None = None) -> None:
    start = time.process_time()
    task()
    print(f"{name}: {time.process_time() - start:.3f} s" + (f" (wanted {wanted:g} s)" if wanted else ""))


def times(size: int) -> None:
    loop = Loop(0.0, 0.006, 3.0, **RICH)
    top = outline(loop).beta[-1]

    def afresh() -> object:
        for known in (branches, on_circle):
            known.cache_clear()
        return limits(Loop(0.0, 0.006, 3.0, **RICH), np.linspace(0, top, 251))

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
    parser.add_argument("--quick", action="store_true", help="a small map and few trials")
    quick = parser.parse_args().quick
    times(41 if quick else 251)
    simulator(100 if quick else 1000)


if __name__ == "__main__":
    main()

"""Each number of a loop in what a comparison says of simulated logs: loop, limits, passive wall, theory, first screen.

Each row is a device file and its simulated course with hardly any noise; the truth is independent (`state_matrix`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from device_files import written
from labs import compare
from state_matrix import needed_damping, radius
from test_every_parameter_in_every_output import LEFT_OUT, ROWS, Cell, loops

from pipeline.device_data.devices import read_device
from pipeline.intake.ingest import ingest
from pipeline.records.results import ExperimentResult
from pipeline.simulation.sweep import run_sweep, write_sweep

MOTION_OF = {name: ("rotation", 2.0) if number % 2 else ("translation", 0.4) for number, name in enumerate(ROWS)}
"""Motion and gain of each row: both are with every second one."""

SHOWN_BY = {
    "jitter_samples": "delay_jitter",
    "velocity.bound": "adaptive_velocity",
    "velocity.longest": "adaptive_velocity",
    "friction.coulomb": "coulomb_friction",
    "friction.stiction": "coulomb_friction",
    "friction.stribeck_velocity": "coulomb_friction",
    "constant_force": "constant_force",
}
"""Causes that name what linear theory leaves out."""


def compared(cell: Cell, known: bool) -> Any:
    """Return the result of a comparison of simulated logs of a loop, with its device file or without."""
    period = cell.loop.sampling_period_s
    file = written(cell.folder, cell.loop, duration_s=400 * period, baseline_s=20 * period, step=10.0)
    device = read_device(file)
    write_sweep(run_sweep(device, "1", coarsen=4), cell.folder / "raw")
    ingest([cell.folder / "raw"], cell.folder / "processed", jobs=1)
    return compare(device if known else device.name, cell.folder / "processed", criteria=("energy_step_w0",)).result


def apparent(loop: Any) -> dict[str, float]:
    """Return mass, damping and stiffness per unit of command, hand included, by hand."""
    hand, gain = loop.operator, loop.force_gain
    more = {name: getattr(hand, name) if hand else 0.0 for name in ("mass", "damping", "stiffness")}
    return {name: (getattr(loop, name) + more[name]) / gain for name in more}


def holds(cell: Cell, found: ExperimentResult, share: float) -> None:
    """Hold the limits of a loop, its passive wall and the wall to use against poles of the state matrix."""
    assert found.loop is not None
    for limit in found.loop_boundary or ():
        K = limit.stiffness if limit.stiffness_large_motion is None else limit.stiffness_large_motion
        if 0.1 * cell.top[0] < K:
            assert (
                radius(cell.loop, (1 - share) * K, limit.damping)
                < 1
                < radius(cell.loop, (1 + share) * K, limit.damping)
            )
    if found.passive is not None:
        K, B = found.passive.stiffness, found.passive.damping
        assert cell.loop.operator is None or found.loop.source == "device file"
        assert needed_damping(cell.loop, K, B) <= (cell.loop.damping - cell.loop.load_damping) * 1.001
    for wall in (found.use.point if found.use else None, found.passive):
        assert wall is None or cell.loop.left_out or radius(cell.loop, wall.stiffness, wall.damping) < 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_a_comparison_with_the_device_file_includes_a_parameter_or_says_so(name: str, tmp_path: Path) -> None:
    motion, gain = MOTION_OF[name]
    cell = Cell(loops(name, motion, gain)[0], tmp_path)
    result = compared(cell, known=True)
    (found,) = result.experiments
    loop, theory = found.loop, found.theory
    assert theory is not None
    for part in cell.loop.left_out:
        assert part in theory.source, "theory names what it leaves out"
    if loop.source == "device file":
        for quantity, value in apparent(cell.loop).items():
            assert getattr(loop, quantity).value == pytest.approx(value), quantity
        assert loop.delay_samples.value == pytest.approx(cell.loop.delay_samples)
        assert (loop.mode is None) == (cell.loop.mode is None)
        if cell.loop.mode is not None:
            assert loop.mode["mass"].value == pytest.approx(cell.loop.mode.mass / gain)
    holds(cell, found, 1e-6 if loop.source == "device file" else 0.05)
    for estimate in result.answer.estimates:
        assert estimate.unit, estimate.name


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_a_comparison_without_a_device_file_includes_a_parameter_or_says_so(name: str, tmp_path: Path) -> None:
    motion, gain = MOTION_OF[name]
    cell = Cell(loops(name, motion, gain)[0], tmp_path)
    result = compared(cell, known=False)
    (found,) = result.experiments
    codes = {cause.code for cause in found.causes}
    assert found.loop is not None
    if name in LEFT_OUT:
        assert SHOWN_BY[name] in codes or not found.loop.adequate, codes
    if found.loop.adequate:
        truth = apparent(cell.loop)
        mass = found.loop.mass
        assert mass.low <= truth["mass"] * 1.01
        assert mass.high >= truth["mass"] * 0.99
        holds(cell, found, 0.05)
    stated = {estimate.name: estimate for estimate in result.answer.estimates}
    assert found.loop.adequate or stated.get("mass") is None or np.isfinite(stated["mass"].value or 0.0)

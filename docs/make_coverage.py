"""Write "Small courses" in `verification.md`: how often their 95 % intervals hold true delay, mass and damping.

    python docs/make_coverage.py [courses]

simulates some courses for each condition (two seconds of a core each), and replaces the section.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.device_data.devices import find_experiment, load_device
from pipeline.measured.model.identified import Identified, identified
from pipeline.measured.stages.stage_device import recordings
from pipeline.measured.stages.stage_groups import TrialGroup
from pipeline.records.batch import Booleans, Floats, TrialBatch
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import Setup, setup_of
from pipeline.simulation.simulate import in_force, simulate

PAGE = Path(__file__).with_name("verification.md")
TRIALS, COURSES = 30, 40
"""Trials of a small course, and courses of a cell: a share of 95 % is then known to 3 %."""

SEED = 5

DEVICES = {"falcon": "1", "lwr": "delay-2"}
"""Experiment that stands for each device."""


@dataclass(frozen=True)
class Cell:
    """One condition: sensor of the Falcon [m], jitter in samples about the delay, rows of a log."""

    name: str
    quantum: float = 10e-6
    noise: float = 1e-6
    jitter: int = 0
    rows: int = 300


CELLS = (
    Cell("base: quantum 10 um, noise 1 um, no jitter, 300 rows"),
    Cell("quantum 2 um", quantum=2e-6),
    Cell("quantum 60 um", quantum=60e-6),
    Cell("noise 0.2 um", noise=0.2e-6),
    Cell("noise 5 um", noise=5e-6),
    Cell("jitter of one sample", jitter=1),
    Cell("600 rows", rows=600),
)


@dataclass(frozen=True, eq=False)
class Sample:
    """Simulated trials of a cell with the true values."""

    batch: TrialBatch
    truth: dict[str, float]


@dataclass(frozen=True)
class Coverage:
    """Of how many courses the intervals hold the truth, by quantity, and the median half width relative to it."""

    courses: int
    held: dict[str, int]
    width: dict[str, float]


def sample(device: str, cell: Cell, trials: int = TRIALS, seed: int = SEED) -> Sample:
    """Simulate a cell at (K, B) drawn uniformly over the stable part of the tested range.

    Quantum and noise of another device than the Falcon are the same share of the displacement in the middle of
    its range. The true delay under jitter is the mean one of the command in force, from a long random draw.
    """
    setup = _setup(device)
    span = _middle_displacement(device) / _middle_displacement("falcon")
    whole = int(setup.delay_samples)
    delays = tuple(range(whole - cell.jitter, whole + cell.jitter + 1)) if cell.jitter else ()
    setup = replace(setup, quantum=cell.quantum * span, noise=cell.noise * span, jitter_samples=delays, rows=cell.rows)
    K, B = _draw(device, trials, seed)
    batch = simulate(setup, K, B, seed=seed, stream=f"coverage/{device}/{cell.name}")
    plant = setup.plant
    return Sample(batch, {"delay": mean_delay(setup), "mass": plant.mass, "damping": plant.damping})


def mean_delay(setup: Setup) -> float:
    """Return the mean delay [samples] of the command in force."""
    if not setup.jitter_samples:
        return setup.delay_samples
    rows, ahead = 200_000, 100
    drawn = np.random.default_rng(1).choice(setup.jitter_samples, (rows, 1)).astype(np.int64)
    behind = np.arange(rows) - in_force(drawn)[:, 0]
    return float(behind[ahead:].mean())


def judged(found: list[Identified], truth: dict[str, float]) -> Coverage:
    """Return what the intervals of some courses came to."""
    held, width = {}, {}
    for name, true in truth.items():
        each = [one.parameters[name] for one in found]
        unit = found[0].scales.period if name == "delay" else 1.0
        held[name] = sum(one.low <= true * unit <= one.high for one in each)
        width[name] = float(np.median([one.high - one.low for one in each])) / 2 / unit / (true or 1.0)
    return Coverage(len(found), held, width)


def measure(courses: int) -> Iterator[tuple[str, Cell, Coverage, float]]:
    """Identify every cell of every device from some courses and yield what came out, with the seconds of a course."""
    for device in DEVICES:
        for cell in CELLS:
            begin, found, truth = time.process_time(), [], {}
            for seed in range(courses):
                drawn = sample(device, cell, TRIALS, SEED + seed)
                truth = drawn.truth
                found.append(identified(recordings(TrialGroup(drawn.batch), {"chosen": drawn.batch.trial_id})))
            yield device, cell, judged(found, truth), (time.process_time() - begin) / courses


def _setup(device: str) -> Setup:
    description = load_device(device)
    return setup_of(description, find_experiment(description, DEVICES[device]))


def _stable(setup: Setup, K: Floats, B: Floats) -> Booleans:
    return spectral_radius(setup.plant, setup, K, B) < 1


def _range(device: str) -> tuple[float, float, float, float]:
    """Return lowest and highest tested K that is stable, lowest and highest tested B."""
    description = load_device(device)
    experiment = find_experiment(description, DEVICES[device])
    K = np.arange(experiment.stiffness_step, 40_000, experiment.stiffness_step)
    B = np.arange(experiment.damping_first, experiment.damping_last + 1, experiment.damping_step)
    grid_k, grid_b = (a.ravel() for a in np.meshgrid(K, B))
    top = float(grid_k[_stable(_setup(device), grid_k, grid_b)].max())
    return experiment.stiffness_step, top, experiment.damping_first, experiment.damping_last


def _middle_displacement(device: str) -> float:
    low, high, _, _ = _range(device)
    return _setup(device).step / (0.5 * (low + high))


def _draw(device: str, trials: int, seed: int) -> tuple[Floats, Floats]:
    low, high, first, last = _range(device)
    random = np.random.default_rng(seed)
    K, B = random.uniform(low, high, 10 * trials), random.uniform(first, last, 10 * trials)
    stable = np.flatnonzero(_stable(_setup(device), K, B))[:trials]
    return K[stable], B[stable]


def _cells(result: Coverage) -> list[str]:
    """Return the cells of a device: coverage of delay, mass and damping, and half widths."""
    covered = "/".join(f"{100 * held / result.courses:.0f}" for held in result.held.values())
    return [covered, "/".join(f"{100 * width:.2g}" for width in result.width.values())]


SECTION = "### Small courses"
ABOUT = """Made by `python docs/make_coverage.py`: {courses} courses of {trials} trials a cell, (K, B) drawn over the
stable part of the tested range, one condition changed at a time, by the likelihood of all trials. How many of the 95 %
intervals of delay/mass/damping hold the truth [%], and their median half width relative to it [%]. Falcon, experiment
1; robot, delay-2, with quantum and noise {share:.2f} times as large. Base: quantum 10 um, noise 1 um, no jitter, 300
rows.
"""
COLUMNS = "| condition | Falcon | half width | robot | half width |"


def main(courses: int) -> None:
    """Measure all cells and write their section of the page."""
    share = _middle_displacement("lwr") / _middle_displacement("falcon")
    rows: dict[str, list[str]] = {}
    for device, cell, result, seconds in measure(courses):
        name = cell.name.partition(":")[0]
        rows.setdefault(name, [name]).extend(_cells(result))
        print(device, *rows[name], f"{seconds:.1f} s", flush=True)
    lines = [SECTION, "", ABOUT.format(courses=courses, trials=TRIALS, share=share), COLUMNS, "|---" * 5 + "|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows.values()]
    before, _, after = PAGE.read_text(encoding="utf-8").partition(SECTION)
    _, following, rest = after.partition("\n### ")
    PAGE.write_text("\n".join([before + lines[0], *lines[1:], following + rest]), encoding="utf-8")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else COURSES)

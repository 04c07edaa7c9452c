"""Write "Single trials" in `verification.md`: how often their 95 % intervals hold true delay, mass and damping.

    python docs/make_coverage.py [trials]

simulates 1,000 trials for each condition (a minute), and replaces the section.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.device_data.devices import find_experiment, load_device
from pipeline.measured.fit.fit import Fit, fit_trials
from pipeline.measured.signal.response import find_response
from pipeline.records.batch import Booleans, Floats, TrialBatch
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import Setup, setup_of
from pipeline.simulation.simulate import in_force, simulate

PAGE = Path(__file__).with_name("verification.md")
TRIALS = 1000
SEED = 5
QUANTILE = 1.96
"""Standard errors of a 95 % interval."""

DEVICES = {"falcon": "1", "lwr": "delay-2"}
"""Experiment that stands for each device."""


@dataclass(frozen=True)
class Cell:
    """One condition: sensor of the Falcon [m], jitter in samples about the delay, rows of a log."""

    name: str
    quantum: float = 10e-6
    noise: float = 1e-6
    jitter: int = 0
    rows: int = 1000


CELLS = (
    Cell("base: quantum 10 um, noise 1 um, no jitter, 1,000 rows"),
    Cell("quantum 2 um", quantum=2e-6),
    Cell("quantum 60 um", quantum=60e-6),
    Cell("noise 0.2 um", noise=0.2e-6),
    Cell("noise 5 um", noise=5e-6),
    Cell("jitter of one sample", jitter=1),
    Cell("300 rows", rows=300),
    Cell("3,000 rows", rows=3000),
)


@dataclass(frozen=True, eq=False)
class Sample:
    """Simulated trials of a cell with the true values."""

    batch: TrialBatch
    truth: dict[str, float]


@dataclass(frozen=True)
class Coverage:
    """What the intervals of a sample came to; shares as fractions, errors in the units of the value."""

    trials: int
    refused: float
    covered: dict[str, float]
    bias: dict[str, float]
    error: dict[str, float]
    truth: dict[str, float]


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


def judge(fit: Fit, truth: dict[str, float]) -> Coverage:
    """Return coverage, bias and median standard error of a fit."""
    known = np.isfinite(fit.delay_error)
    covered, bias, error = {}, {}, {}
    for name, true in truth.items():
        value, spread = getattr(fit, name)[known], getattr(fit, f"{name}_error")[known]
        covered[name] = float(np.mean(np.abs(value - true) <= QUANTILE * spread))
        bias[name] = float(value.mean() - true)
        error[name] = float(np.median(spread))
    return Coverage(int(known.sum()), float(1 - known.mean()), covered, bias, error, truth)


def measure(trials: int = TRIALS) -> Iterator[tuple[str, Cell, Coverage, float]]:
    """Fit every cell of every device and yield what came out, with the seconds that the fit took."""
    for device in DEVICES:
        for cell in CELLS:
            drawn = sample(device, cell, trials)
            begin = time.perf_counter()
            fit = fit_trials(drawn.batch, find_response(drawn.batch))
            yield device, cell, judge(fit, drawn.truth), time.perf_counter() - begin


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
    """Return the cells of a device: coverage of delay, mass and damping, largest bias, share refused."""
    covered = "/".join(f"{100 * result.covered[name]:.0f}" for name in result.truth)
    bias = max(abs(result.bias[name]) / result.error[name] for name in result.truth)
    return [covered, f"{bias:.2f}", f"{100 * result.refused:.1f}"]


SECTION = "### Single trials"
ABOUT = """Made by `python docs/make_coverage.py`: {trials} trials a cell, (K, B) drawn over the stable part of the
tested range, one condition changed at a time, model fitted to the whole response. Coverage of the 95 % intervals of
delay/mass/damping [%]; largest bias in standard errors; refused fits [%]. Falcon, experiment 1; robot, delay-2, with
quantum and noise {share:.2f} times as large. Base: quantum 10 um, noise 1 um, no jitter, 1,000 rows.
"""
COLUMNS = "| condition | Falcon | bias | refused | robot | bias | refused |"


def main(trials: int) -> None:
    """Measure all cells and write their section of the page."""
    share = _middle_displacement("lwr") / _middle_displacement("falcon")
    rows: dict[str, list[str]] = {}
    for device, cell, result, seconds in measure(trials):
        name = cell.name.partition(":")[0]
        rows.setdefault(name, [name]).extend(_cells(result))
        print(device, *rows[name], f"{seconds:.1f} s", flush=True)
    lines = [SECTION, "", ABOUT.format(trials=trials, share=share), COLUMNS, "|---" * 7 + "|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows.values()]
    before, _, after = PAGE.read_text(encoding="utf-8").partition(SECTION)
    _, following, rest = after.partition("\n### ")
    PAGE.write_text("\n".join([before + lines[0], *lines[1:], following + rest]), encoding="utf-8")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else TRIALS)

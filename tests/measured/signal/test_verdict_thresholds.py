"""Each threshold of the verdict by a log on either side of it: moved by 30 %, it decides one of both otherwise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated import FALCON, simulate

from pipeline.measured.signal import modes, verdict

QUANTUM = 2e-6
K = np.arange(376)
WHITE = np.random.default_rng(1).normal(size=400)


def moved(motion, quantum=QUANTUM, noise=0.0):
    """A trial of the Falcon whose free motion after the first delay is another one [m], as its sensor shows it."""
    (trial,) = simulate([2000.0], [20.0], **FALCON, quantum=QUANTUM)
    position = trial.position.copy()
    position[24:] = position[0] + 8 / 2000 + motion
    position = np.round(position / quantum) * quantum if quantum else position
    return replace(trial, position=position + noise * WHITE)


def unstable(rows):
    return simulate([20000.0], [20.0], **FALCON)[0].window(0, rows)


def growing(rate):
    """An oscillation of 0.4 mm that grows by a rate per sample, with white noise of 1 um from the first row on."""
    return moved(4e-4 * np.exp(rate * K) * np.cos(0.3 * K), 0.0, 1e-6)


def left(quanta):
    return moved(4e-4 * np.exp(-K / 12) * np.cos(0.5 * K) + quanta * QUANTUM * np.sin(0.9 * K))


def without_modes(fall):
    """White motion of 2 mm whose size falls by a factor over the log."""
    return moved(2e-3 * WHITE[:376] * fall ** (-K / 376))


def stopped(part, rate):
    return moved(np.where(part * 376 > K, 1e-4 * np.exp(rate * K) * np.cos(0.4 * K), 0.0))


def clipped(departure):
    """A lasting oscillation whose command lacks its peaks, by a part of the step."""
    trial = moved(-1e-3 * np.cos(0.035 * K), 0.0)
    change = np.diff(trial.position, prepend=trial.position[:1])
    law = 8.0 * (np.arange(400) >= 20) - 2000 * trial.displacement - 20 * change / 1e-3
    return replace(trial, command=np.minimum(law, law[40:].max() - 8 * departure))


@pytest.mark.parametrize(
    ("name", "factor", "trial", "told", "otherwise"),
    [
        ("FEWEST_SAMPLES", 0.7, unstable(42), "undecided", "unstable"),
        ("FEWEST_SAMPLES", 1.3, unstable(46), "unstable", "undecided"),
        ("SIGMAS", 0.7, growing(1.5e-5), "undecided", "unstable"),
        ("SIGMAS", 1.3, growing(2e-5), "unstable", "undecided"),
        ("REST_FLOORS", 0.7, left(7), "stable", "undecided"),
        ("REST_FLOORS", 1.3, left(9), "undecided", "stable"),
        ("LEAST_FALL", 0.7, without_modes(2.6), "undecided", "stable"),
        ("LEAST_FALL", 1.3, without_modes(3.8), "stable", "undecided"),
        ("END", 0.7, stopped(0.7, 0.0), "stable", "undecided"),
        ("END", 1.2, stopped(0.85, 2e-3), "undecided", "stable"),  # the whole is 1.25
        ("BENT", 0.7, clipped(0.95e-3), "undecided", "unstable"),
        ("BENT", 1.3, clipped(1.2e-3), "unstable", "undecided"),
    ],
)
def test_a_threshold_holds_what_lies_on_either_side(monkeypatch, name, factor, trial, told, otherwise):
    assert verdict.judge(trial).verdict == told
    moved_by = factor * getattr(verdict, name)
    for module in (verdict, modes) if name == "FEWEST_SAMPLES" else (verdict,):
        monkeypatch.setattr(module, name, round(moved_by) if name == "FEWEST_SAMPLES" else moved_by)
    with np.errstate(invalid="ignore"):
        assert verdict.judge(trial).verdict == otherwise

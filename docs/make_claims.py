"""Write the last section of `coverage.md`: what is said of devices that are not ideal, and how much of it is right.

    python docs/make_claims.py [seeds]

simulates a small course of each kind of device in `pipeline.studies.coverage.kinds` for each seed, compares it as the
logs of a device that nobody described, and holds the document against the truth (a minute a seed on a free core).
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from pipeline.comparison.compare import compare
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.records.batch import Floats
from pipeline.records.results import ExperimentResult
from pipeline.simulation.course import Course, write_course
from pipeline.simulation.radius import spectral_radius
from pipeline.studies.coverage.kinds import Case, kinds, record

FILE = Path(__file__).with_name("coverage.md")
SECTION = "## Devices that are not ideal"
FIRST_SEED = 300
SMALL = {"coarsen": 8, "duration_s": 0.4}
OFF, OFF_SAMPLES, HALF_WIDTHS = 0.05, 0.5, 3.0
"""Error [relative, and in samples of delay] and number of half widths of the interval that make a value wrong."""

LOW = 0.25
"""Limit relative to the largest one below which none is judged in percent."""


def true_limits(course: Course, damping: Floats) -> Floats:
    """Return the stiffness at which the true loop, without friction and at its mean delay, stops being stable."""
    low, high = np.zeros(len(damping)), np.full(len(damping), 200_000.0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        stable = spectral_radius(course.setup.plant, course.setup, middle, damping) < 1
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return 0.5 * (low + high)


def is_wrong(value: float, low: float, high: float, truth: float, off: float) -> bool:
    """Return whether a value is off by more than ``off`` and by more than its interval allows."""
    error = abs(value - truth)
    return error > off and error > HALF_WIDTHS * 0.5 * (high - low)


def wrong_claims(case: Case, course: Course, found: ExperimentResult) -> list[str]:
    """Return what is said without a warning and is wrong."""
    setup, wrong = course.setup, []
    # per unit of command and by the stated clock, which no log shows
    clock = 1 + setup.hidden.clock_error
    operator = case.device.loop_of(course.experiment).operator
    mass = course.experiment.mass + (operator.mass if operator else 0.0)
    damping = course.experiment.damping + (operator.damping if operator else 0.0)
    delay = float(np.mean(setup.jitter_samples)) if setup.jitter_samples else setup.delay_samples
    truth = {
        "mass": mass / setup.true_gain / clock**2,
        "damping": damping / setup.true_gain / clock,
        "delay_samples": delay,
    }
    for name, true in truth.items():
        estimate = found.estimates[name]
        if name == "delay_samples" and found.loop is not None and found.loop.adequate:
            estimate = found.loop.delay_samples
        elif estimate.value is None or estimate.warning or estimate.low is None or estimate.high is None:
            continue
        off = OFF_SAMPLES if name == "delay_samples" else OFF * true
        if is_wrong(estimate.value, estimate.low, estimate.high, true, off):
            wrong.append(name)
    wall = found.passive
    if wall is not None:
        radius = spectral_radius(setup.plant, setup, np.array([wall.stiffness]), np.array([wall.damping]))
        wrong += ["passive wall"] if radius[0] >= 1 else []
    limits = found.loop_boundary or ()
    if limits:
        true_limit = true_limits(course, np.array([limit.damping for limit in limits]))
        for limit, true in zip(limits, true_limit, strict=True):
            if true > LOW * true_limit.max() and is_wrong(limit.stiffness, limit.low, limit.high, true, OFF * true):
                wrong.append("limit")
    return list(dict.fromkeys(wrong))


def outcome_of(case: Case) -> tuple[str, tuple[str, ...], list[str]]:
    """Return right, withheld or confidently wrong, the causes named that are none, and what is wrong."""
    course = record(case, **SMALL)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_course(course, folder / "raw")
        ingest([folder / "raw"], folder / "processed", jobs=1)
        outcome = compare(case.device.name, folder / "processed", criteria=("settle_2pct", "energy_step_w0"))
    if outcome.result is None:
        raise RuntimeError("a comparison that is no dry run has a result")
    (found,) = outcome.result.experiments
    wrong = wrong_claims(case, course, found)
    expected = {*case.truth["causes"], "coarse_sensor", "few_trials"}
    false = tuple(cause.code for cause in found.causes if cause.code not in expected)
    adequate = found.loop is not None and found.loop.adequate
    return "wrong" if wrong else "right" if adequate else "withheld", false, wrong


def main(seeds: int) -> None:
    """Write the section."""
    base = load_device("falcon")
    lines = [
        SECTION,
        "",
        f"Made by `python docs/make_claims.py {seeds}`: {seeds} seeds of each kind (from {FIRST_SEED}), Falcon varied "
        "by 30 %, every eighth damping. Right: the loop is called adequate and all that is said of it holds; withheld: "
        "the loop is called not adequate, and estimates bear a warning; confidently wrong: no warning, an error above "
        "5 % (0.5 samples of delay) and above 3 half widths, or a passive wall that is unstable.",
        "",
        "| kind of device | right | withheld | confidently wrong | causes named that are none |",
        "|---|---|---|---|---|",
    ]
    for name, draw in kinds(base).items():
        found = [outcome_of(draw(FIRST_SEED + seed)) for seed in range(seeds)]
        count = Counter(said for said, _, _ in found)
        false = ", ".join(sorted({code for _, codes, _ in found for code in codes})) or "none"
        what = "; ".join(sorted({each for _, _, wrong in found for each in wrong}))
        wrong = f"{count['wrong']}" + (f" ({what})" if what else "")
        lines.append(f"| {name} | {count['right']} | {count['withheld']} | {wrong} | {false} |")
        print(lines[-1], flush=True)
    before = FILE.read_text(encoding="utf-8").partition(SECTION)[0].rstrip()
    FILE.write_text("\n".join([before, "", *lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)

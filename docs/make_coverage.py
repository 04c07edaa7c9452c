"""Write `coverage.md`: what the model tells of simulated devices of many kinds, and how often its intervals hold.

    python docs/make_coverage.py COURSES [--kept FILE] [--first SEED] [--kind NAME ...]

simulates small courses of each kind by fine steps that share nothing with the package, identifies each, and writes the
page. Results are kept in FILE, a JSON line each; courses that stand there are not made again. A course takes 3 to 10 s.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import expm

from pipeline.measured.identification.estimated import ESTIMATED
from pipeline.measured.identification.identified import Identification, identified
from pipeline.measured.identification.intervals import Interval
from pipeline.measured.identification.recordings import Recording
from pipeline.records.trials import Floats
from pipeline.simulation.simulate import applied_delay_moments

PAGE = Path(__file__).with_name("coverage.md")
T = 1e-3
TRIALS, ROWS, BEGIN, PARTS = 40, 300, 20, 10
"""Trials of a course, rows of a log, row of the step, and fine steps of a sample."""

STEP = 8.0
OFF, HALF_WIDTHS = 0.05, 3.0
"""Relative error, and number of half widths of the interval, that together make a value wrong with confidence."""


@dataclass(frozen=True)
class Kind:
    """A kind of device or log; ``inside`` says whether the model holds it.

    Forces are relative to the step, ``hand`` is a stiffness [N/m] that doubles at 2 mm, ``drag`` the far mass's damping
    in that of the motor.
    """

    inside: bool = True
    friction: float = 0.0
    scatter: float = 0.0
    warming: float = 0.0
    lag: float = 0.0
    mode: bool = False
    far_sensor: bool = False
    drag: float = 0.0
    jitter: tuple[int, ...] = ()
    velocity: str = ""
    clipped: float = np.inf
    bumped: float = 0.0
    lost: float = 0.0
    play: float = 0.0
    hand: float = 0.0
    drift: float = 0.0


KINDS = {
    "ideal": Kind(),
    "friction": Kind(friction=0.06),
    "friction, scatter 5 %": Kind(friction=0.06, scatter=0.05),
    "lag": Kind(lag=2.0),
    "lag of half a sample": Kind(lag=0.5),
    "mode": Kind(mode=True),
    "mode, damped load": Kind(mode=True, drag=1.0),
    "mode, read at the load": Kind(mode=True, far_sensor=True),
    "jitter": Kind(jitter=(3, 4, 5)),
    "filtered velocity": Kind(velocity="filter"),
    "adaptive window (FOAW)": Kind(velocity="window"),
    "clipped": Kind(clipped=0.9),
    "bumped trials": Kind(bumped=0.1),
    "lost rows": Kind(lost=0.02),
    "play": Kind(inside=False, play=2.0),
    "stiffening hand": Kind(inside=False, hand=300.0),
    "drifting delay": Kind(drift=0.6),
    "warming friction": Kind(inside=False, friction=0.06, warming=0.3),
}


@dataclass(frozen=True, eq=False)
class Course:
    """Recordings with what is true of their device, in SI."""

    recordings: list[Recording]
    truth: dict[str, float]


def course(kind: Kind, seed: int) -> Course:
    """Simulate a course behind walls up to two thirds of what an ideal device renders."""
    random = np.random.default_rng(seed)
    mass, damping, quantum = random.uniform(0.3, 0.9), random.uniform(2.0, 8.0), 10 ** random.uniform(-5.7, -4.7)
    delay = 35 / 9 if kind.jitter else random.integers(20, 46) / PARTS
    reach = delay + kind.lag + 0.5
    B = random.uniform(0.1, 0.35, TRIALS) * mass / (T * reach)
    K = np.minimum(0.65 * B / (T * reach), random.uniform(500, 20_000, TRIALS))
    if kind.mode:
        K, B = (0.1 * K, 0.1 * B) if kind.far_sensor else (0.3 * K, 0.4 * B)
    friction = kind.friction * STEP * (1 + kind.scatter * random.standard_normal(TRIALS))
    friction *= 1 - kind.warming * np.linspace(0.0, 1.0, TRIALS)
    own_delay = delay + np.round(kind.drift * np.linspace(-0.5, 0.5, TRIALS), 1)
    far = 0.2 * mass if kind.mode else 0.0
    turn, ratio = 2 * np.pi * random.uniform(30, 60), 0.03
    recordings = _simulated(kind, random, (K, B), (mass, damping, friction, own_delay), (far, turn, ratio), quantum)
    truth = {"mass": mass, "damping": damping * (1 + kind.drag), "delay": delay}
    truth |= {} if kind.mode else {"delay and lag": delay + kind.lag}
    if kind.friction and not kind.warming:
        truth["friction"] = kind.friction * STEP
    truth |= {"actuator_lag": kind.lag * T} if kind.lag else {}
    truth |= {"mode_frequency": turn / (2 * np.pi), "mode_mass": far} if kind.mode else {}
    truth |= {"jitter": applied_delay_moments(kind.jitter)[1]} if kind.jitter else {}
    return Course(recordings, truth)


def _simulated(
    kind: Kind,
    random: np.random.Generator,
    walls: tuple[Floats, Floats],
    device: tuple[float, float, Floats, Floats],
    mode: tuple[float, float, float],
    quantum: float,
) -> list[Recording]:
    """Return the logs: exact steps under constant forces; friction takes speed away and never turns it."""
    (K, B), (mass, damping, friction, delay), (far, turn, ratio) = walls, device, mode
    n, h, near = len(K), T / PARTS, mass - far
    kept = np.exp(-damping / near * h)
    spring, damper = (each * near * far / mass for each in (turn**2, 2 * ratio * turn))
    two_masses = _two_masses((near, far), (damping, kind.drag * damping), spring, damper)
    x, v, acting, far_x, far_v, filtered = (np.zeros(n) for _ in range(6))
    seen, sent = np.zeros((ROWS, n)), np.zeros((ROWS, n))
    held = np.zeros(n)
    bumps = (random.uniform(size=n) < kind.bumped) * random.uniform(-0.3, 0.3, n) * STEP
    drawn = random.choice(kind.jitter or (0,), (ROWS, n))
    newest = np.full(n, -1)
    for k in range(ROWS):
        # play: the sensor follows behind a gap
        place = far_x if kind.far_sensor else x
        held = np.clip(held, x - 0.5 * kind.play * quantum, x + 0.5 * kind.play * quantum) if kind.play else place
        seen[k] = np.round((held + 0.2 * quantum * random.standard_normal(n)) / quantum) * quantum
        rate = (seen[k] - seen[max(k - 1, 0)]) / T
        filtered = filtered + 0.25 * (rate - filtered)
        if kind.velocity == "window":
            rate = _window(seen, k, quantum)
        wall = K * (seen[k] - seen[0]) + B * (filtered if kind.velocity == "filter" else rate)
        sent[k] = STEP * (k >= BEGIN) - wall
        arrived = [(row, row + drawn[row] <= k) for row in range(max(k - 8, 0), k + 1)] if kind.jitter else []
        for row, here in arrived:
            newest = np.where(here, np.maximum(newest, row), newest)
        for part in range(PARTS):
            late = newest if kind.jitter else np.floor(k + part / PARTS - delay + 1e-9).astype(int)
            u = np.where(late >= 0, sent[np.maximum(late, 0), np.arange(n)], 0.0)
            u = np.clip(u, -kind.clipped * STEP, kind.clipped * STEP)
            lagged = acting - u
            acting = u + lagged * np.exp(-1 / (PARTS * kind.lag)) if kind.lag else u
            pull = u + lagged * PARTS * kind.lag * -np.expm1(-1 / (PARTS * kind.lag)) if kind.lag else u
            before = x, v, far_x, far_v
            hand = kind.hand * x * (1 + (x / 2e-3) ** 2)
            push = pull - hand + bumps * (BEGIN + 40 <= k < BEGIN + 60)
            sticks = (v == 0) & (np.abs(push) <= friction)
            push = push - friction * np.where(v == 0, np.sign(push), np.sign(v))
            after = v * kept + push / damping * (1 - kept)
            stops = sticks | ((v * after < 0) & (friction > 0))
            after = np.where(stops, 0.0, after)
            ahead = v * (1 - kept) * near / damping + push / damping * (h - (1 - kept) * near / damping)
            x, v = x + np.where(stops, 0.5 * h * v, ahead), after
            if far:
                x, v, far_x, far_v, _ = two_masses @ np.stack([*before, pull])
    time_s, recordings = T * np.arange(ROWS), []
    for i in range(n):
        keep = np.flatnonzero(random.uniform(size=ROWS) >= kind.lost) if kind.lost else np.arange(ROWS)
        recordings.append(Recording(str(i), time_s[keep], sent[keep, i], seen[keep, i], T))
    return recordings


def _two_masses(masses: tuple[float, float], dampings: tuple[float, float], spring: float, damper: float) -> Floats:
    """Return the transition of positions and speeds of two masses on a spring, and of the force, over a fine step."""
    near, far = masses
    matrix = np.zeros((5, 5))
    matrix[0, 1] = matrix[2, 3] = 1.0
    matrix[1] = np.array([-spring, -damper - dampings[0], spring, damper, 1.0]) / near
    matrix[3] = np.array([spring, damper, -spring, -damper - dampings[1], 0.0]) / (far or 1.0)
    return np.asarray(expm(matrix * T / PARTS))


def _window(seen: Floats, k: int, quantum: float) -> Floats:
    """Return the velocity over the longest of 1 to 12 samples whose readings a straight line joins to a quantum."""
    best = (seen[k] - seen[max(k - 1, 0)]) / T
    open_ = np.ones(seen.shape[1], dtype=bool)
    for length in range(2, min(12, k) + 1):
        slope = (seen[k] - seen[k - length]) / length
        line = seen[k] - slope * np.arange(length + 1)[:, None]
        open_ &= (np.abs(seen[k - np.arange(length + 1)] - line) <= quantum).all(axis=0)
        best = np.where(open_, slope / T, best)
    return best


def estimates(found: Identification, truth: dict[str, float]) -> dict[str, list[float | None]]:
    """Return truth, value and interval of each quantity, delays in samples; no value where it cannot be identified."""
    noise, names = found.choice.fit.device.noise, list(found.parameters)
    intervals = {ESTIMATED[n].key: found.parameters[n] for n in names if n not in found.unidentifiable}
    samples = {"delay_samples": 1.0, "actuator_lag_s": 1 / T}
    unit = np.array([samples.get(name, 0.0) for name in names])
    value = float(unit @ [interval.value for interval in found.parameters.values()])
    for name, middle, error in (
        ("delay and lag", value, float(np.sqrt(unit @ found.covariance @ unit))),
        ("jitter", noise.jitter, noise.jitter_error),
    ):
        intervals[name] = Interval(middle, middle - 1.96 * error, middle + 1.96 * error, error)
    if not noise.jitter:
        del intervals["jitter"]
    known = {name: (i.value, i.low, i.high) for name, i in intervals.items()}
    return {name: [true, *known.get(name, (None, None, None))] for name, true in truth.items()}


def measured(kind: str, seed: int) -> dict[str, Any]:
    """Return what a course came to, as it is kept."""
    made, begin = course(KINDS[kind], seed), time.process_time()
    found = identified(made.recordings)
    parts = [name for name, gain in found.parts.items() if gain > 0]
    seconds = time.process_time() - begin
    return {"kind": kind, "seed": seed, "told": estimates(found, made.truth), "parts": parts, "seconds": seconds}


@dataclass
class Count:
    """Of how many courses a quantity is told, held by its interval, right and wrong; half widths relative to it."""

    courses: int = 0
    told: int = 0
    held: int = 0
    right: int = 0
    wrong: int = 0

    def add(self, true: float, value: float | None, low: float | None, high: float | None) -> float | None:
        """Count a course and return the relative half width."""
        self.courses += 1
        if value is None or low is None or high is None:
            return None
        half, error = 0.5 * (high - low), abs(value - true)
        self.told += 1
        self.held += low <= true <= high
        self.wrong += error > OFF * abs(true) and error > HALF_WIDTHS * half
        self.right += error <= OFF * abs(true)
        return half / abs(true)


ABOUT = """# How often intervals contain the truth

This page shows how often the parameters of simulated devices are identified, and how often their 95 % intervals contain
the truth. `python docs/make_coverage.py` simulates {courses} experiments and writes the page. Each experiment has
{trials} trials with walls, and each trial has {rows} rows. The simulation uses fine steps and shares no code with the
package. The mass is 0.3 to 0.9 kg, the damping 2 to 8 Ns/m, the delay 2 to 4.5 samples, and the quantum 2 to 20 um.

The columns of the table mean:

* *Identified*: the number of experiments with a value, of all experiments
* *Right*: the number of values within 5 % of the truth
* *Wrong*: the number of values that are off by more than 5 % **and** by more than three half widths
* *Covered*: the percentage of 95 % intervals that contain the truth
* *Width*: the median half width relative to the truth

| kind | quantity | identified | right | wrong | covered [%] | width [%] |
|---|---|---|---|---|---|---|
"""
AFTER = """
Kinds in italics contain an effect that the model lacks. Their true value is the parameter of the simulated device.
`jitter` refers to the [delay of the applied command](definitions.md#measured). The simulation draws {jitter}.

For all kinds inside the model, {inside}. For the kinds outside the model, {outside}.

**Not covered.** The table does not cover devices that are not listed, cogging, cables, several axes, wrong clocks, a
mode above half the sampling frequency, and delays that depend on the motion. It does not cover print formats and time
stamps that differ from those of the simulator either. The intervals of energies and limits follow from those of the
parameters and are checked elsewhere ([verification.md](verification.md)).
"""


def page(kept: Sequence[dict[str, Any]]) -> str:
    """Return the page of some results."""
    lines, totals = [], {True: Count(), False: Count()}
    for kind, about in sorted(KINDS.items(), key=lambda pair: not pair[1].inside):
        counts: dict[str, tuple[Count, list[float]]] = {}
        for one in (each for each in kept if each["kind"] == kind):
            for name, values in one["told"].items():
                count, widths = counts.setdefault(name, (Count(), []))
                width = count.add(*values)
                widths += [] if width is None else [width]
        for place, (name, (count, widths)) in enumerate(counts.items()):
            width = f"{float(f'{100 * np.median(widths):.2g}'):g}" if widths else ""
            held = f"{100 * count.held / count.told:.0f}" if count.told else ""
            shown = [f"{count.told}/{count.courses}", count.right, count.wrong, held, width]
            called = "" if place else kind if about.inside else f"*{kind}*"
            lines.append(f"|{'|'.join(map(str, [called, name, *shown]))}|")
            total = totals[about.inside]
            for key, value in asdict(count).items():
                setattr(total, key, getattr(total, key) + value)
    inside, outside = (
        f"{each.told} of {each.courses} values are identified, {each.right} are right, {each.wrong} are wrong, and "
        f"{each.held} are covered ({100 * each.held / max(each.told, 1):.1f} %)"
        for each in (totals[True], totals[False])
    )
    jitter = "delays of 3, 4 and 5 samples with equal probability"
    about_text = ABOUT.format(courses=len(kept), trials=TRIALS, rows=ROWS)
    return about_text + "\n".join(lines) + "\n" + AFTER.format(inside=inside, outside=outside, jitter=jitter)


def main(courses: int, first: int, names: Iterable[str], file: Path | None) -> None:
    """Make what is missing and write the page."""
    kept = [json.loads(line) for line in file.read_text().splitlines()] if file and file.exists() else []
    known = {(each["kind"], each["seed"]) for each in kept}
    for seed in range(first, first + courses):
        for kind in names:
            if (kind, seed) in known:
                continue
            kept.append(measured(kind, seed))
            print(json.dumps(kept[-1]), flush=True)
            if file:
                with file.open("a") as lines:
                    lines.write(json.dumps(kept[-1]) + "\n")
    PAGE.write_text(page(kept), encoding="utf-8")


if __name__ == "__main__":
    ask = argparse.ArgumentParser()
    ask.add_argument("courses", type=int)
    ask.add_argument("--first", type=int, default=0)
    ask.add_argument("--kept", type=Path)
    ask.add_argument("--kind", nargs="*", default=list(KINDS))
    given = ask.parse_args()
    main(given.courses, given.first, given.kind, given.kept)

"""Write "Devices that are not ideal" in `verification.md`: how much of what is said of them is right.

    python docs/make_claims.py [seeds [first seed]] [--kept FILE] [--base NAME ...] [--kind NAME ...] [--again]

simulates a small course of each kind of device in `tests/support/kinds.py` for each seed, compares it as the
logs of a device that nobody described, and holds the document against the truth (a minute a seed and base on a free
core). The light-weight robot and a small motor take a quarter of the seeds; the motor turns without a wall, too.
What is found of each course is a line of the file that ``--kept`` names, and is not found again in a second run but by
``--again``; the section is made from that file, of a run that was broken off too.

The table counts the 95 % intervals of a course that hold what is true. Of a cost that is what the same trials
give by a sensor without an error; where loops are no linear ones their limit is not known, and is not counted.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipeline.comparison.compare import compare
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.measured.cost.costs import overshoot, settling
from pipeline.measured.cost.energy import energy_terms
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.records.batch import Floats, TrialBatch
from pipeline.records.findings import Estimate, Parameter
from pipeline.records.models import Device
from pipeline.records.results import ExperimentResult
from pipeline.simulation.course import Course, write_course
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.surface.stored import costs

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from kinds import kinds, record

FILE = Path(__file__).with_name("verification.md")
SECTION = "### Devices that are not ideal"
FIRST_SEED = 300
SMALL = {"coarsen": 8, "duration_s": 0.4}
OFF, OFF_SAMPLES, OFF_STEP, HALF_WIDTHS = 0.05, 0.5, 0.01, 3.0
"""Error [relative, in samples of delay and jitter, and of a force in steps] and number of half widths of the interval
that make a value wrong."""

LOW = 0.25
"""Limit relative to the largest one below which none is judged in percent."""

PER_BASE = 4
"""Seeds of the Falcon for each of the other bases."""

MOTOR = {
    "name": "motor",
    "title": "small motor",
    "source": "made up",
    "motion": "rotation",
    "sampling_period_s": 1e-3,
    "step": 0.01,
    "duration_s": 0.6,
    "baseline_s": 0.02,
    "sensor": {"quantum": 1e-5, "noise": 2e-6},
    "limits": {"travel": 50.0},
    "experiment": [
        {
            "name": "1",
            "mass": 1.2e-4,
            "damping": 7e-5,
            "delay_samples": 2,
            "damping_last": 0.038,
            "damping_step": 8e-4,
            "stiffness_step": 0.04,
        }
    ],
}
"""Inertia [kg m^2] and damping [Nms/rad] of a small motor; Coulomb friction comes from the kinds."""

BLIND = ("jitter_samples", "friction", "one_sided_wall", "force", "held_samples")
"""Keys of parts that move limits in a way that no eigenvalue tells."""

UNSEEN = {"force_gain", "sampling_period"}
"""Causes that show against a device file alone, and none describes these devices."""

CRITERIA = ("settle_2pct", "overshoot", "energy_step_w0", "energy_step_w1")
"""Costs whose intervals are counted."""

LONGER = 3
"""Length of the trials that true costs are of, in that of the course's: their energies have no tail that is missing."""

LEAST_SHARE, FEWEST, SHOWN = 0.86, 20, 6
"""Share of intervals below which a kind of device is named, intervals of a kind from which on it is, kinds shown."""

Held = dict[str, tuple[int, int, int]]
"""For each quantity how many intervals hold the truth, how many bear no warning, and how many there could be."""


def true_limits(course: Course, damping: Floats) -> Floats:
    """Return the stiffness at which the true loop, without friction and at its mean delay, stops being stable."""
    low = np.zeros(len(damping))
    high = low + course.experiment.mass / course.setup.sampling_period_s**2
    for _ in range(40):
        middle = 0.5 * (low + high)
        stable = spectral_radius(course.setup.plant, course.setup, middle, damping) < 1
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return 0.5 * (low + high)


def is_wrong(value: float, low: float, high: float, truth: float, off: float) -> bool:
    """Return whether a value is off by more than ``off`` and by more than its interval allows."""
    error = abs(value - truth)
    return error > off and error > HALF_WIDTHS * 0.5 * (high - low)


def truths(course: Course) -> Iterator[tuple[str, float, float]]:
    """Yield name, true value and error that matters of each estimate, per unit of command and by the stated clock."""
    setup, true, gain = course.setup, course.experiment, course.setup.true_gain
    parts, clock = course.device.loop_of(course.experiment), 1 + course.setup.hidden.clock_error
    operator, friction = parts.operator, parts.friction
    held = (operator.mass, operator.damping, operator.stiffness) if operator else (0.0, 0.0, 0.0)
    jitter = np.array(setup.jitter_samples or [setup.delay_samples])
    mass, damping = (true.mass + held[0]) / gain / clock**2, (true.damping + held[1]) / gain / clock
    yield "mass", mass, OFF * mass
    yield "damping", damping, max(OFF * damping, OFF * 0.01 * mass / setup.sampling_period_s)
    yield "delay_samples", float(jitter.mean()), OFF_SAMPLES
    # friction and lag look like jitter: none is none
    yield "jitter_samples", float(jitter.std()), OFF_SAMPLES if jitter.std() else 0.0
    stiffness = (true.stiffness + held[2]) / gain
    yield "device_stiffness", stiffness, max(OFF * stiffness, 1e-3 * mass / setup.sampling_period_s**2 * OFF)
    coulomb = friction.coulomb / gain if friction else 0.0
    yield "friction", coulomb, max(OFF * coulomb, OFF_STEP * setup.step)
    constant = setup.hidden.constant_force / gain
    yield "constant_force", constant, max(OFF * abs(constant), OFF_STEP * setup.step)


def is_wrong_claim(estimate: Estimate, truth: float, off: float) -> bool:
    """Return whether an estimate, or a bound of it, that bears no warning is wrong."""
    value, low, high = estimate.value, estimate.low, estimate.high
    if estimate.warning or low is None or high is None:
        return False
    if value is None:
        return not low - off <= truth <= high + off
    return is_wrong(value, low, high, truth, off)


def wrong_claims(course: Course, found: ExperimentResult, *, limits_are_known: bool) -> list[str]:
    """Return what is said without a warning and is wrong."""
    setup, wrong = course.setup, []
    for name, truth, off in truths(course):
        estimate = found.estimates[name]
        if name == "delay_samples" and found.loop is not None and found.loop.adequate and found.loop.delay_samples:
            estimate = estimate.model_copy(update=found.loop.delay_samples.model_dump() | {"warning": None})
        if is_wrong_claim(estimate, truth, off):
            wrong.append(f"{name} {estimate.value} ({estimate.low} to {estimate.high}) for {truth}")
    if (wall := found.passive) is not None:
        radius = spectral_radius(setup.plant, setup, np.array([wall.stiffness]), np.array([wall.damping]))
        wrong += [f"passive_wall of radius {radius[0]}"] if radius[0] >= 1 else []
    claimed = [("loop_limit", p.damping, p.stiffness, p.low, p.high) for p in found.loop_boundary or ()]
    if limits_are_known:
        named = [p for p in found.boundary if p.estimate is not None]
        claimed += [("measured_limit", p.damping, p.estimate or 0.0, p.low or 0.0, p.high or np.inf) for p in named]
    if claimed:
        true_limit = true_limits(course, np.array([damping for _, damping, *_ in claimed]))
        # what halving leaves of no limit at all
        none = 1e-9 * course.experiment.mass / setup.sampling_period_s**2
        for (what, damping, *limit), true in zip(claimed, true_limit, strict=True):
            if true > max(LOW * true_limit.max(), none) and is_wrong(*limit, true, OFF * true):
                wrong.append(f"{what} {limit} for {true} at B = {damping}")
    return wrong


def compared(course: Course, folder: Path) -> tuple[ExperimentResult, pd.DataFrame]:
    """Return what is said of a course as that of a device that nobody described, and the costs of its trials."""
    write_course(course, folder / "raw")
    ingest([folder / "raw"], folder / "processed", jobs=1)
    outcome = compare(course.device.name, folder / "processed", criteria=CRITERIA)
    if outcome.result is None:
        raise RuntimeError("a comparison that is no dry run has a result")
    (found,) = outcome.result.experiments
    table = costs(folder / "processed", course.device.name)
    return found, by_wall(table[table["criterion"].isin(CRITERIA)])


def true_costs(course: Course) -> pd.DataFrame:
    """Return the costs of the same trials by a sensor without an error, and by the true delay and mass.

    They last longer but with friction, which lets the device rest beside its final position: sums of energies grow.
    A spring holds the device at x_0 + F_0/(K + k). What a log has lost or repeated happened all the same, and a sample
    that is held is an error of the sensor.
    """
    batch, true = course.batch, {name: value for name, value, _ in truths(course)}
    longer = 1 if course.device.loop_of(course.experiment).friction else LONGER
    whole = course.setup.hidden.model_copy(update={"lost_rows": 0.0, "repeated_rows": 0.0, "held_samples": 0.0})
    setup = replace(course.setup, quantum=0.0, noise=0.0, rows=longer * course.setup.rows, hidden=whole)
    stream = f"{course.device.name}/{course.experiment.name}"
    exact = simulate(setup, batch.stiffness, batch.damping, seed=course.seed, stream=stream)
    response, wall = find_response(exact), exact.stiffness
    verdicts, delay = judge(exact, response), int(true["delay_samples"])
    if spring := true["device_stiffness"]:
        exact = replace(exact, stiffness=np.where(wall > 0, wall + spring, wall))
        final = response.position_start + exact.step / np.where(wall > 0, wall + spring, np.nan)
        response = replace(response, position_final_expected=final)
    seen = (exact, response, verdicts)
    energy = energy_terms(*seen, delay).summed(true["mass"])
    found = {
        "settle_2pct": settling(*seen, delay)["settle_2pct"].value,
        "overshoot": overshoot(*seen).value,
        "energy_step_w0": energy[:, 0],
        "energy_step_w1": energy[:, 1],
    }
    walls = {"stiffness": batch.stiffness, "damping": batch.damping, "trial_id": batch.trial_id}
    return by_wall(pd.DataFrame(walls | found).melt(list(walls), var_name="criterion", value_name="truth"))


def by_wall(table: pd.DataFrame) -> pd.DataFrame:
    """Return costs by wall, criterion and number of the trial."""
    wall = ["stiffness", "damping", "criterion"]
    table = table.sort_values("trial_id")
    return table.set_index([*wall, table.groupby(wall).cumcount()])


def numbers(course: Course, found: ExperimentResult) -> Iterator[tuple[str, Estimate | Parameter | None, float]]:
    """Yield name, what is said of it, and truth of each number that a device has."""
    parts, loop, true = course.device.loop_of(course.experiment), found.loop, {n: t for n, t, _ in truths(course)}
    lag = parts.actuator_lag_s
    apart = loop is not None and loop.actuator_lag_s is not None
    for name, truth in true.items():
        if name == "delay_samples":
            yield "delay", found.delay, truth + (0.0 if apart else lag / course.setup.sampling_period_s)
        elif truth or name in ("mass", "damping"):
            yield name.replace("_samples", "").replace("_", " "), found.estimates[name], truth
    if lag:
        yield "lag", loop.actuator_lag_s if loop else None, lag
    if parts.velocity is not None and parts.velocity.kind == "butterworth":
        told = loop.velocity if loop and loop.velocity else {}
        yield "cut-off", told.get("cutoff_hz"), parts.velocity.cutoff_hz or 0.0
    if parts.mode is not None:
        yield "mode frequency", (loop.mode if loop and loop.mode else {}).get("frequency_hz"), parts.mode.frequency_hz


def held(course: Course, found: ExperimentResult, table: pd.DataFrame, *, limits_are_known: bool) -> Held:
    """Count the intervals of what is said of a course that hold the truth."""
    result: Held = {}

    def count(name: str, low: Any, high: Any, truth: Any, told: Any) -> None:
        inside = told & (low <= truth) & (truth <= high)
        before = result.get(name, (0, 0, 0))
        result[name] = (before[0] + int(np.sum(inside)), before[1] + int(np.sum(told)), before[2] + np.size(told))

    def bounds(each: Any) -> tuple[float, float]:
        return tuple(np.nan if each is None or end is None else end for end in (each and each.low, each and each.high))

    for name, each, truth in numbers(course, found):
        low, high = bounds(each)
        count(name, low, high, truth, low <= high and not getattr(each, "warning", None))
    if limits_are_known:
        limits = {"limit of the loop": found.loop_boundary or (), "measured limit": found.boundary}
        for name, points in limits.items():
            true = true_limits(course, np.array([point.damping for point in points]))
            low, high = (np.array(ends) for ends in zip(*map(bounds, points), strict=True)) if points else ((), ())
            some = true > LOW * true.max(initial=0.0)
            count(name, low[some], high[some], true[some], (low <= high)[some]) if points else None
    both = table.join(true_costs(course)["truth"], how="inner").dropna(subset="truth")
    for criterion, rows in both.groupby(level="criterion"):
        low, high = rows["low"].to_numpy(), rows["high"].to_numpy()
        # what rounding leaves of a cost is no error of a sensor
        least = 1e-6 * np.abs(rows["truth"].to_numpy())
        count(str(criterion), low - least, high + least, rows["truth"].to_numpy(), low <= high)
    return result


def claims(course: Course, expected: set[str], *, limits_are_known: bool) -> dict[str, Any]:
    """Return what is said of a course: right, withheld or wrong, false causes, the first one, and intervals."""
    with tempfile.TemporaryDirectory() as folder:
        found, table = compared(course, Path(folder))
    wrong = wrong_claims(course, found, limits_are_known=limits_are_known)
    first = bool(found.causes) and found.causes[0].code in expected if expected - UNSEEN else None
    setup, wall = course.setup, course.batch.stiffness > 0
    stable = spectral_radius(setup.plant, setup, course.batch.stiffness[wall], course.batch.damping[wall]) < 1
    expected |= {"coarse_sensor", "few_trials"}
    expected |= {code for code, none in (("no_stable_trial", ~stable), ("no_unstable_trial", stable)) if none.all()}
    adequate = found.loop is not None and found.loop.adequate
    return {
        "said": "wrong" if wrong else "right" if adequate else "withheld",
        "causes": [cause.code for cause in found.causes if cause.code not in expected],
        "wrong": wrong,
        "first": first,
        "held": held(course, found, table, limits_are_known=limits_are_known),
    }


def cases(base: Device, experiment: str) -> dict[str, Callable[[int], dict[str, Any]]]:
    """Return for each kind of a base device a function from a seed to what is said of it."""

    def of(draw: Callable[..., object], seed: int) -> dict[str, Any]:
        case = draw(seed)
        known = not any(part in key.split(".") for key in case.truth for part in BLIND)
        return claims(record(case, **SMALL), set(case.truth["causes"]), limits_are_known=known)

    return {name: lambda seed, draw=draw: of(draw, seed) for name, draw in kinds(base, experiment).items()}


def turning(steps: tuple[float, ...], offset: float, seed: int) -> dict[str, Any]:
    """Judge what is said of the motor that turns without a wall against friction of two thirds of the least torque.

    ``steps`` are torques and ``offset`` a constant one, relative to the step of the device.
    """
    parts = {"loop": {"friction": {"coulomb": 2 / 3 * MOTOR["step"]}}, "sensor": {"quantum": 2e-4, "noise": 5e-5}}
    device = Device.model_validate(MOTOR | parts | {"simulation": {"constant_force": offset * MOTOR["step"]}})
    (experiment,) = device.experiments
    setup = setup_of(device, experiment)
    none = np.zeros(1)
    batches = [
        simulate(replace(setup, step=setup.step * step), none, none, seed=seed, repetition=i)
        for i, step in enumerate(3 * steps)
    ]
    batch = TrialBatch.joined(batches)
    batch = replace(batch, trial_id=tuple(f"turn{i}" for i in range(len(batch))))
    course = Course(device, experiment, setup, seed, batch, np.ones(len(batch), int), np.full(len(batch), "stable"))
    expected = {"coulomb_friction", *(["constant_force"] if offset else [])}
    return claims(course, expected, limits_are_known=False)


def every_case() -> Iterator[tuple[str, int, dict[str, Callable[[int], dict[str, Any]]]]]:
    """Yield name, part of the seeds and cases of each base device."""
    yield "Falcon", 1, cases(load_device("falcon"), "1")
    yield "Light-weight robot", PER_BASE, cases(load_device("lwr"), "delay-3")
    motor = cases(Device.model_validate(MOTOR), "1")
    for (levels, steps), (words, offset) in product(
        {"one torque": (1.0,), "two torques": (1.0, 1.5)}.items(),
        {"": 0.0, ", offset against it": -0.1, ", offset with it": 0.1}.items(),
    ):
        motor[f"turning, {levels}{words}"] = lambda seed, steps=steps, offset=offset: turning(steps, offset, seed)
    yield "Small motor", PER_BASE, motor


def lines_of(kept: Path) -> dict[tuple[str, str, int], dict[str, Any]]:
    """Return what was found of each base, kind and seed; of what was found twice the last."""
    text = kept.read_text(encoding="utf-8") if kept.exists() else ""
    found = [json.loads(line) for line in text.splitlines() if line.endswith("}")]
    return {(each["base"], each["kind"], each["seed"]): each for each in found}


def find(options: argparse.Namespace) -> None:
    """Judge what was not judged yet, seed by seed, and append it to the file."""
    known = {} if options.again else lines_of(options.kept)
    for base, part, of in every_case():
        if options.base and base not in options.base:
            continue
        for seed in range(options.first, options.first + -(-options.seeds // part)):
            for kind, judged in of.items():
                if (base, kind, seed) in known or (options.kind and kind not in options.kind):
                    continue
                found = {"base": base, "kind": kind, "seed": seed} | judged(seed)
                with options.kept.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(found) + "\n")
                print(base, seed, kind, found["said"], *found["causes"], *found["wrong"], sep="; ", flush=True)


def judged(found: Mapping[tuple[str, str, int], dict[str, Any]]) -> list[str]:
    """Return the lines that say which kinds are right, withheld and wrong, and which causes are not named first."""
    seeds = [seed for _, _, seed in found]
    said: dict[str, Counter[str]] = {}
    late: dict[str, Counter[bool]] = {}
    false: Counter[str] = Counter()
    for (_, kind, _), each in found.items():
        of = kind.partition(", offset")[0]
        said.setdefault(of, Counter())[each["said"]] += 1
        false.update(each["causes"])
        if each.get("first") is not None:
            late.setdefault(of, Counter())[each["first"]] += 1
    first, asked = (sum(count[True] for count in late.values()), sum(map(Counter.total, late.values())))
    missed = [f"{kind} ({count[False]} of {count.total()})" for kind, count in late.items() if count[False]]
    lines = [
        f"Made by `python docs/make_claims.py`: {len(found)} courses, seeds {min(seeds)} to {max(seeds)}; "
        "Falcon, robot and a small motor varied by 30 %, every eighth damping. *Right*: called adequate, and all that "
        "is said holds; *withheld*: called not adequate, estimates bear a warning; *wrong*: no warning, and off by 5 % "
        "(0.5 samples, 1 % of the step) and three half widths, or a passive wall that is unstable.",
        "",
    ]
    for word in ("right", "withheld", "wrong"):
        of_word = [
            f"{kind}" + f" ({n[word]} of {n.total()})" * (n[word] < n.total()) for kind, n in said.items() if n[word]
        ]
        number = sum(n[word] for n in said.values())
        lines.append(f"* {word.capitalize()}, {number}: {'; '.join(of_word) or 'none'}.")
    lines.append(f"* A true cause is named first in {first} of {asked}; not in: {'; '.join(missed) or 'none'}.")
    lines.append(f"* Causes that are none: {', '.join(f'{code} {n}' for code, n in sorted(false.items())) or 'none'}.")
    return lines


def interval_table(found: Mapping[tuple[str, str, int], dict[str, Any]]) -> list[str]:
    """Return the lines of the table of intervals."""
    counted = {place: each["held"] for place, each in found.items() if each.get("held")}
    lines = [
        "",
        f"95 % intervals of {len(counted)} of these courses. Refused: with a warning, or none. Low: kinds with less "
        f"than {100 * LEAST_SHARE:.0f} % of at least {FEWEST} intervals of a base, the worst {SHOWN}.",
        "",
        "| quantity | intervals | hold | refused | low |",
        "|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(name for each in counted.values() for name in each):
        some = {place: each[name] for place, each in counted.items() if name in each}
        inside, told, asked = (sum(each[i] for each in some.values()) for i in range(3))
        cells: dict[tuple[str, str], list[int]] = {}
        for (base, kind, _), each in some.items():
            cell = cells.setdefault((base, kind), [0, 0])
            cell[0], cell[1] = cell[0] + each[0], cell[1] + each[1]
        low: dict[str, float] = {}
        for (_, kind), (h, n) in cells.items():
            if n >= FEWEST and h < LEAST_SHARE * n:
                low[kind] = min(low.get(kind, 1.0), h / n)
        words = ", ".join(
            f"{kind} {100 * share:.0f} %" for kind, share in sorted(low.items(), key=lambda item: item[1])
        )
        share = f"{100 * inside / told:.1f} %" if told else ""
        refused = f"{100 * (1 - told / asked):.0f} %" if asked else ""
        lines.append(f"| {name} | {told} | {share} | {refused} | {words} |")
    return lines


def main(options: argparse.Namespace) -> None:
    """Write the section."""
    with tempfile.TemporaryDirectory() as folder:
        options.kept = options.kept or Path(folder, "kept")
        find(options)
        kept = lines_of(options.kept)
        lines = judged(kept) + interval_table(kept)
    before, _, after = FILE.read_text(encoding="utf-8").partition(SECTION)
    _, following, rest = after.partition("\n### ")
    FILE.write_text("\n".join([before + SECTION, "", *lines, following + rest]), encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("seeds", type=int, nargs="?", default=4)
    parser.add_argument("first", type=int, nargs="?", default=FIRST_SEED)
    parser.add_argument("--kept", type=Path, help="file of what was found, which is read and added to")
    parser.add_argument("--base", action="append", help="one of the base devices, as the table names it")
    parser.add_argument("--kind", action="append", help="one of the kinds, as the table names it")
    parser.add_argument("--again", action="store_true", help="find again what the file holds")
    main(parser.parse_args())

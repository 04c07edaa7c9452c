"""Write falcon.md: which parts of a real loop may explain what the thesis measured with its two Falcons.

    python docs/make_falcon.py search KEPT [rounds [seed]]   draws devices of each family; adds what they do to KEPT
    python docs/make_falcon.py write KEPT                    the best of each family, at full size, into falcon.md

A round draws one device of each family at random and one near the best so far for each Falcon, simulates the thesis's
course with it (a ninth of its trials, some 60 s a round on a free core) and reads from the logs what the thesis printed
of its own.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import inf, log
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pipeline.device.parts import LoopTable, Mode
from pipeline.device_data.devices import load_device
from pipeline.device_data.published import find
from pipeline.measured.signal.verdict import judge
from pipeline.records.models import Device
from pipeline.records.trials import Floats, Trial
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.simulation.sweep import SimulatedSweep, run_sweep

FILE = Path(__file__).with_name("falcon.md")
FIGURE = Path(__file__).parent / "img" / "falcon.svg"
SECTION = "## Numbers"
COARSEN, SEEDS = 3, (1, 2, 3)
WINDOW = 40
"""Last samples of a log whose mean is its measured final position."""

DELAY, MASS = 4, 0.58
"""Samples dropped before the costs, and the mass of their kinetic energy [kg], as in the thesis (6.1.4)."""

ENERGIES = tuple(f"energy_step_w{w}" for w in range(3))
NAMES = {
    "settle_2pct": "settling time [T]",
    "overshoot": "stiffest wall without overshoot [N/m]",
    **{name: f"energy, w = {name[-1]}" for name in ENERGIES},
    "line": "rms off the line [N/m]",
    "origin": "limits near the origin over d = 3",
    "stiffest": "stiffest stable wall [N/m]",
    "period": "period at K = 400, B = 4 [s]",
    "damping": "b by the limit at K = 0 [Ns/m]",
}
PERIOD_WALL = (400.0, 4.0)
MOMENTUM_ROWS, MOMENTUM_DELAY = 15, 5
HALF_PERIOD = 180
"""Samples after the first maximum within which the next minimum is looked for."""

FALCONS = {"A": ("1", "6"), "B": ("2", "7")}
"""Experiments without an operator and with a firm grip of Falcon A, of Falcon B with and without its stiff base."""

GRIP_MASS, GRIP_DAMPING = 0.42, 30.0
"""What a firm grip adds (Table 6.2) [kg, Ns/m]."""

TOLERANCE = {
    **dict.fromkeys(("settle_2pct", *ENERGIES), 0.1),
    "overshoot": 0.15,
    "line": 1500.0,
    "origin": 0.08,
    "stiffest": 0.15,
    "period": 0.05,
    "damping": 1.5,
}
"""One unit of residual: natural logarithms of ratios, but N/m for the line and Ns/m for b. About twice what another
seed changes (costs), a step of the course (limits), and what words such as "roughly" leave open."""

COLOURS = ("#0969da", "#1a7f37", "#9a6700", "#8250df")

Values = dict[str, float]


@dataclass(frozen=True)
class Candidate:
    """One device that may be the Falcon: mass [kg], viscous damping [Ns/m], delays drawn from, parts of the loop."""

    family: str
    mass: float = MASS
    damping: float = 4.0
    delays: tuple[int, ...] = ()
    delay: float = 4.0
    loop: Mapping[str, Any] | None = None

    def device(self, firm: bool = False) -> Device:
        """Return the device with one experiment, in the hand of an operator or free."""
        base = load_device("falcon")
        chosen = next(e for e in base.experiments if e.name == ("6" if firm else "1"))
        update = {
            "mass": self.mass + firm * GRIP_MASS,
            "damping": self.damping + firm * GRIP_DAMPING,
            "delay_samples": self.delay,
            "jitter_samples": self.delays,
        }
        experiment = chosen.model_copy(update=update)
        loop = LoopTable.model_validate(dict(self.loop or {}))
        if firm and loop.mode is not None:
            loop = loop.model_copy(update={"mode": _held(loop.mode, self.mass)})
        return base.model_copy(update={"experiments": (experiment,), "tables": (), "loop": loop})

    def course(self, coarsen: int, seed: int, firm: bool = False) -> SimulatedSweep:
        """Return the thesis's course with an ideal sensor, whose noise would swamp an energy with w = 2."""
        device = self.device(firm)
        name = device.experiments[0].name
        return run_sweep(device, name, sensor={}, coarsen=coarsen, seed=seed)

    def words(self) -> str:
        """Return what is not ideal, with its numbers."""
        loop = dict(self.loop or {})
        found = [f"m = {self.mass:.2f} kg", f"b = {self.damping:.1f} Ns/m"]
        found.append(f"d in {{{', '.join(map(str, self.delays))}}}" if self.delays else f"d = {self.delay:.2f}")
        if friction := loop.get("friction"):
            coulomb, stiction = friction["coulomb"], friction.get("stiction")
            found.append(f"friction {coulomb:.2f} N" + (f", stiction {stiction:.2f} N" if stiction else ""))
        if velocity := loop.get("velocity"):
            is_difference = velocity["kind"] == "difference"
            size = f"{velocity.get('samples')} samples" if is_difference else f"{velocity['cutoff_hz']:.0f} Hz"
            found.append(f"velocity over {size}" if is_difference else f"order {velocity['order']} at {size}")
        if lag := loop.get("actuator_lag_s"):
            found.append(f"lag {1e3 * lag:.2f} ms")
        if mode := loop.get("mode"):
            found.append(f"mode {mode['frequency_hz']:.0f} Hz, {mode['damping_ratio']:.3f}, {mode['mass']:.3f} kg")
        return ", ".join(found)


def _held(mode: Mode, mass: float) -> Mode:
    """Return a mode whose far mass a hand holds: its spring and damper stay, the mass grows by that of the hand."""
    near = mass - mode.mass
    far = mode.mass + GRIP_MASS
    change = (1 / near + 1 / far) / (1 / near + 1 / mode.mass)
    update = {"mass": far, "frequency_hz": mode.frequency_hz * change**0.5}
    return mode.model_copy(update={**update, "damping_ratio": mode.damping_ratio * change**0.5})


def limits(course: SimulatedSweep) -> Floats:
    """Return damping and stiffness limit, shape (n, 2), of each damping with an unstable trial."""
    (K, B), found = (course.trials.stiffness, course.trials.damping), []
    for damping in np.unique(B[B >= 0]):
        at = (damping == B) & (K > 0)
        unstable = K[at & (course.verdict == "unstable")].min(initial=inf)
        stable = K[at & (course.verdict == "stable") & (unstable > K)].max(initial=0.0)
        if unstable < inf:
            found.append((damping, 0.5 * (stable + unstable)))
    return np.array(found).reshape(-1, 2)


def stable_trials(course: SimulatedSweep) -> list[Trial]:
    """Return the stable trials behind a wall."""
    verdicts = zip(course.trials, course.verdict.tolist(), strict=True)
    return [trial for trial, verdict in verdicts if verdict == "stable" and trial.stiffness > 0]


def costs(course: SimulatedSweep, measured: bool) -> dict[str, Floats]:
    """Return K, B and the costs of the stable trials, by sums over whole logs (thesis 5.7, 5.14, 6.1.4).

    ``measured`` takes the mean of the last samples as final position in place of x_0 + F_0/K.
    """
    edge, longest = course.setup.edge_row, course.trials.rows.max()
    kept = [trial for trial in stable_trials(course) if trial.rows == longest]
    x, K, B = (np.array([getattr(trial, name) for trial in kept]) for name in ("position", "stiffness", "damping"))
    step, start = course.setup.step, x[:, :edge].mean(axis=1)
    final = x[:, -WINDOW:].mean(axis=1) if measured else start + step / K
    rest = x[:, edge + DELAY :]
    error, span = rest - final[:, None], np.abs(final - start)[:, None]
    outside = np.abs(error) > 0.02 * span
    settle = rest.shape[1] - np.argmax(outside[:, ::-1], axis=1).astype(float)
    velocity = np.diff(rest, axis=1, prepend=rest[:, :1]) / course.setup.loop.sampling_period_s
    energy = (0.5 * K[:, None] * error**2 + 0.5 * MASS * velocity**2) / (step**2 / (2 * K))[:, None]
    k = np.arange(rest.shape[1])
    found = {"stiffness": K, "damping": B, "settle_2pct": np.where(settle < rest.shape[1] - 5, settle, np.nan)}
    found["overshoot"] = np.maximum(0.0, (error / span).max(axis=1))
    return found | {name: (k**w * energy).sum(axis=1) for w, name in enumerate(ENERGIES)}


def period(candidate: Candidate) -> float:
    """Return twice the time from the maximum to the next minimum at K = 400 and B = 4 [s]; NaN where it rests."""
    setup = setup_of(candidate.device(), candidate.device().experiments[0]).with_loop(sensor={})
    x = simulate(setup, *(np.array([value]) for value in PERIOD_WALL), seed=1, stream="period").position
    top = int(np.argmax(x))
    half = int(np.argmin(x[top : top + HALF_PERIOD]))
    return 2 * half * setup.loop.sampling_period_s if 0 < half < HALF_PERIOD - 1 else np.nan


def numbers(candidate: Candidate, course: SimulatedSweep, origin: Floats, measured: bool) -> Values:
    """Return what the thesis printed, of a simulated course."""
    cost, edge = costs(course, measured), limits(course)
    upper = edge[(edge[:, 0] >= 104) & (edge[:, 0] <= 160)]
    lower = edge[(edge[:, 0] > 0) & (edge[:, 0] <= 40)]
    ideal = np.interp(lower[:, 0], origin[:, 0], origin[:, 1])
    free, judged = course.trials.stiffness == 0, course.verdict
    values = {name: float(np.nanmin(cost[name])) for name in ("settle_2pct", *ENERGIES)}
    values["overshoot"] = float(cost["stiffness"][cost["overshoot"] <= 1e-9].max(initial=0.0))
    values["line"] = float(np.sqrt(np.mean((upper[:, 1] - 38_000 + 230 * upper[:, 0]) ** 2)))
    values["origin"] = float(np.exp(np.mean(np.log(lower[:, 1] / ideal))))
    values["stiffest"] = float(edge[:, 1].max())
    values["period"] = period(candidate)
    values["damping"] = float(-course.trials.damping[free & (judged != "unstable")].min(initial=0.0))
    return values


def momentum_mass(course: SimulatedSweep) -> float:
    """Return the median mass by (6.4) as in 6.1.2: the first 15 ms after the step, the command taken 5 ms late [kg]."""
    edge, last = course.setup.edge_row, course.setup.edge_row + MOMENTUM_ROWS
    ratio = [
        trial.command[edge : last - MOMENTUM_DELAY].sum() / (trial.position[last] - trial.position[last - 1])
        for trial in stable_trials(course)
    ]
    return float(np.median(ratio) * course.setup.loop.sampling_period_s**2)


def firm_grip(candidate: Candidate, measured: bool, seed: int) -> Values:
    """Return what Table D.3 and the line are with a firm grip."""
    course = candidate.course(1, seed, firm=True)
    cost, edge = costs(course, measured), limits(course)
    upper = edge[(edge[:, 0] >= 100) & (edge[:, 0] <= 160)]
    return {
        "settle_2pct": float(np.nanmin(cost["settle_2pct"])),
        "overshoot": float(cost["stiffness"][cost["overshoot"] <= 1e-9].max(initial=0.0)),
        "energy_step_w2": float(np.nanmin(cost["energy_step_w2"])),
        "line": float(np.sqrt(np.mean((upper[:, 1] - 38_000 + 230 * upper[:, 0]) ** 2))),
    }


def printed(falcon: str, firm: bool = False) -> Values:
    """Return what the thesis prints of a Falcon."""
    experiment = f"experiment_{FALCONS[falcon][firm]}"
    found: Values = {}
    for name in ("settle_2pct", "overshoot", *ENERGIES):
        tables = ("D.3",) if firm else ("D.1", "D.2")
        row = next((r for table in tables if (r := find(table, name, experiment))), None)
        if row is not None:
            found[name] = float(row.stiffness or 0.0) if name == "overshoot" else row.cost
    found["line"] = 0.0
    if not firm:
        # 6.1.3: like d = 3 near the origin; the right part, above 11 kN/m, depends on the base; fig. 6.2; Table 6.2
        found |= {"origin": 1.0, "stiffest": 14_000.0, "period": 0.218, "damping": 4.0 if falcon == "A" else 2.0}
    return found


def residuals(values: Values, target: Values) -> Values:
    """Return the differences from what is printed in units of their tolerances."""
    return {
        name: (values[name] - wanted if name in ("line", "damping") else log(max(values[name], 1e-9) / wanted))
        / TOLERANCE[name]
        for name, wanted in target.items()
    }


def misfit(values: Values, target: Values) -> float:
    """Return the sum of squared residuals, each counted as 10 at most; what is not had counts as 10."""
    parts = np.array(list(residuals(values, target).values()))
    return float((np.where(np.isfinite(parts), np.minimum(np.abs(parts), 10.0), 10.0) ** 2).sum())


Draw = Callable[[np.random.Generator], dict[str, Any]]


def _delays(random: np.random.Generator) -> dict[str, Any]:
    choice = ((3, 4, 5), (3, 4, 4, 5), (3, 3, 4, 4, 5), (3, 4))
    return {"delays": choice[int(random.integers(len(choice)))]}


def _friction(random: np.random.Generator) -> dict[str, Any]:
    coulomb = random.uniform(0.1, 1.3)
    stiction = {} if random.random() < 0.5 else {"stiction": coulomb * random.uniform(1.0, 2.0)}
    return {"friction": {"coulomb": coulomb, **stiction, "stribeck_velocity": random.uniform(0.003, 0.02)}}


def _difference(random: np.random.Generator) -> dict[str, Any]:
    return {"velocity": {"kind": "difference", "samples": int(random.integers(2, 5))}}


def _butterworth(random: np.random.Generator) -> dict[str, Any]:
    cutoff = {"order": int(random.integers(1, 3)), "cutoff_hz": random.uniform(60, 400)}
    return {"velocity": {"kind": "butterworth", **cutoff}}


def _lag(random: np.random.Generator) -> dict[str, Any]:
    return {"actuator_lag_s": random.uniform(3e-4, 3e-3)}


def _mode(sensor: str, far: tuple[float, float] = (0.01, 0.15), highest: float = 110.0) -> Draw:
    def draw(random: np.random.Generator) -> dict[str, Any]:
        mode = {"mass": random.uniform(*far), "sensor": sensor, "damping_ratio": random.uniform(0.005, 0.06)}
        return {"mode": {**mode, "frequency_hz": random.uniform(35, highest)}}

    return draw


FAMILIES: dict[str, tuple[tuple[Draw, ...], bool]] = {
    "jitter": ((), False),
    "jitter, filter (Butterworth)": ((_butterworth,), False),
    "jitter, mode at the motor": ((_mode("motor"),), False),
    "jitter, smaller mass": ((), True),
    "jitter, friction": ((_friction,), False),
    "jitter, friction, lag": ((_friction, _lag), False),
    "jitter, friction, filter (difference)": ((_friction, _difference), False),
    "jitter, friction, filter (Butterworth)": ((_friction, _butterworth), False),
    "jitter, friction, mode at the motor": ((_friction, _mode("motor")), False),
    "jitter, friction, mode at the load": ((_friction, _mode("load")), False),
    "jitter, friction, soft joint before the handle": ((_friction, _mode("motor", (0.1, 0.42), 250.0)), False),
    "jitter, friction, smaller mass": ((_friction,), True),
    "jitter, friction, filter (difference), smaller mass": ((_friction, _difference), True),
}
"""Parts that a family draws, and whether its mass is drawn too. The thesis's own mass rests on the first 15 ms."""


def drawn(family: str, random: np.random.Generator) -> Candidate:
    """Return a device of a family."""
    parts, lighter = FAMILIES[family]
    loop: dict[str, Any] = {}
    for part in parts:
        loop |= part(random)
    mass = random.uniform(0.42, MASS) if lighter else MASS
    return Candidate(family, mass, random.uniform(1.0, 4.0), **_delays(random), loop=loop)


def nearby(best: Candidate, random: np.random.Generator) -> Candidate:
    """Return a device close to another of its family: each number changed by some 12 %."""

    def moved(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: moved(inner) for key, inner in value.items()}
        return value * float(np.exp(0.12 * random.normal())) if isinstance(value, float) else value

    loop = moved(dict(best.loop or {}))
    friction = loop.get("friction", {})
    if "stiction" in friction:
        friction["stiction"] = max(friction["stiction"], friction["coulomb"])
    mass = moved(best.mass) if best.mass != MASS else MASS
    return replace(best, mass=mass, damping=moved(best.damping), loop=loop, **_delays(random))


def ideal_origin() -> Floats:
    """Return the limits of the ideal loop with d = 3, which the measured ones follow near the origin."""
    return limits(Candidate("ideal", delay=3.0).course(COARSEN, 0))


def search(kept: Path, rounds: int, seed: int) -> None:
    """Add devices and their numbers to a file, a JSON document a line."""
    random, origin = np.random.default_rng(seed), ideal_origin()
    found = list(read(kept))
    for number in range(rounds):
        for family in FAMILIES:
            mine = [(values, candidate) for candidate, values, _ in found if candidate.family == family]
            tries = [drawn(family, random)]
            for target in map(printed, FALCONS if mine else ()):
                tries.append(nearby(min(mine, key=lambda pair: misfit(pair[0], target))[1], random))
            for candidate in tries:
                course = candidate.course(COARSEN, number)
                for measured in (True, False):
                    values = numbers(candidate, course, origin, measured)
                    found.append((candidate, values, measured))
                    line = {"candidate": vars(candidate), "values": values, "measured": measured}
                    with kept.open("a", encoding="utf-8") as stream:
                        stream.write(json.dumps(line) + "\n")


def read(kept: Path) -> Iterator[tuple[Candidate, Values, bool]]:
    """Yield the devices of a file with their numbers and whether the final position was the measured one."""
    for line in kept.read_text(encoding="utf-8").splitlines() if kept.exists() else ():
        told = json.loads(line)
        candidate = Candidate(**{**told["candidate"], "delays": tuple(told["candidate"]["delays"])})
        yield candidate, told["values"], told["measured"]


def best_of(kept: Path) -> Iterator[tuple[str, Candidate, Values, bool, int]]:
    """Yield Falcon, best device of a family, its numbers, whether x_inf is measured, and how many were tried."""
    found = list(read(kept))
    for falcon in FALCONS:
        target = printed(falcon)
        for family in FAMILIES:
            mine = [(misfit(values, target), values, c, m) for c, values, m in found if c.family == family]
            if mine:
                _, values, candidate, measured = min(mine, key=lambda one: one[0])
                yield falcon, candidate, values, measured, len(mine) // 2


def family_table(kept: Path) -> Iterator[str]:
    """Yield the lines of a table: the best device of each family, its misfit and distance from the line, by Falcon."""
    rows: dict[str, list[str]] = {}
    tried = []
    for falcon in FALCONS:
        for _, candidate, values, _, number in _ranked(kept, falcon):
            cells = [f"{misfit(values, printed(falcon)):.0f}", f"{values['line'] / 1e3:.1f}"]
            rows.setdefault(candidate.family.removeprefix("jitter").lstrip(", ") or "none", []).extend(cells)
            tried.append(number)
    yield "\n### Families\n"
    yield (
        f"The table lists the best of {min(tried)} to {max(tried)} devices of each family, with its misfit, and "
        "the rms distance of the limits at B = 104 to 160 from the line [kN/m].\n"
    )
    yield "| parts in addition to jitter | " + " | ".join(f"{falcon}: misfit | line" for falcon in FALCONS) + " |"
    yield "|---" * (1 + 2 * len(FALCONS)) + "|"
    for family, cells in rows.items():
        yield f"| {family} | " + " | ".join(cells) + " |"


def full_size(kept: Path, count: int = 3) -> Iterator[str]:
    """Yield the lines of a table: the best devices of both Falcons, with all trials, beside what is printed."""
    origin = limits(Candidate("ideal", delay=3.0).course(1, 0))
    rows: dict[str, list[str]] = {}
    devices = []
    for falcon in FALCONS:
        target, grip = printed(falcon), printed(falcon, firm=True)
        names = [name for name in NAMES if name in target]
        cells = {NAMES[name]: [_wanted(name, target)] for name in names} | {"mass by (6.4) [kg] *": [f"{MASS}"]}
        cells[f"firm grip: {NAMES['line']} *"] = [_wanted("line", grip)]
        for number, (_, candidate, _, measured, _) in enumerate(_ranked(kept, falcon)[:count], 1):
            courses = [candidate.course(1, seed) for seed in SEEDS]
            free = [numbers(candidate, course, origin, measured) for course in courses]
            held = [firm_grip(candidate, measured, seed) for seed in SEEDS]
            spans = [_span([values[name] for values in free]) for name in names]
            spans += [_span([momentum_mass(course) for course in courses])]
            spans += [_span([values["line"] for values in held])]
            for column, span in zip(cells.values(), spans, strict=True):
                column.append(span)
            devices.append(f"* {falcon}{number}: {candidate.words()}")
        for name, column in cells.items():
            rows.setdefault(name, []).extend(column)
    heads = [f"{falcon} printed | " + " | ".join(f"{falcon}{n + 1}" for n in range(count)) for falcon in FALCONS]
    yield f"\n### The first {count} families, all trials, {len(SEEDS)} seeds; *: not fitted\n"
    yield "| number | " + " | ".join(heads) + " |"
    yield "|---" * (1 + len(FALCONS) * (1 + count)) + "|"
    for name, column in rows.items():
        yield f"| {name} | " + " | ".join(column) + " |"
    yield ""
    yield from devices


def _wanted(name: str, target: Values) -> str:
    return "0" if name == "line" else f"{target[name]:g}"


def _ranked(kept: Path, falcon: str) -> list[tuple[str, Candidate, Values, bool, int]]:
    """Return the best device of each family for a Falcon, the best family first."""
    mine = [row for row in best_of(kept) if row[0] == falcon]
    return sorted(mine, key=lambda row: misfit(row[2], printed(falcon)))


def _span(values: list[float]) -> str:
    low, high = min(values), max(values)
    return "–".join(dict.fromkeys(f"{v:.3g}" if v < 100 else f"{v:.0f}" for v in (low, high)))


def limit_at(candidate: Candidate, damping: float, step: float) -> tuple[float, float]:
    """Return the stiffness limit [N/m] at one damping for a step [N], and the frequency of the first unstable trial."""
    device = candidate.device()
    setup = setup_of(device, device.experiments[0]).with_loop(sensor={})
    setup = replace(setup, step=step, travel=inf, rows=700)
    stiffness = np.arange(500.0, 24_000.0, 250.0)
    trials = simulate(setup, stiffness, np.full(len(stiffness), damping), seed=3, stream="limit")
    first = next((trial for trial in trials if judge(trial).verdict == "unstable"), None)
    if first is None:
        return np.nan, np.nan
    x = np.diff(first.position[-400:])
    spectrum = np.abs(np.fft.rfft(x * np.hanning(len(x)), 8192))
    return first.stiffness, float(np.argmax(spectrum) / 8192 / setup.loop.sampling_period_s)


def decisive(kept: Path, count: int = 3) -> Iterator[str]:
    """Yield the lines of a table of what further measurements would show of each of the best devices."""
    yield "\n### What would distinguish them\n"
    yield (
        "The table states the limit at B = 24 [N/m] for each step (none: above 23,750), the frequency of "
        "trials just beyond the limit [Hz] for each B, and the scatter of K Δx − F_0 [N].\n"
    )
    yield "| device | 2 / 8 / 16 N | B = 104 / 128 / 152 | scatter |"
    yield "|---" * 4 + "|"
    for falcon in FALCONS:
        for number, (_, candidate, *_) in enumerate(_ranked(kept, falcon)[:count], 1):
            steps = "/".join(f"{limit_at(candidate, 24.0, step)[0]:.0f}" for step in (2.0, 8.0, 16.0))
            tones = "/".join(f"{limit_at(candidate, damping, 8.0)[1]:.0f}" for damping in (104.0, 128.0, 152.0))
            course = candidate.course(COARSEN, 1)
            moved = [trial.stiffness * trial.displacement[-WINDOW:].mean() for trial in stable_trials(course)]
            rest = float(np.std(np.array(moved) - course.setup.step))
            yield f"| {falcon}{number} | {steps.replace('nan', 'none')} | {tones} | {rest:.2g} |"


def draw(kept: Path) -> None:
    """Draw the limits of the best families beside the printed line and the ideal loops."""
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    families = list(dict.fromkeys(row[1].family for falcon in FALCONS for row in _ranked(kept, falcon)[:3]))
    for axes, falcon in zip(figure.subplots(1, 2, sharey=True), FALCONS, strict=True):
        damping = np.linspace(85, 165, 2)
        axes.plot(damping, (38_000 - 230 * damping) / 1e3, "k:", label="printed line (6.5)")
        for delay, dash in ((3.0, "--"), (4.0, "-.")):
            edge = limits(Candidate("ideal", delay=delay).course(2, 0))
            axes.plot(edge[:, 0], edge[:, 1] / 1e3, dash, color="0.55", label=f"ideal, d = {delay:g}")
        for _, candidate, _, _, _ in _ranked(kept, falcon)[:3]:
            edge = limits(candidate.course(2, 1))
            colour = COLOURS[families.index(candidate.family) % len(COLOURS)]
            axes.plot(edge[:, 0], edge[:, 1] / 1e3, color=colour, label=candidate.family)
        axes.set(title=f"Falcon {falcon}, simulated", xlabel="damping B [Ns/m]", xlim=(0, 184), ylim=(0, 22))
    figure.axes[0].set_ylabel("stiffness limit K [kN/m]")
    lines = {line.get_label(): line for axes in figure.axes for line in axes.lines}
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    figure.savefig(FIGURE, metadata={"Date": None})


def write(kept: Path) -> None:
    """Replace the tables of falcon.md, and the figure."""
    lines = [*family_table(kept), *full_size(kept), *decisive(kept)]
    head, _, _ = FILE.read_text(encoding="utf-8").partition(SECTION)
    FILE.write_text(f"{head}{SECTION}\n" + "\n".join(lines) + "\n", encoding="utf-8")
    draw(kept)


def main() -> None:
    """Search or write, as the command line says."""
    action, kept, *more = sys.argv[1:]
    if action == "search":
        rounds, seed = (int(value) for value in (*more, *("20", "1")[len(more) :]))
        search(Path(kept), rounds, seed)
    else:
        write(Path(kept))


if __name__ == "__main__":
    main()

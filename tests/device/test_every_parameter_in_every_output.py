"""A table: each number of a loop in each output, for both motions and two force gains.

In each cell the output equals an independent computation (`state_matrix`: matrix exponentials in absolute coordinates,
eigenvalues, sums over aliases; `fine_loop`: fine integration), or it names the part as not included. A parameter
without a row fails the first test; a new output is a function in `COLUMNS`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import fine_loop
import numpy as np
import pytest
from device_files import written
from scipy.signal import dstep
from state_matrix import needed_damping, radius, step_response
from typer.testing import CliRunner

import pipeline
from pipeline import PipelineError, design, published_limits
from pipeline.device.parameters import PARAMETERS, Motion
from pipeline.device_data.devices import read_device
from pipeline.planning.planner import plan
from pipeline.service.theory import document as rest
from pipeline.shell.cli import application
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.surface.identify import Reading, device_text, identified_device
from pipeline.theory.cases import Case, case_of, limits_of_walls

MODE = {"frequency_hz": 60.0, "damping_ratio": 0.02, "mass": 0.15, "load_damping": 1.0}
KALMAN = {"kind": "kalman", "acceleration": 300.0, "noise": 1e-3}
FOAW = {"kind": "foaw", "bound": 2e-5, "longest": 8}
BUTTERWORTH = {"kind": "butterworth", "order": 2, "cutoff_hz": 80.0}
OPERATOR = {"mass": 0.1, "damping": 9.0, "stiffness": 50.0}
FRICTION = {"coulomb": 0.5, "stiction": 0.8, "stribeck_velocity": 0.02}

ROWS: dict[str, tuple[dict[str, Any], ...]] = {
    "mass": ({"mass": 0.7},),
    "damping": ({"damping": 6.0},),
    "stiffness": ({"stiffness": 400.0},),
    "sampling_period_s": ({"sampling_period_s": 0.0005},),
    "delay_samples": ({"delay_samples": 2.4},),
    "jitter_samples": ({"delay_samples": 3.0, "jitter_samples": (2, 3, 4)},),
    "force_gain": ({},),
    "actuator_lag_s": ({"actuator_lag_s": 0.002},),
    "velocity.cutoff_hz": ({"velocity": BUTTERWORTH},),
    "velocity.order": ({"velocity": BUTTERWORTH | {"order": 1}},),
    "velocity.samples": ({"velocity": {"kind": "difference", "samples": 4}},),
    "velocity.acceleration": ({"velocity": KALMAN}, {"velocity": {"kind": "levant", "acceleration": 50.0}}),
    "velocity.noise": ({"velocity": KALMAN | {"noise": 3e-4}},),
    "velocity.bound": ({"velocity": FOAW},),
    "velocity.longest": ({"velocity": FOAW | {"longest": 3}},),
    "mode.frequency_hz": ({"mode": MODE}, {"mode": MODE | {"sensor": "load"}}),
    "mode.damping_ratio": ({"mode": MODE | {"damping_ratio": 0.1}},),
    "mode.mass": ({"mode": MODE | {"mass": 0.3}},),
    "mode.load_damping": ({"mode": MODE | {"load_damping": 2.0}},),
    "operator.mass": ({"operator": OPERATOR}, {"operator": OPERATOR, "mode": MODE}),
    "operator.damping": ({"operator": OPERATOR | {"damping": 3.0}},),
    "operator.stiffness": ({"operator": OPERATOR | {"stiffness": 300.0}},),
    "friction.coulomb": ({"friction": {"coulomb": 0.5}},),
    "friction.stiction": ({"friction": FRICTION},),
    "friction.stribeck_velocity": ({"friction": FRICTION | {"stribeck_velocity": 0.01}},),
    "constant_force": ({"constant_force": -0.7},),
    "force_limit": ({"force_limit": 8.0},),
    "sensor.quantum": ({"sensor": {"quantum": 2e-5}},),
    "sensor.noise": ({"sensor": {"noise": 1e-5}},),
}
"""Parts of loops in which a parameter acts."""

LEFT_OUT = {"jitter_samples": "jitter", "velocity.bound": "velocity", "velocity.longest": "velocity"}
LEFT_OUT |= {name: "friction" for name in PARAMETERS if name.startswith("friction.")}
"""Parameters that no output of linear theory includes, with the name by which the output reports them."""

NO_PART_OF_THE_MOTION = {
    "constant_force": "moves the rest position, not the motion about it",
    "force_limit": "is reached by large motions alone",
    "sensor.quantum": "is smaller than the motion",
    "sensor.noise": "is smaller than the motion",
}
"""Parameters that a linear motion about the rest position does not depend on, and why."""

WHOLE = ("velocity.order", "velocity.samples", "velocity.longest")

FAST = {
    ("rotation", 2.0): (),
    ("translation", 0.4): ("design", "optimum", "margins", "passive wall", "theory boundary", "first wall of a plan"),
}
"""Motion and gain of the fast set, with the columns that are slow there."""

SLOW = ("optimum of a cost", "theory boundary by command and REST", "identify")
"""Columns that are slow for all."""

IDENTIFY_ONCE = (
    *("mass", "stiffness", "delay_samples", "jitter_samples", "force_gain", "actuator_lag_s", "velocity.cutoff_hz"),
    *("velocity.samples", "mode.frequency_hz", "operator.stiffness", "friction.coulomb", "constant_force"),
)
"""Rows that logs are identified of, one of each part, for one motion and gain: each takes half a minute."""


@dataclass(frozen=True)
class Cell:
    """A loop, the folder with its device file, and two walls, of which the second is unstable."""

    loop: pipeline.Loop
    folder: Path

    @property
    def linear(self) -> pipeline.Loop:
        """The loop as linear theory takes it."""
        return replace(self.loop, friction=None, jitter_samples=())

    @cached_property
    def file(self) -> Path:
        return written(self.folder, self.loop, duration_s=0.12, baseline_s=0.01, step=10.0)

    @property
    def top(self) -> tuple[float, float]:
        return _top(self.linear)

    @property
    def wall(self) -> tuple[float, float]:
        return 0.4 * self.top[0], 0.8 * self.top[1]

    @property
    def unstable(self) -> tuple[float, float]:
        return 1.5 * self.top[0], self.top[1]

    def reports(self, left_out: Any) -> None:
        """Compare the parts that an output reports as not included with those of the loop."""
        assert tuple(left_out or ()) == self.loop.left_out

    def is_limit(self, stiffness: float, damping: float) -> None:
        """Compare a largest stiffness with the poles of the state matrix, of it and of all softer walls."""
        softer = np.append(np.linspace(0.02, 0.98, 13), 1 - 1e-6)
        assert max(radius(self.loop, share * stiffness, damping) for share in softer) < 1
        assert radius(self.loop, (1 + 1e-6) * stiffness, damping) > 1


@lru_cache
def _top(loop: pipeline.Loop) -> tuple[float, float]:
    found = loop.boundary(12).attrs
    return found["stiffness_max"], found["damping_at_stiffness_max"]


def boundary(cell: Cell) -> None:
    frame = cell.loop.boundary(12)
    cell.reports(frame.attrs.get("left_out"))
    K, B = frame.attrs["stiffness_max"], frame.attrs["damping_at_stiffness_max"]
    assert radius(cell.loop, 0.9999 * K, B) < 1 < radius(cell.loop, 1.001 * K, B)
    border = frame[(frame["stiffness"] > 0.1 * K)]
    for wall in border.iloc[:: max(1, len(border) // 4)].itertuples():
        assert radius(cell.loop, wall.stiffness, wall.damping) == pytest.approx(1, abs=1e-6)
    assert frame.attrs["units"]["stiffness"] == PARAMETERS["stiffness"].unit(cell.loop.motion)


def points(cell: Cell) -> None:
    frame = cell.loop.points(*np.array([cell.wall, cell.unstable]).T, ())
    cell.reports(frame.attrs.get("left_out"))
    assert frame["spectral_radius"].tolist() == pytest.approx(
        [radius(cell.loop, *wall) for wall in (cell.wall, cell.unstable)], abs=1e-9
    )
    assert frame["stable"].tolist() == [True, False]


def limits(cell: Cell) -> None:
    frame = cell.loop.limits([share * cell.top[1] for share in (0.3, 0.8)])
    cell.reports(frame.attrs.get("left_out"))
    for B, K in frame.itertuples(index=False):
        if np.isnan(K):
            assert radius(cell.loop, 1e-3 * cell.top[0], B) > 1
        else:
            cell.is_limit(K, B)


def optimum(cell: Cell) -> None:
    best = cell.loop.optimum("alpha_max")
    cell.reports(best.left_out)
    assert radius(cell.loop, 0.9999 * best.stiffness, best.damping) < 1
    assert radius(cell.loop, 1.001 * best.stiffness, best.damping) > 1


def optimum_of_a_cost(cell: Cell) -> None:
    best = cell.loop.optimum("pole_radius")
    cell.reports(best.left_out)
    K, B = best.stiffness, best.damping
    assert best.cost == pytest.approx(radius(cell.loop, K, B), abs=1e-4)  # poles meet there
    if K > 0 or "negative" not in (best.note or ""):
        around = [radius(cell.loop, k * K, b * B) for k, b in product((0.97, 1, 1.03), repeat=2) if (k, b) != (1, 1)]
        assert min(around) > best.cost - 1e-6


def cost_map(cell: Cell) -> None:
    frame = cell.loop.map(4, ["pole_radius"])
    cell.reports(frame.attrs.get("left_out"))
    for wall in frame.itertuples():
        expected = radius(cell.loop, wall.stiffness, wall.damping)
        if abs(expected - 1) > 1e-6 and wall.stiffness > 0:
            assert wall.stable == (expected < 1)
            assert not wall.stable or wall.pole_radius == pytest.approx(expected, abs=1e-6)


def margins(cell: Cell) -> None:
    found, (K, B) = cell.loop.margins(*cell.wall), cell.wall
    cell.reports(found.left_out)
    assert found.gain is not None
    assert radius(cell.loop, found.gain * K, found.gain * B) == pytest.approx(1, abs=1e-7)
    assert found.delay is not None
    later = replace(cell.linear, delay_samples=cell.loop.delay_samples + found.delay)
    assert radius(later, K, B) == pytest.approx(1, abs=1e-7)


def state_space(cell: Cell) -> None:
    system = cell.loop.to_state_space(*cell.wall)
    expected = step_response(cell.loop, *cell.wall, 60)
    assert dstep(system, n=60)[1][0][:, 0] == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def response(cell: Cell) -> None:
    """It starts when the command arrives, that of the state space when it is sent."""
    whole = float(cell.loop.delay_samples).is_integer()
    late = int(cell.loop.delay_samples) if whole else 0
    loop = cell.loop if whole else replace(cell.linear, delay_samples=2.0)
    late = int(loop.delay_samples)
    found = loop.response(*cell.wall, 60, per_sample=1)["position"].to_numpy()
    # the wall answers what it sees, whenever the motion began
    expected = step_response(loop, *cell.wall, 61 + late)[late:]
    assert found == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def passive(cell: Cell) -> None:
    if cell.loop.mode and cell.loop.mode.sensor == "load":
        with pytest.raises(PipelineError, match="no wall is passive"):
            cell.loop.passive()
        return
    frame, motor_damping = cell.loop.passive(), cell.loop.damping - cell.loop.load_damping
    cell.reports(frame.attrs.get("left_out"))
    for share in (1.0, 0.5):
        B = share * frame.attrs["damping_at_stiffness_max"]
        above = frame[frame["damping"] > -1e-9].sort_values("damping") if share < 1 else None
        K = frame.attrs["stiffness_max"] if above is None else float(np.interp(B, above["damping"], above["stiffness"]))
        assert needed_damping(cell.loop, K, B) == pytest.approx(motor_damping, rel=0.01)
    alone, K = replace(cell.linear, operator=None), frame.attrs["stiffness_max"]
    for m, k in product((0.1, 10.0), (0.0, 1e5)):
        hand = {"mass": m, "damping": 0.0, "stiffness": k}
        assert radius(replace(alone, operator=hand), K, frame.attrs["damping_at_stiffness_max"]) < 1


def published(cell: Cell) -> None:
    loop, (K, B), T = cell.loop, cell.wall, cell.loop.sampling_period_s
    frame = published_limits(loop, [0.0, B]).set_index(["condition", "damping"])
    exact = frame.loc[("exact", B)]
    cell.is_limit(exact["stiffness"], B)
    words = {"velocity": "velocity filter", "jitter": "jitter", "friction": "friction"}
    assert all(words[name] in exact["assumes"] for name in loop.left_out)
    hand, g = loop.operator, loop.force_gain
    b = (loop.damping + (hand.damping if hand else 0.0)) / g
    k = (loop.stiffness + (hand.stiffness if hand else 0.0)) / g
    m = (loop.mass + (hand.mass if hand else 0.0)) / g
    late = (loop.delay_samples + 0.5) * T
    assert frame.loc[("Minsky et al. 1990", B), "stiffness"] == pytest.approx(max((b + B) / late - k, 0.0))
    assert frame.loc[("Hulin et al. 2006, linear", B), "stiffness"] == pytest.approx((b + B) / late)
    assert frame.loc[("Gil et al. 2004", B), "stiffness"] == pytest.approx((b + B) / (0.5 * T))
    bare = pipeline.Loop(m, 0.0, T, 1)
    K = frame.loc[("Salcudean and Vlaar 1997", B), "stiffness"]
    assert K == 0 or np.isnan(K) or radius(bare, 0.9999 * K, B) < 1 < radius(bare, 1.0001 * K, B)
    motor_damping = (loop.damping - loop.load_damping) / g
    at_load = loop.mode is not None and loop.mode.sensor == "load"
    colgate = frame.loc[("Colgate and Schenkel 1997", 0.0), "stiffness"]
    assert colgate == pytest.approx(np.nan if at_load else 2 * motor_damping / T, nan_ok=True)
    hulin = frame.loc[("Hulin et al. 2014", 0.0), "stiffness"]
    simple = replace(cell.linear, velocity=None, actuator_lag_s=0.0, mode=None)
    assert (
        np.isnan(hulin) if at_load else needed_damping(simple, hulin, 0.0) == pytest.approx(motor_damping * g, rel=0.01)
    )
    abbott = frame.loc[("Abbott and Okamura 2005, Diolaiti et al. 2006", 0.0), "stiffness"]
    by_friction = np.inf
    if loop.friction and loop.sensor.quantum:
        by_friction = 2 * loop.friction.coulomb / (g * loop.sensor.quantum)
    if loop.sensor.quantum:
        assert abbott == pytest.approx(min(2 * motor_damping / T, by_friction if loop.friction else 0.0))
    else:
        assert np.isnan(abbott)
    unknown = {
        "velocity filter": loop.velocity is not None,
        "actuator lag": loop.actuator_lag_s > 0,
        "vibration mode": loop.mode is not None,
        "jitter": bool(loop.jitter_samples),
    }
    for (name, _), assumes in frame["assumes"].items():
        assert name == "exact" or all((part in assumes) == present for part, present in unknown.items()), name


def designed(cell: Cell) -> None:
    keep = ("mass", "damping", "delay_samples", "actuator_lag_s", "sampling_period_s", "velocity_cutoff_hz")
    answer = design(cell.loop, 0.8 * cell.top[0], keep=keep)
    cell.reports(answer.left_out)
    assert answer.reached
    limit, B = answer.wall["stiffness_limit"], answer.wall["damping"]
    assert limit is not None
    assert B is not None
    cell.is_limit(limit, B)
    assert limit >= 0.8 * cell.top[0]


def theory_by_command(cell: Cell) -> None:
    walls = cell.folder / "walls.csv"
    walls.write_text(f"stiffness,damping\n{cell.wall[0]!r},{cell.wall[1]!r}\n", encoding="utf-8")
    for command in (("points", str(walls)), ("optimum", "--criterion", "alpha_max")):
        text, found = (
            CliRunner().invoke(application("theory"), ["theory", *command, "--device", str(cell.file), *more]).stdout
            for more in ((), ("--json",))
        )
        document = json.loads(found)
        document = document[0] if command[0] == "points" else document
        cell.reports(document["left_out"])
        assert f"not included in linear theory: {', '.join(cell.loop.left_out)}" in text or not cell.loop.left_out
        if command[0] == "points":
            assert document["spectral_radius"] == pytest.approx(radius(cell.loop, *cell.wall), abs=1e-9)
        else:
            K, B = document["stiffness"], document["damping"]
            assert radius(cell.loop, 0.9999 * K, B) < 1 < radius(cell.loop, 1.001 * K, B)


def theory_documents(cell: Cell) -> None:
    """The document of ``theory boundary``, with fewer points than the command's."""
    case: Case = case_of(read_device(cell.file), read_device(cell.file).experiments[0])
    document = limits_of_walls(case, 12).to_json()
    cell.reports(document["left_out"])
    K, B = document["stiffness_max"], document["damping_at_stiffness_max"]
    assert radius(cell.loop, 0.9999 * K, B) < 1 < radius(cell.loop, 1.001 * K, B)
    jitter = cell.loop.jitter_samples or (cell.loop.delay_samples,)
    assert (document["delay_samples_low"], document["delay_samples_high"]) == (min(jitter), max(jitter))


def boundary_by_command_and_rest(cell: Cell) -> None:
    command = ["theory", "boundary", "--device", str(cell.file)]
    text, found = (CliRunner().invoke(application("theory"), [*command, *more]).stdout for more in ((), ("--json",)))
    assert f"not included in linear theory: {', '.join(cell.loop.left_out)}" in text or not cell.loop.left_out
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PIPELINE_DEVICES", str(cell.file.parent))
        served = rest("boundary", ("arm", None))
    for document in (json.loads(found), served):
        cell.reports(document["left_out"])
        K, B = document["stiffness_max"], document["damping_at_stiffness_max"]
        assert radius(cell.loop, 0.9999 * K, B) < 1 < radius(cell.loop, 1.001 * K, B)
        (shown,) = (line.split() for line in text.splitlines() if line.startswith("largest stiffness"))
        assert shown[2:] == [f"{K:.6g}", f"{B:.6g}"]


def theory_by_rest(cell: Cell) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PIPELINE_DEVICES", str(cell.file.parent))
        (point,) = rest("points", ("arm", None), [list(cell.wall)])
    cell.reports(point["left_out"])
    assert point["spectral_radius"] == pytest.approx(radius(cell.loop, *cell.wall), abs=1e-9)


def simulated(cell: Cell) -> None:
    """The log that `pipeline simulate` writes of the device file, against other steppers."""
    device = read_device(cell.file)
    setup, (K, B) = setup_of(device, device.experiments[0]), cell.wall
    log = simulate(setup, np.array([K]), np.array([B]))[0]
    position = log.displacement
    loop, edge, step = cell.loop, setup.edge_row, setup.step
    external = np.where(np.arange(setup.rows) < edge, 0.0, step)
    linear = step * step_response(loop, K, B, setup.rows)[: setup.rows - edge]
    linear = np.concatenate([np.zeros(edge), linear])
    size = np.abs(linear).max()
    if loop.friction or loop.force_limit:
        friction = loop.friction
        body = fine_loop.Body(loop.mass, loop.damping, loop.stiffness)
        if friction:
            body.coulomb = friction.coulomb
            body.stiction = friction.coulomb if friction.stiction is None else friction.stiction
            body.stribeck = friction.stribeck_velocity
        late = int(loop.delay_samples), 1
        words = {"T": loop.sampling_period_s, "gain": loop.force_gain, "limit": loop.force_limit or np.inf}
        other, _ = fine_loop.run(body, K=K, B=B, external=external, delay=late, b=np.ones(1), a=np.ones(1), **words)
        assert position == pytest.approx(other, abs=1e-6 * size)
        assert np.abs(position - linear).max() > 1e-3 * size
    elif loop.left_out or loop.sensor.noise or loop.sensor.quantum:
        assert 0 < np.abs(position - linear).max() < size
        if quantum := loop.sensor.quantum:
            assert position / quantum == pytest.approx(np.round(position / quantum), abs=1e-6)
            assert np.abs(position - linear).max() > 0.1 * quantum
        if noise := loop.sensor.noise:
            assert 0.2 * noise < np.abs(position[:edge]).max() < 10 * noise
    else:
        assert position == pytest.approx(linear, abs=1e-9 * size)


def planned(cell: Cell) -> None:
    """The first wall of a device file without logs is half of what is stable at its damping."""
    answer = plan(str(cell.file), cell.folder / "processed")
    cell.reports(answer.left_out)
    text = str(answer)
    assert f"not included in linear theory: {', '.join(cell.loop.left_out)}" in text or not cell.loop.left_out
    wall, limit = answer.next[0], cell.loop.limits(answer.next[0].damping)["stiffness"][0]
    cell.is_limit(limit, wall.damping)
    assert 0.4 * limit < wall.stiffness < 0.51 * limit


def identified(cell: Cell) -> None:
    """The device file that `pipeline identify` writes of simulated logs has the limit of the device that made them."""
    longer = written(cell.folder, cell.loop, duration_s=0.4, baseline_s=0.02, step=10.0)
    write_sweep(run_sweep(read_device(longer), "1", coarsen=8), cell.folder / "raw")
    file = cell.folder / "identified.toml"
    file.write_text(
        device_text(identified_device(Reading([cell.folder / "raw"])).document, "identified"), encoding="utf-8"
    )
    device = read_device(file)
    loop, B = pipeline.Loop.of(device.loop_for(device.experiments[0])), cell.wall[1]
    assert set(cell.loop.left_out) <= set(loop.left_out)
    assert loop.motion == cell.loop.motion
    K = loop.limits(B)["stiffness"][0]
    assert radius(cell.loop, 0.97 * K, B) < 1 < radius(cell.loop, 1.03 * K, B)


COMPARISON: dict[str, Callable[[Cell], None]] = {}
"""Outputs of a comparison, to come: ``loop`` of ``compare --json``, passive wall, estimates, first screen."""

COLUMNS: dict[str, Callable[[Cell], None]] = {
    "boundary": boundary,
    "points": points,
    "limits": limits,
    "optimum": optimum,
    "optimum of a cost": optimum_of_a_cost,
    "map": cost_map,
    "margins": margins,
    "state space": state_space,
    "response": response,
    "passive wall": passive,
    "published limits": published,
    "design": designed,
    "simulate": simulated,
    "first wall of a plan": planned,
    "identify": identified,
    "theory by command": theory_by_command,
    "theory boundary": theory_documents,
    "theory by REST": theory_by_rest,
    "theory boundary by command and REST": boundary_by_command_and_rest,
    **COMPARISON,
}


def loops(name: str, motion: Any, gain: float) -> list[pipeline.Loop]:
    ideal = pipeline.Loop(0.5, 3.0, 0.001, 2.0, motion=motion, force_gain=gain)
    return [replace(ideal, **parts) for parts in ROWS[name]]


def test_every_parameter_has_a_row_in_which_it_acts() -> None:
    assert list(ROWS) == list(PARAMETERS)
    for name in PARAMETERS:
        assert any(loop.value(name) for loop in loops(name, "translation", 0.4)), name


@pytest.mark.parametrize("name", [name for name in PARAMETERS if name != "jitter_samples"])
def test_a_row_would_show_a_parameter_that_is_forgotten(name: str) -> None:
    """A change of the parameter moves the poles, or no output of linear theory includes it and says so."""
    loop = loops(name, "translation", 0.4)[0]
    value = loop.value(name)
    assert value is not None
    changed = loop.replace({name: int(value) + 1 if name in WHOLE else 1.01 * value})
    walls = ((2000.0, 10.0), (2000.0, 20.0), (9000.0, 60.0), (20000.0, 100.0))
    moved = max(abs(radius(changed, *wall) / radius(loop, *wall) - 1) for wall in walls)
    if name in LEFT_OUT:
        assert LEFT_OUT[name] in loop.left_out
    elif name in NO_PART_OF_THE_MOTION:
        assert moved == 0
    else:
        assert moved > 1e-7


def cell(name: str, motion: Motion, gain: float, column: str) -> Any:
    """Return the parameters of a cell of the table."""
    slow = column in (*SLOW, *FAST.get((motion, gain), (column,)))
    marks = [pytest.mark.slow] if slow else []
    return pytest.param(name, motion, gain, column, marks=marks)


KINDS: tuple[Motion, ...] = ("translation", "rotation", "translation in V")
"""Both motions, and a drive: those of other units differ in words alone."""

CELLS = [
    cell(name, motion, gain, column)
    for name, motion, gain, column in product(ROWS, KINDS, (0.4, 2.0), COLUMNS)
    if column != "identify" or (name in IDENTIFY_ONCE and (motion, gain) == ("rotation", 2.0))
]


@pytest.mark.parametrize(("name", "motion", "gain", "column"), CELLS)
def test_an_output_includes_a_parameter_or_says_so(
    name: str, motion: Motion, gain: float, column: str, tmp_path: Path
) -> None:
    for number, loop in enumerate(loops(name, motion, gain)):
        folder = tmp_path / str(number)
        folder.mkdir()
        COLUMNS[column](Cell(loop, folder))

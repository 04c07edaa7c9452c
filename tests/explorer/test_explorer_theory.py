"""The explorer's module agrees with the theory in Python, on loops with random parts; it runs in Node."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_loops import random_loop

from pipeline import Loop
from pipeline.base.errors import PipelineError
from pipeline.explorer.page import module

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="no Node: apt-get install nodejs")

RUN = """
import * as explorer from "./loop.mjs";
import fs from "node:fs";
const answers = JSON.parse(fs.readFileSync(0)).map(([name, ...given]) => {
  try { return explorer[name](...given); } catch (error) { return { error: error.message }; }
});
console.log(JSON.stringify(answers));
"""
COSTS = [
    f"{name}{kind}"
    for name in ("settle_2pct", "overshoot", "energy_step_w0", "energy_step_w1", "energy_step_w2")
    for kind in ("", "_discrete")
]
FALCON = {"mass": 0.58, "damping": 4.0, "sampling_period_s": 0.001, "delay_samples": 4}


@pytest.fixture(scope="module")
def ask(tmp_path_factory):
    folder: Path = tmp_path_factory.mktemp("module")
    (folder / "loop.mjs").write_text(module(), encoding="utf-8")
    (folder / "run.mjs").write_text(RUN, encoding="utf-8")

    def ask(calls: Sequence[Sequence[Any]]) -> list[Any]:
        command = [str(NODE), str(folder / "run.mjs")]
        done = subprocess.run(command, input=json.dumps(calls), capture_output=True, text=True, check=True)
        return list(json.loads(done.stdout))

    return ask


def in_python(entries: dict[str, Any]) -> Loop:
    return Loop(**{name: value for name, value in entries.items() if name != "loop"}, **entries["loop"])


@pytest.mark.slow
@pytest.mark.parametrize(("count", "seed"), [(20, 1), pytest.param(500, 2, marks=pytest.mark.slow)])
def test_random_loops(ask, count, seed):
    rng = np.random.default_rng(seed)
    entries = [random_loop(rng) for _ in range(count)]
    loops = [in_python(each) for each in entries]
    borders, outlines = ask([("boundary", each, 60) for each in entries]), ask([("passive", each) for each in entries])
    worst: dict[str, float] = {}

    def note(name: str, deviation: float) -> None:
        worst[name] = max(worst.get(name, 0.0), deviation)

    walls = {}
    for number, (loop, border, outline) in enumerate(zip(loops, borders, outlines, strict=True)):
        try:
            expected = loop.boundary(60).attrs
        except PipelineError:
            assert border["stiffness_max"] is None
            continue
        largest = expected["stiffness_max"]
        if not largest > 0:
            continue
        note("stiffness_max", abs(border["stiffness_max"] / largest - 1))
        B, K = (np.array([v for v in border[axis] if v is not None]) for axis in ("damping", "stiffness"))
        limit = loop.limits(B)["stiffness"].to_numpy()
        note("boundary", float((np.abs(K - limit) / (limit + 1e-9 * largest)).max()))
        # the page shows walls with K >= 0
        assert bool(border["islands"]) == any(island["stiffness_high"] > 0 for island in expected["islands"])
        if loop.normalised_loop.plant.sensor_at_load:
            assert outline["stiffness"] == []
        elif loop.passive_damping > 0:
            passive = loop.passive()
            note("passive_max", abs(outline["stiffness_max"] / passive.attrs["stiffness_max"] - 1))
            for axis in ("stiffness", "damping"):
                far = np.abs(np.array(outline[axis]) - passive[axis].to_numpy()).max()
                note("passive", float(far / np.abs(passive[axis]).max()))
        chance = np.random.default_rng(number)
        walls[number] = chance.uniform(0.02, 1.2, 6) * largest, chance.uniform(B.min(), 1.05 * B.max(), 6)
    answers = ask([("walls", entries[i], list(K), list(B)) for i, (K, B) in walls.items()])
    first = ask([("poles", entries[i], K[0], B[0]) for i, (K, B) in walls.items()])
    for (i, (K, B)), found, poles in zip(walls.items(), answers, first, strict=True):
        loop, rows = loops[i], loops[i].points(K, B, COSTS)
        expected = list(np.linalg.eigvals(loop.to_state_space(K[0], B[0]).A))
        for pole in sorted((complex(*pair) for pair in poles), key=abs, reverse=True):
            nearest = int(np.argmin(np.abs(np.array(expected) - pole)))
            apart = abs(expected.pop(nearest) - pole)
            # rounding splits several poles next to z = 0 by its root
            note("poles", apart if abs(pole) > 0.3 else 0.0)
        for k, (wall, (_, row)) in enumerate(zip(found, rows.iterrows(), strict=True)):
            note("spectral_radius", abs(wall["spectral_radius"] - row["spectral_radius"]))
            if wall["stable"] != row["stable"]:
                assert abs(K[k] / loop.limits(B[k])["stiffness"].iloc[0] - 1) < 1e-6
            for name in COSTS:
                value, truth = wall.get(name), row[name]
                if math.isnan(truth):
                    continue
                assert value is not None, (i, K[k], B[k], name, wall["spectral_radius"])
                least = 1e-12 if name.startswith("overshoot") else 0.0
                note(name, max(abs(value - truth) - least, 0.0) / max(truth, 1e-300))
    print({name: f"{value:.1e}" for name, value in worst.items()})
    assert worst.pop("poles") < 1e-9
    assert max(worst.values()) < 1e-6, worst


@pytest.mark.parametrize(("count", "seed"), [(15, 1), pytest.param(150, 2, marks=pytest.mark.slow)])
def test_very_slow_walls(ask, count, seed):
    """Next to the boundary, and far overdamped: responses of up to 1e8 samples."""
    rng = np.random.default_rng(seed)
    worst: dict[str, float] = {}
    calls, expected = [], []
    while len(calls) < count:
        entries = random_loop(rng)
        loop = in_python(entries)
        try:
            limits = loop.boundary(40)
        except PipelineError:
            continue
        B = rng.uniform(limits["damping"].min(), limits["damping"].max(), 6)
        limit = loop.limits(B)["stiffness"].fillna(1.0).to_numpy()
        near = 1 - 10 ** rng.uniform(-6.5, -3, 6)
        K = limit * np.where(np.arange(6) < 3, near, 10 ** rng.uniform(-6, -3, 6))
        calls.append(("walls", entries, list(K), list(B)))
        expected.append(loop.points(K, B, COSTS))
    slow = 0
    for found, (call, rows) in zip(ask(calls), zip(calls, expected, strict=True), strict=True):
        for wall, (_, row) in zip(found, rows.iterrows(), strict=True):
            if not row["stable"]:
                continue
            slow += wall["spectral_radius"] > 1 - 1e-5
            # rounding of a pole is a share of its distance from the circle
            rounding = 1e-6 + 5e-14 / (1 - wall["spectral_radius"])
            for name in COSTS:
                if math.isnan(row[name]):
                    continue
                assert wall[name] is not None, (call, wall, name)
                least = 1e-12 if name.startswith("overshoot") else 0.0
                far = max(abs(wall[name] - row[name]) - least, 0.0) / max(row[name], 1e-300)
                # the last of many samples that touch the band may be another by rounding
                allowed = rounding + 1e-5 * (name == "settle_2pct_discrete")
                worst[name] = max(worst.get(name, 0.0), far / allowed)
    print({name: f"{value:.1e}" for name, value in worst.items()}, slow)
    assert slow > count
    assert max(worst.values()) < 1, worst


def test_a_device_file_as_it_is_read(ask):
    """Keys at the device, in [loop] and in an experiment, whose own win; a jitter is its mean."""
    loop = {"actuator_lag_s": 0.001, "force_gain": 2.0}
    experiment = {"name": "1", "mass": 0.58, "damping": 4.0, "delay_samples": 3, "jitter_samples": [3, 4, 5]}
    file = {"name": "rig", "sampling_period_s": 0.001, "loop": loop, "experiment": [experiment]}
    own = {**file, "experiment": [{**experiment, "loop": {"force_gain": 1.0}}]}
    both = ask([("boundary", file), ("boundary", own)])
    for found, gain in zip(both, (2.0, 1.0), strict=True):
        expected = Loop(**FALCON, actuator_lag_s=0.001, force_gain=gain).boundary().attrs["stiffness_max"]
        assert found["stiffness_max"] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass": -1}, "mass: found -1; expected a finite number above 0"),
        ({"mass": None}, "mass: found null"),
        ({"delay_samples": 300}, "delay_samples: found 300; expected at most 256"),
        ({"velocity": {"kind": "butterworth", "order": 2, "cutoff_hz": 600}}, "velocity.cutoff_hz: found 600"),
        ({"mode": {"frequency_hz": 9, "damping_ratio": 0.1, "mass": 0.6}}, "mode.mass: found 0.6"),
        ({"velocity": {"kind": "median"}}, 'velocity.kind: found "median"'),
    ],
)
def test_a_wrong_entry_is_named(ask, change, words):
    (answer,) = ask([("boundary", {**FALCON, **change})])
    assert words in answer["error"]


def test_the_margins_of_a_wall(ask):
    loop = {**FALCON, "delay_samples": 4.5, "actuator_lag_s": 0.001}
    (found,) = ask([("margins", loop, 2000, 20)])
    expected = Loop(**loop).margins(2000, 20)
    for name in ("gain", "phase", "delay"):
        assert found[name] == pytest.approx(getattr(expected, name), rel=1e-8)
    assert found["bandwidth_hz"] == pytest.approx(expected.bandwidth / (2 * math.pi * 0.001), rel=1e-8)


def test_the_response_between_samples(ask):
    loop = {**FALCON, "delay_samples": 4.5, "mode": {"frequency_hz": 60, "damping_ratio": 0.02, "mass": 0.1}}
    (found,) = ask([("response", loop, 2000, 20, 40, 10)])
    expected = Loop(**loop).response(2000, 20, 40, per_sample=10)
    assert found["time"] == pytest.approx(expected["time_s"].to_numpy(), abs=1e-12)
    assert found["position"] == pytest.approx(2000 * expected["position"].to_numpy(), abs=1e-10)


def test_a_free_crossing(ask):
    """Without damping a window of 3 samples has a real velocity where 4 samples of delay have a real stiffness."""
    loop = {"mass": 0.19, "damping": 0.0, "sampling_period_s": 0.001, "velocity": {"kind": "difference", "samples": 3}}
    for delay in (1, 4):
        (found,) = ask([("boundary", {**loop, "delay_samples": delay})])
        expected = Loop(**loop, delay_samples=delay).boundary().attrs
        assert found["stiffness_max"] == pytest.approx(expected["stiffness_max"], rel=1e-9)


def test_a_window_whose_velocity_is_real_at_a_simple_angle(ask):
    """A window of 4 samples is real at z = exp(j pi/4) and 0 at z = j, where angles of a grid would lie."""
    loop = {
        "mass": 4.8, "damping": 1.2, "stiffness": 16.3, "sampling_period_s": 0.0035, "delay_samples": 3.2,
        "velocity": {"kind": "difference", "samples": 4},
        "mode": {"frequency_hz": 36.7, "damping_ratio": 0.0075, "mass": 1.64},
    }  # fmt: skip
    (found,) = ask([("boundary", loop, 100)])
    damping = np.array(found["damping"])
    assert found["islands"] == []
    assert np.array(found["stiffness"]) == pytest.approx(Loop(**loop).limits(damping)["stiffness"].to_numpy(), rel=1e-6)


def test_poles_at_which_plain_iterations_go_round_in_circles(ask):
    loop = {
        "mass": 0.4892301292388779, "damping": 28.320156005705407, "stiffness": 2813.201212499645,
        "sampling_period_s": 0.001151301223368544, "delay_samples": 6.0, "actuator_lag_s": 0.0015874641323876757,
        "force_gain": 0.6113818735216275,
        "velocity": {
            "kind": "coefficients", "b": [0.3077470607887882, 0.34856017326868943, 0.2576932651713624],
            "a": [1.0, -0.30589855239055985, 0.21989905161939996],
        },
        "operator": {"mass": 0.6394029453623218, "damping": 14.045320173845445, "stiffness": 201.78370413242644},
    }  # fmt: skip
    K, B = 1463.5712852079535, 329.14545150154464
    (found,) = ask([("poles", loop, K, B)])
    largest = max(abs(complex(*pole)) for pole in found)
    assert largest == pytest.approx(Loop(**loop).points(K, B)["spectral_radius"].iloc[0], rel=1e-9)


@pytest.mark.parametrize(
    "parts",
    [
        # soft walls are stable between two dampings alone, in a resonance narrower than angles lie apart
        {
            "mass": 13.9, "damping": 2.91, "stiffness": 5560.0, "sampling_period_s": 0.00446, "delay_samples": 8.17,
            "velocity": {"kind": "butterworth", "order": 1, "cutoff_hz": 3.13},
        },
        # a velocity of 0 at z = exp(j pi/3)
        {
            "mass": 0.07628056274166418, "sampling_period_s": 0.0003634204482694437,
            "delay_samples": 1.8313525676926323, "velocity": {"kind": "difference", "samples": 6},
            "mode": {"frequency_hz": 527.7487578036873, "damping_ratio": 0.19497230131805554,
            "mass": 0.03788901950954632, "sensor": "motor", "load_damping": 0.0},
            "operator": {"mass": 0.04238014963283846, "damping": 2.5970627548056884, "stiffness": 3.7514375171301575},
            "damping": 0.0,
        },
        # the limit ends where another branch is higher
        {
            "mass": 1.6803625173099, "damping": 20.342153451242908, "sampling_period_s": 0.000548212325374661,
            "delay_samples": 3.0,
            "velocity": {"kind": "kalman", "acceleration": 0.11174835889249472, "noise": 1e-06},
            "mode": {"frequency_hz": 105.63532330347773, "damping_ratio": 0.007559482503786295,
            "mass": 0.5218241942185898, "sensor": "motor"},
        },
    ],
)  # fmt: skip
def test_the_largest_limit_of_hard_loops(ask, parts):
    (found,) = ask([("boundary", parts, 60)])
    expected = Loop(**parts).boundary(60).attrs
    assert found["stiffness_max"] == pytest.approx(expected["stiffness_max"], rel=1e-7)
    assert found["damping_at_stiffness_max"] == pytest.approx(expected["damping_at_stiffness_max"], rel=1e-4)


@pytest.mark.parametrize("cutoff", [0.05, 0.2, 1.0, 8.0])
def test_passive_walls_behind_a_slow_filter(ask, cutoff):
    velocity = {"kind": "butterworth", "order": 2, "cutoff_hz": cutoff}
    entries = {
        "mass": 0.58,
        "damping": 4.0,
        "sampling_period_s": 0.001,
        "delay_samples": 4,
        "loop": {"velocity": velocity},
    }
    (found,), loop = ask([("passive", entries)]), in_python(entries)
    expected = loop.passive()
    assert found["stiffness_max"] == pytest.approx(expected.attrs["stiffness_max"], rel=1e-6)
    for axis in ("stiffness", "damping"):
        far = np.abs(np.array(found[axis]) - expected[axis].to_numpy()).max()
        assert far < 1e-6 * np.abs(expected[axis]).max()

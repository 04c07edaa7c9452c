"""A device file's loop in SI: `pipeline theory ... --device` as in docs/devices.md, and a course up to its report."""

import re
from html import unescape

import mpmath as mp
import numpy as np
import pytest
from general_devices import ManyDigits
from places import ROOT
from test_cli import document

from pipeline.device_data.devices import load_device, read_device
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.surface.physical_loop import Loop
from pipeline.theory.boundary import boundary

PAGE = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
FILE = re.sub("^ {4}", "", re.search(r"( {4}name = .*?)\n\nThen", PAGE, re.DOTALL)[1], flags=re.MULTILINE)


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.toml").write_text(FILE, encoding="utf-8")
    return tmp_path / "arm.toml"


@pytest.mark.slow
def test_boundary_of_the_page(call, arm):
    found = document(call("theory", "boundary", "--device", arm, "--json"))
    assert found["left_out"] == ["friction"]
    assert found["stiffness_max"] == max(found["stiffness"])
    assert found["damping_at_stiffness_max"] == found["damping"][np.argmax(found["stiffness"])]
    assert found["islands"] == []
    walls = arm.with_name("walls.csv")
    inner = list(range(40, 360, 40))
    rows = [(found["stiffness"][i] * (1 + e), found["damping"][i]) for i in inner for e in (-1e-9, 1e-9)]
    walls.write_text("stiffness,damping\n" + "\n".join(f"{k!r},{b!r}" for k, b in rows))
    points = document(call("theory", "points", walls, "--device", arm, "--json"))
    assert [point["stable"] for point in points] == [True, False] * len(inner)


def test_an_ideal_device_has_the_boundary_of_its_normalised_loop(call):
    found = document(call("theory", "boundary", "--device", "falcon", "--experiment", "1", "--json"))
    falcon = load_device("falcon")
    loop = falcon.loop_for(falcon.experiments[0])
    units, gamma, delta = LoopUnits(loop.mass, 1e-3), loop.stiffness * 1e-6 / loop.mass, loop.damping * 1e-3 / loop.mass
    border = boundary(NormalisedLoop.ideal(gamma, delta, loop.delay_samples))
    assert found["stiffness_max"] == pytest.approx(border.alpha_max * units.stiffness, rel=1e-10)
    assert found["left_out"] == ["jitter"]


def test_a_map_holds_the_optimum(call, arm):
    best = document(call("theory", "optimum", "--criterion", "energy_step_w0", "--device", arm, "--json"))
    known = read_device(arm)
    costs = Loop.of(known.loop_for(known.experiments[0])).map(size=12, criteria=["energy_step_w0"])["energy_step_w0"]
    assert best["cost"] <= costs.min() < 3 * best["cost"]


def test_text_names_what_is_left_out(call, arm):
    status, out, _ = call("theory", "boundary", "--device", arm)
    assert status == 0
    assert "not included in linear theory: friction" in out


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("cutoff_hz = 80.0", "cutoff_hz = 500.0", ("loop.velocity.cutoff_hz", "500")),
        ("actuator_lag_s = 0.001", "actuator_lag_s = -0.001", ("actuator_lag_s", "-0.001")),
        ("damping_ratio = 0.05", "damping_ratio = -0.05", ("damping_ratio", "-0.05")),
        ("operator = { mass = 0.15, ", "operator = { ", ("operator", "mass", "required")),
        (
            'kind = "butterworth", order = 2, cutoff_hz = 80.0',
            'kind = "coefficients", b = [1.0], a = [1.0, -1.1]',
            ("stable filter", "1.1"),
        ),
    ],
)
def test_wrong_parts_are_refused(call, arm, old, new, words):
    assert old in FILE
    arm.write_text(FILE.replace(old, new), encoding="utf-8")
    status, _, err = call("theory", "boundary", "--device", arm)
    assert status != 0
    assert [word for word in ("arm.toml", *words) if word not in err] == []


def test_a_loop_that_nothing_stabilises_is_said(call, arm):
    text = FILE.replace(
        'kind = "butterworth", order = 2, cutoff_hz = 80.0', 'kind = "coefficients", b = [1, -1], a = [1]'
    )
    text = re.sub("(mode|operator|friction) = .*\n", "", text).replace("damping = 3.0", "damping = 0.0")
    arm.write_text(text, encoding="utf-8")
    read_device(arm)
    status, out, err = call("theory", "boundary", "--device", arm, "--json")
    assert (status != 0, out) == (True, "")
    assert "no stiffness and damping stabilise" in err


def test_neither_delay_nor_device_is_refused(call):
    status, _, err = call("theory", "boundary")
    assert status != 0
    assert "--delay" in err
    assert "--device" in err


ARM = """
name = "arm"
title = "Arm"
source = "made up"
sampling_period_s = 0.001
step = 4.0
duration_s = 0.3
baseline_s = 0.02
[limits]
travel = 0.1
[sensor]
quantum = 1e-6
[loop]
velocity = { kind = "butterworth", order = 2, cutoff_hz = 80.0 }
actuator_lag_s = 0.001
mode = { frequency_hz = 60.0, damping_ratio = 0.05, mass = 0.10, sensor = "motor" }
friction = { coulomb = 0.004 }
[[experiment]]
name = "1"
mass = 0.5
damping = 25.0
delay_samples = 2.4
damping_last = 30.0
damping_step = 30.0
stiffness_step = 1000.0
"""
SCENE = 'device = "arm"\ncriteria = ["settle", "overshoot"]\nbands = [2]\nfigures = ["boundaries"]\n'
WORDS = "velocity filter (Butterworth, order 2, 80 Hz), actuator lag 1 ms, vibration mode at 60 Hz, sensed at the motor"


def largest(page, label):
    """Largest stiffness of a curve, as the text beside its drawing says."""
    return float(re.search(rf"{re.escape(label)}: up to ([\d.]+) N/m", page)[1])


@pytest.mark.slow
def test_a_report_rests_on_the_loop_of_its_device_file(call, tmp_path, monkeypatch):
    (tmp_path / "devices").mkdir()
    file = tmp_path / "devices" / "arm.toml"
    file.write_text(ARM, encoding="utf-8")
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    monkeypatch.setenv("PIPELINE_DEVICES", str(file.parent))
    logs = document(call("simulate", "arm", "--out", "raw", "--seed", 5, "--json"))["logs"]["1"]
    assert document(call("ingest", "raw", "--jobs", 1, "--json"))["ingested"] == logs
    found = document(call("compare", "--scene", "scene.toml", "--report", "arm.html", "--json"))
    page = unescape((tmp_path / "arm.html").read_text(encoding="utf-8")).replace("\xa0", " ")

    # the simulated limits lie about those of a loop of its own, in other states and many digits
    known = read_device(file)
    truth = ManyDigits(known.loop_for(known.experiments[0]))
    told = [p for p in found["experiments"][0]["boundary"] if p["stable"] is not None]
    assert len(told) == 2
    with mp.workdps(40):
        for point in told:
            verdicts = [truth.stable(point[name], point["damping"]) for name in ("stable", "unstable")]
            assert verdicts == [True, False], point
        # the drawn boundary is its limit, to the printed digits
        limit = document(call("theory", "boundary", "--device", "arm", "--json"))
        drawn, damping = largest(page, " theory"), limit["damping_at_stiffness_max"]
        assert drawn == pytest.approx(limit["stiffness_max"], abs=1)
        assert [truth.stable(limit["stiffness_max"] * share, damping) for share in (0.999, 1.001)] == [True, False]

    # optima of the tables are those of the loop
    rows = {(row["criterion"], row["condition"]): row for row in found["tables"]}
    for criterion in ("settle_2pct", "overshoot"):
        best = document(call("theory", "optimum", "--device", "arm", "--criterion", criterion, "--json"))
        row = rows[criterion, "theory_continuous"]
        assert (row["stiffness"], row["damping"]) == pytest.approx((best["stiffness"], best["damping"]), rel=1e-6)
        assert row["cost"] == pytest.approx(best["cost"], rel=1e-9, abs=1e-12)
    # the best trial settles as theory says of its wall
    trial, walls = rows["settle_2pct", "experiment"], tmp_path / "walls.csv"
    walls.write_text(f"stiffness,damping\n{trial['stiffness']!r},{trial['damping']!r}\n", encoding="utf-8")
    (wall,) = document(call("theory", "points", walls, "--device", "arm", "--json"))
    assert trial["cost"] == pytest.approx(wall["settle_2pct_discrete"], abs=2)
    assert trial["cost"] >= rows["settle_2pct", "theory_discrete"]["cost"]

    # the loop is that of the file, which the little friction does not move
    loop = found["experiments"][0]["loop"]
    assert loop["source"] == "device file"
    assert (loop["actuator_lag_s"]["value"], loop["mode"]["frequency_hz"]["value"]) == (0.001, 60.0)
    assert loop["adequate"]
    # the passive region knows lag and filter; sources name all parts, and what is left out
    assert 0 < largest(page, "passive region (4.12)") < drawn
    assert f"device file arm, with {WORDS}; without friction" in page

"""`pipeline theory ... --device`: a device file's loop in SI, as docs/devices.md shows it."""

import re

import numpy as np
import pytest
from places import ROOT
from test_cli import call, document  # noqa: F401

from pipeline.device_data.devices import load_device, read_device
from pipeline.loop.loop import Normalised
from pipeline.surface.physical_loop import loop_of_device
from pipeline.theory.boundary import boundary

PAGE = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
FILE = re.sub("^ {4}", "", re.search(r"( {4}name = .*?)\n\nThen", PAGE, re.DOTALL)[1], flags=re.MULTILINE)


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.toml").write_text(FILE, encoding="utf-8")
    return tmp_path / "arm.toml"


@pytest.mark.slow
def test_boundary_of_the_page(call, arm):  # noqa: F811
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


def test_an_ideal_device_has_the_boundary_of_its_normalised_loop(call):  # noqa: F811
    found = document(call("theory", "boundary", "--device", "falcon", "--experiment", "1", "--json"))
    entry, period = load_device("falcon").experiments[0], load_device("falcon").sampling_period_s
    units = Normalised(entry.mass, period)
    border = boundary(units.loop(entry.stiffness, entry.damping, entry.delay_samples))
    assert found["stiffness_max"] == pytest.approx(border.alpha_max * units.stiffness, rel=1e-10)
    assert found["left_out"] == []


def test_a_map_holds_the_optimum(call, arm):  # noqa: F811
    best = document(call("theory", "optimum", "--criterion", "energy_step_w0", "--device", arm, "--json"))
    known = read_device(arm)
    costs = loop_of_device(known, known.experiments[0]).map(size=12, criteria=["energy_step_w0"])["energy_step_w0"]
    assert best["cost"] <= costs.min() < 3 * best["cost"]


def test_text_names_what_is_left_out(call, arm):  # noqa: F811
    status, out, _ = call("theory", "boundary", "--device", arm)
    assert status == 0
    assert "left out of linear theory: friction" in out


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
def test_wrong_parts_are_refused(call, arm, old, new, words):  # noqa: F811
    assert old in FILE
    arm.write_text(FILE.replace(old, new), encoding="utf-8")
    status, _, err = call("theory", "boundary", "--device", arm)
    assert status != 0
    assert [word for word in ("arm.toml", *words) if word not in err] == []


def test_a_loop_that_nothing_stabilises_is_said(call, arm):  # noqa: F811
    text = FILE.replace(
        'kind = "butterworth", order = 2, cutoff_hz = 80.0', 'kind = "coefficients", b = [1, -1], a = [1]'
    )
    text = re.sub("(mode|operator|friction) = .*\n", "", text).replace("damping = 3.0", "damping = 0.0")
    arm.write_text(text, encoding="utf-8")
    read_device(arm)
    status, out, err = call("theory", "boundary", "--device", arm, "--json")
    assert (status != 0, out) == (True, "")
    assert "no stiffness and damping stabilise" in err


def test_neither_delay_nor_device_is_refused(call):  # noqa: F811
    status, _, err = call("theory", "boundary")
    assert status != 0
    assert "--delay" in err
    assert "--device" in err

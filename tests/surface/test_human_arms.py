"""Published values on the Python surface."""

import pytest
from places import SHARED

import pipeline


def test_human_arms_are_those_of_the_table():
    table = SHARED / "reference" / "tables" / "3_2_human_arm.csv"
    if not table.exists():
        pytest.skip("needs the reference tables beside the repository")
    rows = [line.split(",")[1:] for line in table.read_text(encoding="utf-8").splitlines()[1:]]
    found = pipeline.human_arms().to_dict("split")["data"]
    assert found == [[name, *map(float, numbers)] for name, *numbers in rows]


def test_limits_of_the_human_arm_hold_for_all_but_the_hand():
    arms = pipeline.human_arms()
    beyond = (arms["stiffness"] / arms["mass"] > 710) | (arms["damping"] / arms["mass"] > 14.6)
    assert arms.loc[beyond, "source"].tolist() == ["Kuchenbecker et al."]


def test_human_arms_are_operators():
    arm = pipeline.human_arms().drop(columns="source").iloc[0].to_dict()
    loop = pipeline.Loop(0.5, 1.0, 0.001, 1)
    held = pipeline.Loop(0.5, 1.0, 0.001, 1, operator=arm)
    assert held.boundary().attrs["stiffness_max"] > loop.boundary().attrs["stiffness_max"]

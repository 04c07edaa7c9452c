"""Quantities with units on the command line: the same answer as in SI, and a refusal that says what is expected."""

import json

import pytest


def design(call, *words):
    status, out, err = call("design", "--device", "falcon", "--stiffness", "5000", *words, "--json")
    return status, json.loads(out) if status == 0 else err


@pytest.mark.parametrize(
    ("plain", "written"),
    [
        (["--settling", "0.03"], ["--settling", "30 ms"]),
        (["--overshoot", "0.05"], ["--overshoot", "5%"]),
        (["--overshoot", "0.05"], ["--overshoot", "5 %"]),
    ],
)
def test_a_quantity_may_have_its_unit(call, plain, written):
    assert design(call, *plain) == design(call, *written)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--settling", "30 mm"], "--settling '30 mm': unit 'mm' measures length; expected time"),
        (["--settling", "soon"], "--settling 'soon': expected a number, with or without its unit, such as '5 s'"),
        (["--overshoot", "much"], "--overshoot much: expected a number or a percentage"),
    ],
)
def test_another_quantity_is_refused(call, words, message):
    status, err = design(call, *words)
    assert status == 2
    assert message in err


def test_dampings_share_the_unit_behind_the_last(call):
    plain = call("plan", "--device", "falcon", "--dampings", "0,20,40", "--limit", "stiffness=3000", "--json")
    written = call("plan", "--device", "falcon", "--dampings", "0,20,40 Ns/m", "--limit", "stiffness=3 N/mm", "--json")
    assert plain[0] == 0, plain
    assert plain[1] == written[1]
    status, _, err = call("plan", "--device", "falcon", "--dampings", "0,20 N")
    assert (status, "--dampings '0 N': unit 'N' measures force; expected damping" in err) == (2, True)


def test_a_time_to_settle_has_its_unit(call, tmp_path):
    (tmp_path / "raw").mkdir()
    for text, status in (("0 s", 0), ("500 ms", 0), ("0", 0), ("2 mm", 2)):
        assert call("watch", "raw", "--once", "--settle", text)[0] == status

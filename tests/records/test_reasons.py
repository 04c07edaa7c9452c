"""Codes of stored reasons and warnings: the code that writes the words and the codes of the records agree."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from columns import verdicts
from simulated import FALCON, simulate

from pipeline.measured.experiment.trend import drift_warning
from pipeline.planning.planner import REMEDIES
from pipeline.records.findings import (
    NOT_ADEQUATE,
    Estimate,
    Trend,
    UndecidedCode,
    undecided_code,
)

SOFT = FALCON | {"mass": 0.3, "b": 2.0, "delay": 3, "step": 5.0, "travel": 1.0}


@pytest.mark.parametrize(
    ("trials", "code"),
    [
        (lambda: simulate([3000.0], [50.0], **FALCON, rows=28), "no_motion"),
        (lambda: simulate([100.0], [0.0], **SOFT, rows=60, noise=5e-7, quantum=2e-6), "log_ends"),
        (lambda: simulate([0.0], [0.0], **{**FALCON, "b": 0.0}), "at_limit"),
    ],
    ids=["short", "first swing", "no damping"],
)
def test_an_undecided_verdict_has_the_code_of_its_reason(trials, code):
    found = verdicts(trials())
    assert found.verdict.tolist() == ["undecided"]
    assert undecided_code(found.reason[0]) == code


def test_each_code_of_an_undecided_verdict_has_a_remedy():
    assert set(REMEDIES) == set(get_args(UndecidedCode))
    assert undecided_code("a mode grows at 3 1/s while the motion decays") == "mode_grows"
    assert undecided_code("the edge of the command is unknown") == "other"


def estimate(warning=None, reason=None):
    value = 1.0 if reason is None else None
    return Estimate(value=value, unit="kg", method="test", warning=warning, reason=reason)


def test_doubts_have_codes():
    trend = Trend(over="damping", slope=1.0, low=0.9, high=1.1, unit="kg", significant=True)
    drift = drift_warning(trend, np.array([0.0, 10.0]), 1.0, 0.1, "kg")
    found = estimate("; ".join([drift, f"{NOT_ADEQUATE}, so its interval may be too narrow", "few logs"]))
    assert [doubt.code for doubt in found.doubts] == ["drift", "not_adequate", "other"]
    assert found.doubts[0].text == drift
    assert estimate().doubts == ()


@pytest.mark.parametrize(
    ("reason", "code"),
    [
        ("left out: no requested criterion needs it", "left_out"),
        ("not identifiable: a spring has the same effect. Record steps", "not_identifiable"),
        ("no usable trial", "other"),
        ("it predicts no logs that were left out", "other"),
    ],
)
def test_a_missing_value_has_a_code(reason, code):
    assert estimate(reason=reason).missing_code == code

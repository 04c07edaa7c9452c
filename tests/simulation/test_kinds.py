"""Every kind of device can be simulated, is drawn anew by its seed alone, and is what its truth says."""

from __future__ import annotations

import numpy as np
import pytest
from kinds import FEW, kinds, record

from pipeline.device_data.devices import load_device

KINDS = kinds(load_device("falcon"))
SHORT = {"coarsen": 23, "duration_s": 0.25}


@pytest.mark.parametrize("name", sorted(KINDS))
def test_every_kind_simulates_a_short_course(name: str) -> None:
    case = KINDS[name](3)
    course = record(case, **SHORT)
    assert len(course.trials) >= min(FEW, 2)
    assert np.isfinite(course.trials.position).all()
    assert np.isfinite(course.trials.command).all()
    kept = {"all": {"stable", "unstable"}, "stable": {"stable", "undecided"}, "unstable": {"unstable"}}
    if case.keep != "few":
        assert set(course.verdict) >= kept[case.keep] - {"undecided"}
    if case.keep in ("stable", "unstable"):
        assert set(course.verdict) <= kept[case.keep]


def test_the_stated_device_is_ideal_and_the_true_one_holds_what_was_drawn() -> None:
    case = KINDS["all parts"](1)
    true, stated = case.device, case.stated
    assert stated.loop_table(stated.experiments[0]) == type(stated.loop)()
    parts = true.loop_for(true.experiments[0])
    assert parts.mode is not None
    assert parts.friction is not None
    assert parts.mode.mass == case.truth["loop.mode.mass"]
    assert parts.friction.coulomb == case.truth["loop.friction.coulomb"]
    assert true.experiments[0].mass == stated.experiments[0].mass == case.truth["mass"]

"""How many trials of a finished course would have been enough."""

from __future__ import annotations

import numpy as np

from pipeline.plan.replay import saving_of
from pipeline.plan.verdicts import Tried

DAMPINGS = np.linspace(10, 180, 14)


def parabola(damping):
    return 500 + 12_000 * (1 - ((damping - 100) / 110) ** 2)


def course(fine=100.0, rates=True):
    """Every wall up to the first unstable one, as a lab raises K."""
    rows = []
    for damping in DAMPINGS:
        for wall in np.arange(fine, parabola(damping) + fine, fine):
            off = (wall - parabola(damping)) * 5e-3
            rows.append((wall, damping, "unstable" if off > 0 else "stable", off if rates else np.nan))
    return Tried(*(np.array(column) for column in zip(*rows, strict=True)))


def test_a_fraction_of_a_finished_course_is_enough():
    tried = course()
    saving = saving_of(tried, 1e-3, 0.4)
    assert saving.trials == len(tried) > 800
    assert saving.dampings == 12
    assert 24 <= saving.enough <= 60


def test_a_course_without_close_limits_is_not_finished():
    tried = course()
    assert saving_of(tried.select(tried.verdict == "stable"), 1e-3, 0.4) is None
    assert saving_of(course(fine=2000.0), 1e-3, 0.4) is None, "too coarse"
    assert saving_of(tried.select(tried.damping < 60), 1e-3, 0.4) is None, "too few dampings"


def test_nothing_is_saved_of_nothing():
    assert saving_of(Tried(*[np.empty(0)] * 4), 1e-3, 0.4) is None

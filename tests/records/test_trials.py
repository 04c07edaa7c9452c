"""Trials as views of flat arrays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.records.trials import Trial, Trials


def _trial(name: str, rows: int, **more: Any) -> Trial:
    x = np.arange(rows, dtype=np.float64) + len(name)
    return Trial(name, 100.0 * rows, 2.0, 1.5, 1e-3, 1e-3 * x, -x, x**2, **more)


@pytest.fixture
def trials() -> list[Trial]:
    return [
        _trial("a", 3),
        _trial("bb", 5, force=np.arange(5.0), step_row=2),
        _trial("c", 4, velocity=np.ones(4), integrated=True),
    ]


def test_trials_return_each_trial_as_it_was_given(trials: list[Trial]) -> None:
    joined = Trials.of(trials)
    assert len(joined) == 3
    for given, found in zip(trials, joined, strict=True):
        assert given.digest == found.digest
        assert (given.step_row, given.integrated) == (found.step_row, found.integrated)
        assert found.samples.keys() == given.samples.keys()
        for name, values in given.samples.items():
            np.testing.assert_array_equal(found.samples[name], values)


def test_trials_of_one_motion_have_it_and_others_have_none() -> None:
    turning = [_trial(name, 3, motion="rotation") for name in "ab"]
    assert Trials.of(turning)[1].motion == Trials.of(turning).select([0]).motion == "rotation"
    assert Trials.of([*turning, _trial("c", 3, motion="translation")]).motion is None
    assert Trials.of([_trial("a", 3)])[0].motion is None


def test_rows_are_views_and_not_copies(trials: list[Trial]) -> None:
    joined = Trials.of(trials)
    assert np.shares_memory(joined[1].position, joined.position)


def test_selected_trials_keep_their_order(trials: list[Trial]) -> None:
    joined = Trials.of(trials)
    assert joined.select([2, 0]).trial_id == ("c", "a")
    assert joined.select(np.array([False, True, False])).rows.tolist() == [5]


@pytest.mark.parametrize("name", ["stiffness", "damping", "step", "sampling_period_s", "trial_id"])
def test_digest_depends_on_each_condition(name: str) -> None:
    trial = _trial("a", 3)
    change: dict[str, Any] = {name: "z" if name == "trial_id" else getattr(trial, name) * 1.5}
    assert replace(trial, **change).digest != trial.digest


def test_windows_count_a_declared_step_from_their_first_row(trials: list[Trial]) -> None:
    window = trials[1].window(1, 3)
    assert (window.rows, window.step_row) == (3, 1)
    assert window.force is not None
    assert window.force.tolist() == [1.0, 2.0, 3.0]


def test_levels_are_taken_from_command_and_force(trials: list[Trial]) -> None:
    moved = trials[1].relative_to(0.5)
    np.testing.assert_array_equal(moved.command, trials[1].command - 0.5)
    assert moved.force is not None
    assert moved.force[0] == -0.5


def test_no_trials_have_no_rows() -> None:
    nothing = Trials.of([])
    assert (len(nothing), len(nothing.position), nothing.force) == (0, 0, None)

"""Walls that throw the device off before the step: what is cut before the edge of a command says nothing of it."""

from __future__ import annotations

import math

import pytest
from any_experiment import Rig, Trial, write_log

import pipeline
from pipeline.base.errors import PipelineError

RIG = Rig(0.1, 0.05, 0.0, 0.001, 0.2, 0, 0.0, 1e-4, math.inf)
LARGEST = 2 * RIG.mass / RIG.period**2 / (1 + RIG.delay) ** 2


def mass_of(folder):
    """Value, low and high of the mass; None where the logs say why there is none."""
    try:
        rows = pipeline.identify([folder]).estimates
    except PipelineError as error:
        return str(error)
    row = rows[rows["name"] == "mass"].iloc[0]
    return None if math.isnan(row["value"]) else (row["low"], row["high"])


@pytest.mark.parametrize("share", [0.3, 0.4, 0.6, 1.2])
@pytest.mark.parametrize("rows", [40, 100, 300])
@pytest.mark.parametrize("copies", [1, 2])
def test_noise_that_grows_before_the_step_ends_in_an_answer(tmp_path, share, rows, copies):
    missed = 0
    for seed in range(3):
        folder = tmp_path / str(seed)
        folder.mkdir()
        for copy in range(copies):
            write_log(folder / f"{copy}.csv", RIG, Trial(share * LARGEST, 16.7, 1.0, rows), seed=seed)
        found = mass_of(folder)
        if isinstance(found, str):
            assert "record" in found or "repair" in found, "an error without a remedy"
        elif found is not None:
            missed += not found[0] <= RIG.mass <= found[1]
    assert missed <= 1


def test_a_step_on_the_row_of_the_turn_is_no_crash(tmp_path):
    # noise and growth of seed 0: the row that looks like the edge is the last one before the device turns
    for number in range(2):
        trial = Trial(55555.55555555556, 16.66666666666667, 1.0, 100)
        write_log(tmp_path / f"{number:03}.csv", RIG, trial, seed=number)
    assert not isinstance(mass_of(tmp_path), str)

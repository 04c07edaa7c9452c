"""Faults of random size in simulated logs: what share of each is found, and how often a good log has a finding.

The limits of the checks were set by logs of the seeds 10000 to 15000; these tests use others.
"""

from __future__ import annotations

import numpy as np
import pytest
from recorded_faults import BOTH, FAULTS, found_in_filtered, found_in_ramps, found_of, found_without

from pipeline.recording.check import check_recording, check_recordings
from pipeline.recording.motion import free_response


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found(name):
    assert found_of(name, 10, seed=1000) >= 0.8


def test_good_logs_have_no_findings():
    assert found_without(60, seed=7).total() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_in_95_percent_of_sixty_logs(name):
    assert found_of(name, 60, seed=30000) >= 0.95


@pytest.mark.slow
def test_at_most_one_percent_of_six_hundred_good_logs_has_a_finding():
    assert found_without(600, seed=30000).total() <= 6


@pytest.mark.slow
def test_a_filter_of_one_direction_is_no_motion_before_its_command():
    assert found_in_filtered(300, seed=30000).total() <= 3


@pytest.mark.slow
def test_ramps_that_were_sent_are_at_most_in_doubt():
    assert found_in_ramps(300, seed=30000)["unsafe"] <= 0.06 * 300


@pytest.mark.parametrize("seed", [10165, 10178, 10191])
def test_signs_are_judged_by_the_rows_before_a_stop(seed):
    """A device that rests at a stop seems to move against the command that brakes it elsewhere."""
    rng = np.random.default_rng([seed, len("travel stop")])
    stopped = FAULTS["travel stop"][1](rng, BOTH[0](rng))
    response = free_response(stopped)
    assert response.residual_against < response.residual_with
    assert [finding.code for finding in check_recording(stopped)] == ["travel_stop"]


def test_many_recordings_have_the_findings_that_each_has_alone():
    """The screen of many logs lets no fault of any kind through; both find something in half of these logs."""
    logs = []
    for number, (_, fault, kinds) in enumerate(3 * list(FAULTS.values())):
        rng = np.random.default_rng([4000, number])
        log = (BOTH if len(kinds) > 1 else kinds)[-1](rng)
        logs += [log.samples, *([made] if (made := fault(rng, log)) is not None else [])]
    alone = [check_recording(samples) for samples in logs]
    assert check_recordings(logs) == alone
    assert 0.3 < np.mean([found != () for found in alone]) < 0.7

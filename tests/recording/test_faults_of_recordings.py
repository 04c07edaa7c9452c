"""Faults of random size in simulated logs: what share of each is found, and how often a good log has a finding."""

from __future__ import annotations

import pytest
from recorded_faults import FAULTS, found_of, found_without

SHARE = dict.fromkeys(FAULTS, 0.9) | {
    "joined positions": 0.85,
    "joined commands": 0.6,
    "zero-phase filter": 0.7,
    "travel stop": 0.8,
    "other sign": 0.85,
}
"""Least share of the logs with a fault in which it is found; noise, friction and the sensor hide some."""


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found(name):
    assert found_of(name, 10, seed=1000) >= SHARE[name] - 0.2


def test_good_logs_have_no_findings():
    assert found_without(60, seed=7).total() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_in_most_of_sixty_logs(name):
    assert found_of(name, 60, seed=2000) >= SHARE[name]


@pytest.mark.slow
def test_at_most_one_percent_of_six_hundred_good_logs_has_a_finding():
    assert found_without(600, seed=8).total() <= 6

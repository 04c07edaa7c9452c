"""Costs of logs of which rows are missing or repeated, against those of the same logs undamaged."""

from __future__ import annotations

import numpy as np
import pytest
from logged import repeated, with_rows
from not_ideal import simulate

from pipeline.measured.cost.costs import CostInputs, ReadingInputs
from pipeline.measured.cost.energy import WEIGHTS
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.measured.stages.measured_trial import MeasuredTrial
from pipeline.measured.stages.stages import STAGES
from pipeline.measured.wall_command.sample_grid import sample_grid
from pipeline.measured.wall_command.wall_law import wall_law
from pipeline.records.criteria import SETTLING_BANDS
from pipeline.records.trials import Trials

STIFFNESS = np.linspace(800.0, 6000.0, 12)
DAMPING = np.linspace(25.0, 75.0, 12)
INPUTS = CostInputs(ReadingInputs(delay=4, sensor=1e-6, gain=1.0, spring=0.0), (4, 4), mass=0.58)
ENERGIES = [f"energy_w{w}" for w in WEIGHTS]


def whole(seed):
    return simulate(STIFFNESS, DAMPING, rows=600, noise=5e-7, quantum=2e-6, seed=seed)


def grid(trial):
    response = find_response(trial)
    return sample_grid(trial, response, wall_law(trial, response))


def costs(trials):
    """Costs by name of each trial, and why they are missing."""
    rows = []
    for trial in trials:
        of = MeasuredTrial(trial, judge(trial, find_response(trial)))
        settling, energies = (vars(STAGES[name].measure(of, INPUTS)) for name in ("settling", "energy"))
        rows.append(settling | energies)
    names = [f"{name}{end}" for name in (*SETTLING_BANDS, *ENERGIES) for end in ("", "_low", "_high")]
    return {name: np.array([row[name] for row in rows], dtype=float) for name in names}, [row["reason"] for row in rows]


def without(trials, share, seed, *, stamps=True, edge=20):
    """The same logs without some of their rows; the edge, where the response begins, and the end are kept."""
    random, damaged = np.random.default_rng(seed), []
    for trial in trials:
        keep = random.random(trial.rows) >= share
        keep[[0, edge - 1, edge, -1]] = True
        damaged.append(with_rows(trial, keep, shown=stamps))
    return Trials.of(damaged)


def repeating(trials, share, seed):
    """The same logs, some rows of which repeat the one before."""
    return repeated(trials, share, seed, first=26)


def outside(damaged, truth):
    """Share of the costs of whole logs that lie outside the intervals of the damaged ones, by kind."""
    result = {}
    for kind, names, slack in (("settling", list(SETTLING_BANDS), 0.0), ("energy", ENERGIES, 1e-3)):
        pairs = [
            (truth[n], damaged[f"{n}_low"], np.where(np.isnan(damaged[f"{n}_high"]), np.inf, damaged[f"{n}_high"]))
            for n in names
        ]
        t, low, high = (np.concatenate(part) for part in zip(*pairs, strict=True))
        told = np.isfinite(t) & np.isfinite(low)
        result[kind] = ((t < low - slack * t) | (t > high + slack * t))[told].mean(), told.mean()
    return result


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("damage", [without, repeating])
def test_costs_of_damaged_logs_hold_those_of_whole_ones(damage, seed):
    trials = whole(seed)
    truth, _ = costs(trials)
    found, _ = costs(damage(trials, 0.02, seed))
    shares = outside(found, truth)
    for wrong, told in shares.values():
        assert wrong <= 0.03
        assert told > 0.6


def test_rows_that_the_stamps_do_not_show_leave_no_cost():
    found, reason = costs(without(whole(4), 0.02, 4, stamps=False))
    assert np.isnan(found["settle_2pct"]).all()
    assert np.isnan(found["energy_w1"]).all()
    assert all("not visible in the stamps" in text for text in reason)


def test_whole_logs_are_not_touched():
    for trial in whole(5):
        on_grid = grid(trial)
        assert on_grid.trial is trial
        assert on_grid.straight is None


def test_a_long_gap_leaves_no_cost():
    rows = np.delete(np.arange(600), np.arange(60, 75))
    found, reason = costs([with_rows(trial, rows) for trial in whole(6)])
    assert np.isnan(found["settle_2pct"]).all()
    assert all("15 of 600 rows are missing, up to 15 in succession" in text for text in reason)


@pytest.mark.parametrize(
    ("lost", "told"),
    [
        (range(100, 108), True),
        (range(100, 109), False),
        (range(30, 590, 11), True),  # 51 of 600
        (range(30, 590, 9), False),  # 63
    ],
)
def test_a_motion_is_interpolated_over_eight_rows_and_a_tenth_of_a_log(lost, told):
    rows = np.delete(np.arange(600), list(lost))
    on_grid = grid(with_rows(whole(3)[0], rows))
    if told:
        assert on_grid.trial.rows == on_grid.straight.rows == 600
        assert on_grid.response.edge_reason == ""
    else:
        text = f"{600 - len(rows)} of 600 rows are missing"
        assert on_grid.response.edge_reason.startswith(text)
        assert "too many to interpolate" in on_grid.response.edge_reason

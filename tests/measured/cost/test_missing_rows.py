"""Costs of logs of which rows are missing or repeated, against those of the same logs undamaged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from not_ideal import simulate

from pipeline.measured.cost.energy import WEIGHTS
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.measured.stages.stage_groups import TrialGroup
from pipeline.measured.stages.stages import STAGES
from pipeline.records.criteria import SETTLING_BANDS

STIFFNESS = np.linspace(800.0, 6000.0, 12)
DAMPING = np.linspace(25.0, 75.0, 12)
GIVEN = {"delay": 4, "delay_range": (4, 4), "sensor": 1e-6, "gain": 1.0, "spring": 0.0, "mass": 0.58, "mass_error": 0.0}
ENERGIES = [f"energy_w{w}" for w in WEIGHTS]


def whole(seed):
    return simulate(STIFFNESS, DAMPING, rows=600, noise=5e-7, quantum=2e-6, seed=seed)


def group(batch):
    return TrialGroup(batch, judge(batch, find_response(batch)))


def costs(batch):
    of = group(batch)
    (made,), (energies,) = (STAGES[name].rows(of, GIVEN) for name in ("settling", "energy"))
    made |= energies
    names = [*SETTLING_BANDS, *ENERGIES]
    return {
        key: np.array(made[key].to_pylist() if hasattr(made[key], "to_pylist") else made[key], dtype=float)
        for name in names
        for key in (name, f"{name}_low", f"{name}_high")
    }, made["reason"]


def without(batch, share, seed, *, stamps=True, edge=20):
    """The same logs without some of their rows; the edge, where the response begins, and the end are kept."""
    random = np.random.default_rng(seed)
    parts = []
    for i in range(len(batch)):
        keep = random.random(int(batch.rows[i])) >= share
        keep[[0, edge - 1, edge, -1]] = True
        one = batch.select(np.array([i]))
        count = int(keep.sum())
        time = one.time[:, keep] if stamps else np.arange(count)[None, :] * one.sampling_period_s[0]
        parts.append(
            replace(
                one, rows=np.array([count]), time=time, command=one.command[:, keep], position=one.position[:, keep]
            )
        )
    return type(batch).joined(parts)


def repeating(batch, share, seed):
    """The same logs, some rows of which repeat the one before."""
    random = np.random.default_rng(seed)
    command, position = batch.command.copy(), batch.position.copy()
    for i in range(len(batch)):
        rows = np.flatnonzero(random.random(int(batch.rows[i])) < share)
        rows = rows[rows > 25]
        command[i, rows], position[i, rows] = command[i, rows - 1], position[i, rows - 1]
    return replace(batch, command=command, position=position)


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
    batch = whole(seed)
    truth, _ = costs(batch)
    found, _ = costs(damage(batch, 0.02, seed))
    shares = outside(found, truth)
    for wrong, told in shares.values():
        assert wrong <= 0.03
        assert told > 0.6


def test_rows_that_the_stamps_do_not_show_leave_no_cost():
    batch = whole(4)
    found, reason = costs(without(batch, 0.02, 4, stamps=False))
    assert np.isnan(found["settle_2pct"]).all()
    assert np.isnan(found["energy_w1"]).all()
    assert all("where the stamps do not show it" in text for text in reason)


def test_whole_logs_are_not_touched():
    of = group(whole(5))
    assert of.on_grid is of
    assert of.on_straight_grid is None


def test_a_long_gap_leaves_no_cost():
    batch = whole(6)
    keep = np.ones(600, dtype=bool)
    keep[60:75] = False
    n = len(batch)
    batch = replace(
        batch, rows=np.full(n, 585), **{name: getattr(batch, name)[:, keep] for name in ("time", "command", "position")}
    )
    found, reason = costs(batch)
    assert np.isnan(found["settle_2pct"]).all()
    assert all("15 of 600 rows are missing, 15 of them in a row" in text for text in reason)


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
    batch = whole(3).select(slice(0, 1))
    keep = np.delete(np.arange(600), list(lost))
    columns = {name: getattr(batch, name)[:, keep] for name in ("time", "command", "position")}
    grid = group(replace(batch, rows=np.array([len(keep)]), **columns)).grid
    assert grid.filled.tolist() == [600 - len(keep)]
    assert (grid.response.edge_reason == ("",)) == told
    assert told or "too many to interpolate" in grid.response.edge_reason[0]

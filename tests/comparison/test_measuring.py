"""Choices of the thesis in what is measured: final position of costs, delay and window of the momentum balance."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from labs import compare

from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.models import Measuring, Shown
from pipeline.rendering.frames import frames
from pipeline.rendering.report.report import OF_COSTS, printed_tables


@pytest.fixture(scope="module")
def processed(sticky, tmp_path_factory):
    folder = tmp_path_factory.mktemp("measuring") / "processed"
    return shutil.copytree(sticky.processed, folder)


@pytest.fixture(scope="module")
def outcome(processed, sticky, one_process):
    measuring = Measuring(final="measured", momentum_delay=5, momentum_window_s=0.012)
    return compare(
        sticky.device,
        processed,
        criteria=["settle_2pct", "overshoot", "energy_step_w0"],
        report=processed.parent / "report.html",
        shown=Shown(measuring=measuring, figures=()),
    )


def stages(processed, **chosen):
    return ExperimentStages.stored(processed, "falcon-real", "1", 0.0, Measuring(**chosen))


def test_settling_times_count_about_the_mean_of_the_last_tenth(processed, outcome):
    found = stages(processed, final="measured", momentum_delay=5, momentum_window_s=0.012)
    assert found.is_stored("settling")
    cost, _ = found.cost("settle_2pct")
    edge = found.column("response", "edge_row")
    delay = int(outcome.result.experiments[0].estimates["delay_samples"].value)
    known = np.flatnonzero(np.isfinite(cost))
    assert len(known) > 10
    for i in known:
        x = found.samples[i].position
        final = x[-(len(x) // 10) :].mean()
        outside = np.flatnonzero(np.abs(x[int(edge[i]) + delay :] - final) > 0.02 * abs(final - x[0]))
        assert cost[i] == (outside[-1] + 1 if len(outside) else 0)
    expected = stages(processed)
    assert not expected.is_stored("settling")
    assert expected.is_stored("response")
    # friction keeps it off x_0 + F_0/K, so that fewer trials settle there
    assert np.isfinite(expected.cost("settle_2pct")[0]).sum() < len(known)


def test_tables_and_files_state_the_final_position(outcome):
    tables = printed_tables(outcome.result)
    captions = {name: [table.caption for table in tables[name]] for name in tables if tables[name]}
    assert captions["measured_optima"]
    for name, of in captions.items():
        assert all(("costs about the measured final position" in text) == (name in OF_COSTS) for text in of)
    for name in ("tables", "optima", "use"):
        assert set(frames(outcome.result)[name]["final_position"]) <= {"measured"}
    assert "--final measured --momentum-delay 5 --momentum-window '0.012 s'" in outcome.result.provenance["command"]


def test_the_momentum_balance_takes_the_delay_and_window_that_were_asked_for(processed, outcome):
    found = stages(processed, final="measured", momentum_delay=5, momentum_window_s=0.012)
    edge, mass = found.column("response", "edge_row"), found.column("mass", "mass_momentum")
    for i in np.flatnonzero(np.isfinite(mass))[:20]:
        trial, begin = found.samples[i], int(edge[i])
        end = begin + 12  # thesis (6.4): trapezoids of the command, 5 samples late, over the speed at the end
        command = np.r_[np.zeros(5), trial.command[begin : end - 5]]
        speed = (trial.position[end] - trial.position[end - 1]) / 1e-3
        assert mass[i] == pytest.approx((command.sum() - 0.5 * command[-1]) * 1e-3 / speed, rel=1e-9)
    later = outcome.result.experiments[0].estimates["mass"].by_method["thesis_momentum_balance_later"]
    first = outcome.result.experiments[0].estimates["mass"].by_method["thesis_momentum_balance"]
    assert later.spread > 2 * first.spread

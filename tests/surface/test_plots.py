"""Plots on given axes, verdicts beside trials, and readable prints of the records."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

import pipeline
from pipeline.base.errors import UsageError


@pytest.fixture
def ax():
    figure, axes = plt.subplots()
    yield axes
    plt.close(figure)


def test_a_loop_draws_its_boundary_and_a_response(ax):
    loop = pipeline.Loop(mass=0.58, damping=4.0, sampling_period_s=1e-3, delay_samples=4)
    assert loop.plot_boundary(ax) is ax
    stiffness, damping = ax.lines[0].get_data()
    at = int(np.nanargmax(stiffness))
    assert stiffness[at] == pytest.approx(loop.boundary().attrs["stiffness_max"], rel=1e-3)
    assert ax.get_xlabel() == "stiffness K [N/m]"
    loop.plot_response(ax, 3000.0, 60.0, step=8.0)
    time, position = ax.lines[1].get_data()
    assert position[-1] == pytest.approx(8.0 / 3000.0, rel=1e-3)
    assert time[-1] == pytest.approx(0.2)
    assert damping[at] > 0


def test_a_comparison_draws_its_limits_and_prints_its_answers(ax, falcon_outcome):
    found = pipeline.Comparison(falcon_outcome.result)
    found.plot_boundary(ax, "1")
    drawn = ax.containers[0].lines[0].get_xdata()
    assert drawn.tolist() == found.boundary["stiffness"].dropna().tolist()
    text = str(found)
    assert text.startswith(found.result.title)
    assert "mass" in text
    assert repr(found).startswith("<Comparison of")
    with pytest.raises(UsageError, match="expected one of 1"):
        found.plot_boundary(ax, "9")


def test_trials_have_verdict_and_outcome(falcon, falcon_outcome):
    assert falcon_outcome.result is not None
    frame = pipeline.trials(falcon.processed, "falcon")
    counts = frame["verdict"].value_counts().to_dict()
    assert counts == {k: v for k, v in falcon_outcome.result.experiments[0].verdicts.items() if v}
    assert set(frame["outcome"].dropna()) >= {"settled"}

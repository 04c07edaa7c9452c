from __future__ import annotations

import re
import statistics
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from report_data import HOSTILE, boundary

from pipeline.comparison.compare_experiment import nominal_theories
from pipeline.comparison.figures.figure_residuals import cell_medians, residual_figures, residuals
from pipeline.comparison.scene.scene import open_scene
from pipeline.records.figure_records import Figure, ResidualMap
from pipeline.rendering.figures import residual_panels
from pipeline.theory.predictions import Predictions


def test_residuals_count_doublings_and_percentage_points() -> None:
    assert residuals(np.array([2.0, 1, 3]), np.array([1.0, 4, 3]), "settle_2pct").tolist() == [1, -2, 0]
    assert np.isnan(residuals(np.array([0.0, 1]), np.array([1.0, 0]), "energy_step_w0")).all()
    assert residuals(np.array([0.3, 0]), np.array([0.1, 0]), "overshoot") == pytest.approx([0.2, 0])


def test_cells_hold_the_median_of_their_points() -> None:
    rng = np.random.default_rng(5)
    k, b, value = rng.uniform(0, 900, 300), rng.uniform(-8, 40, 300), rng.normal(size=300)
    use = rng.random(300) < 0.8
    cells = defaultdict(list)
    for i in np.flatnonzero(use):
        cells[k[i] // 100, b[i] // 6].append(value[i])
    truth = {(100 * (x + 0.5), 6 * (y + 0.5)): statistics.median(v) for (x, y), v in cells.items()}
    at_k, at_b, middle = (column.tolist() for column in cell_medians(k, b, value, use, (100.0, 6.0)))
    found = dict(zip(zip(at_k, at_b, strict=True), middle, strict=True))
    assert found == pytest.approx(truth)
    assert len(cell_medians(k, b, value, np.zeros(300, dtype=bool), (1.0, 1.0))[0]) == 0


def test_simulated_trials_depart_from_their_own_theory_by_little(falcon) -> None:
    data = open_scene("falcon", falcon.processed, None, ["overshoot", "energy_step_w1", "settle_2pct"])
    theories = nominal_theories(data)
    predictions = Predictions(falcon.processed / "theory")
    figures = {f.criterion: f for f in residual_figures(data, theories, predictions)}
    assert set(figures) == {"overshoot", "energy_step_w1", "settle_2pct"}
    stable = {e.experiment: int((e.verdicts.verdict == "stable").sum()) for e in data.experiments}
    for criterion, figure in figures.items():
        assert [m.label for m in figure.panels] == [f"experiment {e.experiment}" for e in data.experiments]
        for shown, stages in zip(figure.panels, data.experiments, strict=True):
            assert 0 < shown.trials <= stable[stages.experiment]
            # true parameters and an ideal sensor: what is left is the log's end and the integer of a settling time
            assert abs(shown.median) < (0.005 if criterion == "overshoot" else 0.05)
    other = {
        name: type(t)(t.parameters.model_copy(update={"mass": 1.5 * t.parameters.mass})) for name, t in theories.items()
    }
    wrong = {f.criterion: f for f in residual_figures(data, other, predictions)}
    # half as much mass again must be seen: twice what the true one may leave
    assert abs(wrong["energy_step_w1"].panels[0].median) > 0.1
    assert residual_figures(data, {}, predictions) == ()


def figure(criterion: str = "settle_2pct", label: str = "experiment 1") -> Figure[ResidualMap]:
    """Cells of all signs: three larger by a quarter or more, two smaller, one equal."""
    residual = np.log2([1.3, 1.3, 2.0, 1.0, 1 / 1.3, 1 / 1.07])
    k, b = 1000.0 * np.arange(1, 7), np.full(6, 80.0)
    one = ResidualMap(label, k, b, residual, boundary("t", "theory"), 60, 0.1)
    two = (one, replace(one, label="other", median=np.nan))
    return Figure("residuals", "residual", "Residuals", "c", two, criterion)


def test_marks_tell_sign_by_filling_and_size() -> None:
    svg, other = residual_panels.residuals(figure())
    ElementTree.fromstring(svg)

    def marks(colour: str) -> list[tuple[int, int]]:
        """Width and number of marks of a colour inside the axes; the key below has its own paths."""
        found = re.findall(rf'<path clip-path[^>]*stroke="{colour}[^>]*>', svg)
        return [(int(re.findall(r'stroke-width="(\d+)"', m)[0]), m.count("h0")) for m in found]

    assert marks(r"var\(--fig-vermillion") == [(85, 2), (110, 1)]
    assert marks(r"var\(--fig-blue") == [(85, 1), (40, 1)]
    assert marks(r"var\(--paper") == [(59, 1), (14, 1)], "open marks have a hole"
    assert "larger in 3 cells, smaller in 2, about equal in 1" in svg
    assert "median +7.2 %" in svg
    assert "median not known" in other
    assert residual_panels.residuals(figure()) == (svg, other)


def test_departures_are_said_in_the_unit_of_the_criterion() -> None:
    assert residual_panels.departure(1.0, "settle_2pct") == "+100.0 %"
    assert residual_panels.departure(-1.0, "settle_2pct") == "−50.0 %"
    assert residual_panels.departure(0.021, "overshoot") == "+2.1 points"
    assert residual_panels.departure(0.0, "overshoot") == "0.0 points"


def test_size_is_bounded_and_hostile_labels_are_text() -> None:
    rng = np.random.default_rng(1)
    k, b = (g.ravel() for g in np.meshgrid(450.0 * (np.arange(20) + 0.5), 10.7 * (np.arange(14) + 0.5)))
    full = ResidualMap(HOSTILE, k, b, rng.normal(0, 0.4, k.size), boundary("t", "theory"), 9, 0.0)
    (svg,) = residual_panels.residuals(replace(figure(), panels=(full,)))
    root = ElementTree.fromstring(svg)
    assert not list(root.iter("script"))
    assert any(HOSTILE in "".join(e.itertext()) for e in root.iter("text"))
    assert len(svg) < 13_000  # every cell full; 35 of them, mostly half empty, share 0.25 MB

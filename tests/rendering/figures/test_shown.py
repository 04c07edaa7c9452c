"""What a panel tells on pointing and in CSV is what it was drawn from."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace

import numpy as np
from report_data import boundary, cost_figure

from pipeline.records.figure_records import Figure
from pipeline.rendering.figures import figures
from pipeline.rendering.figures.shown import HEAD, figure_csv

K, B = np.array([900.0, 2000, 3000, 2500]), np.array([0.0, 40, 80, 120])


def limits_figure() -> Figure:
    measured = replace(
        boundary("experiment 1", "measured"),
        stiffness=K,
        damping=B,
        censored=np.array([0.0, 0, 1, 0]),
        low=np.array([800.0, 0, np.nan, 2400]),
        high=np.array([1000.0, 2100, np.nan, 2600]),
    )
    return Figure("boundaries", "f", "Limits", "c", (("Falcon A", (measured,)),))


def test_series_are_the_curves_with_open_limits_and_intervals_apart() -> None:
    (panel,) = figures.boundaries(limits_figure())
    (axes,) = panel.shown["axes"]
    assert panel.shown["name"] == "Falcon A"
    assert axes["names"] == ["stiffness K [N/m]", "damping B [Ns/m]", ""]
    assert {label: (x, y) for label, x, y in axes["series"]} == {
        "experiment 1": ([900, 2000, 2500], [0, 40, 120]),
        "experiment 1: at least": ([3000], [80]),
        "experiment 1: 95 % from": ([800, 0, 2400], [0, 40, 120]),
        "experiment 1: 95 % to": ([1000, 2100, 2600], [0, 40, 120]),
    }


def test_a_place_on_the_drawing_is_the_value_that_its_axes_say() -> None:
    """The open square of the limit at B = 80 stands where box and ends of the axes put it."""
    (panel,) = figures.boundaries(limits_figure())
    (axes,) = panel.shown["axes"]
    left, top, right, bottom = axes["box"]
    x = left + (3000 - axes["x"][0]) / (axes["x"][1] - axes["x"][0]) * (right - left)
    y = bottom - (80 - axes["y"][0]) / (axes["y"][1] - axes["y"][0]) * (bottom - top)
    marks = re.findall(r'<path[^>]*fill="var\(--paper,#fff\)"[^>]*d="M(-?\d+) (-?\d+)', panel)
    assert any(np.hypot(float(a) - x, float(b) - y) < 40 for a, b in marks), (marks, x, y)


def test_maps_tell_curves_and_fronts_and_do_not_keep_those_of_the_panel_before() -> None:
    drawn = figures.cost_maps(cost_figure("settle_2pct"))
    for panel in drawn:
        plane, front = panel.shown["axes"]
        assert {label for label, *_ in front["series"]} == {"least cost", "optimum"}
        assert plane["names"][0] == front["names"][0] == "stiffness K [N/m]"
        assert [label for label, *_ in plane["series"]].count("optimum") == 1
    first, second = (panel.shown["axes"][1]["series"][-1] for panel in drawn[:2])
    assert first != second


def test_csv_holds_every_point_with_panel_and_axes() -> None:
    (panel,) = figures.boundaries(limits_figure())
    rows = list(csv.DictReader(io.StringIO(figure_csv([panel.shown]))))
    assert tuple(rows[0]) == HEAD
    own = [(float(row["x"]), float(row["y"])) for row in rows if row["series"] == "experiment 1"]
    assert own == list(zip(K[[0, 1, 3]].tolist(), B[[0, 1, 3]].tolist(), strict=True))
    assert {row["panel"] for row in rows} == {"Falcon A"}
    assert len(rows) == 3 + 1 + 3 + 3

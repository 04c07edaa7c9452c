"""Columns of a log as drawings: what is found stands in the words, and no extreme is lost to thinning."""

import numpy as np
import pytest

from pipeline.records.figure_records import Figure, RecordedColumn
from pipeline.rendering.figures.log_drawing import MOST_POINTS, recorded, thinned, words


def column(values, **found):
    values = np.asarray(values, dtype=float)
    return RecordedColumn(
        "x <1>", "m", np.arange(len(values)) * 1e-3, values, **({"jumps": (), "rests": (), "gaps": ()} | found)
    )


def test_a_column_is_drawn_with_its_marks():
    shown = column(np.repeat([0.0, 2.0], 50), jumps=(50,), rests=((0, 50),), gaps=(70,), step_row=50)
    (drawing,) = recorded(Figure("response", "log-0-0", "a log", "", (shown,)), "time [s]")
    assert drawing.startswith("<svg")
    assert "x &lt;1&gt; [m]" in drawing
    text = "x <1>: step in row 50; jumps in row 50; rests in rows 0 to 49; rows missing before row 70."
    assert words(shown) == text
    assert words(column([0.0, 1.0])) == "x <1>: no jump, rest or gap."


@pytest.mark.parametrize("values", [[], [1.0], [np.nan, np.nan], [3.0, 3.0]])
def test_columns_with_nothing_to_see_are_drawn(values):
    assert len(recorded(Figure("response", "log-0-0", "a log", "", (column(values),)), "row")) == 1


@pytest.mark.parametrize("rows", [10, 5000, 123_457])
def test_thinning_keeps_the_least_and_the_largest(rows):
    values = np.random.default_rng(rows).standard_normal(rows)
    values[rows // 3], values[rows // 2], values[-1] = 50.0, -50.0, 7.0
    place, kept = thinned(np.arange(rows, dtype=float), values)
    assert len(kept) <= max(rows if rows < 5000 else 0, 2 * MOST_POINTS)
    assert (kept.max(), kept.min(), kept[-1]) == (50.0, -50.0, 7.0)
    assert (np.diff(place) >= 0).all()
    assert (values[place.astype(int)] == kept).all()

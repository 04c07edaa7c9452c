"""Sentences on causes and on the point to use follow from the scores and limits given."""

from __future__ import annotations

import numpy as np
import pytest
from report_data import BOUND

from pipeline.comparison.scores.overlap import MeasuredLimits
from pipeline.comparison.summary.advice import choice, margin, passive_choice, recommended
from pipeline.comparison.summary.causes import causes
from pipeline.records.findings import BoundaryPoint, Optimum
from pipeline.records.loop_records import PassiveWall
from pipeline.records.score_records import BandScore, Departure
from pipeline.rendering.labels import UNITS

FALCON = UNITS["translation"]


@pytest.fixture
def result(falcon_outcome):
    return falcon_outcome.result.experiments[0]


def with_scores(result, **changes):
    """The result with one set of scores, of which some are replaced."""
    base = result.scores[0].model_copy(update={"bound": None, "delay": None, "band": None, **changes})
    return result.model_copy(update={"scores": (base,)})


def off(result, median):
    return result.scores[0].distance.model_copy(update={"median": median})


BAND = {"mass": (0.5, 0.6), "viscous_damping": (3, 5), "delay_samples": (3, 5), "damping": (), "low": (), "high": ()}


def test_agreement_needs_no_cause(result):
    assert causes(result, FALCON) == []
    assert causes(result.model_copy(update={"scores": ()}), FALCON) == []


def test_band_explains_a_deviation_or_not(result):
    inside = BandScore(**BAND, points=20, inside=20)
    (text,) = causes(with_scores(result, band=inside, distance=off(result, 0.1)), FALCON)
    assert text.startswith("The intervals of the estimated m, b and d = 3 to 5 allow this deviation: 20 of 20")
    departures = (
        Departure(side="above", damping_low=0, damping_high=8, dampings=2),
        Departure(side="below", damping_low=100, damping_high=148, dampings=8),
    )
    outside = BandScore(**BAND, points=20, inside=10, departures=departures)
    (text,) = causes(with_scores(result, band=outside, distance=off(result, 0.1)), FALCON)
    assert "do not explain it: only 10 of 20" in text
    assert "lies below it from B = 100 to 148 Ns/m" in text


def test_bound_is_named_first(result):
    gone = Departure(side="below", damping_low=100, damping_high=180, dampings=19)
    band = BandScore(**BAND, points=20, inside=1, departures=(gone,))
    texts = causes(with_scores(result, bound=BOUND, band=band, distance=off(result, 0.1)), FALCON)
    assert texts[0].startswith("From B = 100 Ns/m on the boundary is a straight line, K ≤ 38000 N/m − 230 s⁻¹ B")
    assert "20 % of the region" in texts[0]
    assert len(texts) == 2


def limits(*K, censored=()):
    B = 10.0 * np.arange(len(K))
    flags = np.isin(np.arange(len(K)), censored)
    values = np.array(K, dtype=float)
    return MeasuredLimits(B, values, values, values, flags, np.ones(len(K), dtype=bool))


def test_margin_in_both_directions():
    found = margin(limits(0, 2000, 4000, 4000, 2000, 0), 1500, 25)
    assert (found.limit, found.damping_low, found.damping_high) == (4000, 10, 40)
    gap = margin(limits(2000, 0, 4000, 4000), 1500, 20)  # not stable at B = 10: what lies beyond is no margin
    assert (gap.damping_low, gap.damping_high) == (20, 30)
    assert margin(limits(2000, 2000, censored=(1,)), 1000, 10).bound
    assert margin(limits(2000, 2000), 1000, 11) is None


def test_choice_tells_how_near_the_limit_is(result):
    points = tuple(
        BoundaryPoint(damping=10.0 * i, stable=k, unstable=k + 200, censored=False)
        for i, k in enumerate((1000.0, 3000.0, 5000.0, 3000.0))
    )
    best = {"settle_2pct": Optimum(stiffness=2550, damping=20, cost=24)}
    near = result.model_copy(update={"boundary": points, "optimum": best})
    assert choice(near, FALCON).endswith(
        "the limit there is 2 times as stiff, and this K is stable for B = 10 to 30 Ns/m."
    )
    alone = result.model_copy(update={"boundary": points[2:3], "optimum": best})
    assert choice(alone, FALCON).endswith("and this K is stable for B = 20 Ns/m only.")
    close = {"settle_2pct": Optimum(stiffness=4800, damping=20, cost=24)}
    text = choice(result.model_copy(update={"boundary": points, "optimum": close}), FALCON)
    assert "only 1.06 times as stiff" in text
    assert "take a softer wall" in text
    assert choice(result.model_copy(update={"optimum": {}}), FALCON) == ""
    lost = result.model_copy(update={"boundary": (), "optimum": best})
    assert choice(lost, FALCON).endswith("how far it is from the stability limit is not known.")


def test_settling_time_comes_before_energy(result):
    points = {c: Optimum(stiffness=1, damping=1, cost=1) for c in ("overshoot", "energy_step_w1", "settle_2pct")}
    assert recommended(result.model_copy(update={"optimum": points}))[0] == "settle_2pct"
    del points["settle_2pct"]
    assert recommended(result.model_copy(update={"optimum": points}))[0] == "energy_step_w1"


def test_the_passive_wall_is_named_as_it_was_checked_or_its_absence_explained(result):
    wall = PassiveWall(stiffness=1548.0, damping=2.387)
    assert "at most K = 1548 N/m at B = 2.387 Ns/m" in passive_choice(
        result.model_copy(update={"passive": wall}), FALCON
    )
    none = result.model_copy(update={"passive": None, "passive_reason": "b may be 0"})
    assert passive_choice(none, FALCON) == "No passive wall is named: b may be 0."


def test_a_deviation_below_two_percent_needs_no_band(result):
    outside = BandScore(**BAND, points=20, inside=10)
    assert causes(with_scores(result, band=outside, distance=off(result, 0.01)), FALCON) == []

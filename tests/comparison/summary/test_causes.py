"""Sentences on causes follow from the scores and limits given."""

from __future__ import annotations

import pytest
from report_data import BOUND

from pipeline.comparison.summary.advice import passive_choice
from pipeline.comparison.summary.causes import causes
from pipeline.records.loop_records import Cause, PassiveWall
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


def test_delays_that_the_logs_leave_open_are_told_where_they_explain_the_limits_alone(result):
    delay = result.estimates["delay_samples"].model_copy(update={"low": 3.0, "high": 6.0})
    shifted = with_scores(result, distance=off(result, 0.28))
    jittering = shifted.model_copy(update={"estimates": result.estimates | {"delay_samples": delay}})
    (text,) = causes(jittering, FALCON)
    assert text.startswith("Delays of 3 to 6 samples in the logs (theory: 4) could alone explain ")
    # beside what the logs show, a wide range of delays is no cause
    friction = Cause(code="coulomb_friction", sentence="The device has Coulomb friction of 0.9 N.", evidence="")
    assert causes(jittering.model_copy(update={"causes": (friction,)}), FALCON) == []
    sure = delay.model_copy(update={"high": 3.0})
    assert causes(shifted.model_copy(update={"estimates": result.estimates | {"delay_samples": sure}}), FALCON) == []


def test_bound_is_named_first(result):
    gone = Departure(side="below", damping_low=100, damping_high=180, dampings=19)
    band = BandScore(**BAND, points=20, inside=1, departures=(gone,))
    texts = causes(with_scores(result, bound=BOUND, band=band, distance=off(result, 0.1)), FALCON)
    assert texts[0].startswith("From B = 100 Ns/m on the boundary is a straight line, K ≤ 38000 N/m − 230 s⁻¹ B")
    assert "20 % of the region" in texts[0]
    assert len(texts) == 2


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

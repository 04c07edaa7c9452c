"""Sentences on causes follow from the scores and limits given."""

from __future__ import annotations

import pytest
from report_data import BOUND

from pipeline.comparison.summary.causes import causes
from pipeline.records.loop_records import Cause
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
    (cause,) = causes(with_scores(result, band=inside, distance=off(result, 0.1)), FALCON)
    assert cause.sentence == "The intervals of m, b and d = 3 to 5 allow the deviation."
    assert cause.evidence.startswith("20 of 20 limits")
    departures = (
        Departure(side="above", damping_low=0, damping_high=8, dampings=2),
        Departure(side="below", damping_low=100, damping_high=148, dampings=8),
    )
    outside = BandScore(**BAND, points=20, inside=10, departures=departures)
    (cause,) = causes(with_scores(result, band=outside, distance=off(result, 0.1)), FALCON)
    assert "do not explain the deviation" in cause.sentence
    assert cause.evidence.startswith("10 of 20 limits")
    assert "lies below it from B = 100 to 148 Ns/m" in cause.evidence


def test_delays_that_the_logs_leave_open_are_told_where_they_explain_the_limits_alone(result):
    delay = result.estimates["delay_samples"].model_copy(update={"low": 3.0, "high": 6.0})
    shifted = with_scores(result, distance=off(result, 0.28))
    jittering = shifted.model_copy(update={"estimates": result.estimates | {"delay_samples": delay}})
    (cause,) = causes(jittering, FALCON)
    assert (cause.code, "3 to 6 samples in the logs, 4 in theory" in cause.sentence) == ("delay_range", True)
    # beside what the logs show, a wide range of delays is no cause
    friction = Cause(code="coulomb_friction", sentence="The device has Coulomb friction of 0.9 N.", evidence="")
    assert causes(jittering.model_copy(update={"causes": (friction,)}), FALCON) == []
    sure = delay.model_copy(update={"high": 3.0})
    assert causes(shifted.model_copy(update={"estimates": result.estimates | {"delay_samples": sure}}), FALCON) == []


def test_bound_is_named_first(result):
    gone = Departure(side="below", damping_low=100, damping_high=180, dampings=19)
    band = BandScore(**BAND, points=20, inside=1, departures=(gone,))
    found = causes(with_scores(result, bound=BOUND, band=band, distance=off(result, 0.1)), FALCON)
    assert [cause.code for cause in found] == ["straight_limit", "parameter_range"]
    assert found[0].evidence == "K ≤ 38000 N/m − 230 s⁻¹ B from B = 100 Ns/m; 20 % of the region is cut off"


def test_a_deviation_below_two_percent_needs_no_band(result):
    outside = BandScore(**BAND, points=20, inside=10)
    assert causes(with_scores(result, band=outside, distance=off(result, 0.01)), FALCON) == []

"""The band holds every theory inside the intervals, and the boundary of simulated logs with these parameters."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.base.errors import ParameterError
from pipeline.comparison.scores.overlap import MeasuredLimits, measured_limits
from pipeline.comparison.scores.theory_band import ParameterBox, band_score, parameter_box, theory_band
from pipeline.loop.loop import Normalised
from pipeline.records.findings import Estimate
from pipeline.theory.limits import stiffness_limit

BOX = ParameterBox((0.55, 0.61), (2.0, 6.0), (3.0, 5.0), 1e-3)
FIRM = ParameterBox((0.9, 1.1), (30.0, 38.0), (3.5, 4.5), 1e-3)
DAMPING = np.arange(0.0, 190.0, 4.0)


def limits_at(box: ParameterBox, m: float, b: float, d: float) -> np.ndarray:
    scale = Normalised(m, box.sampling_period_s)
    return np.maximum(stiffness_limit(scale.loop(0.0, b, d), DAMPING / scale.damping), 0.0) * scale.stiffness


@pytest.mark.parametrize("box", [BOX, FIRM], ids=["falcon", "firm grip"])
def test_band_holds_a_thousand_random_theories(box):
    low, high = theory_band(box, DAMPING)
    rng = np.random.default_rng(5)
    for m, b, d in zip(
        *(rng.uniform(*x, 1000) for x in (box.mass, box.viscous_damping, box.delay_samples)), strict=True
    ):
        limit = limits_at(box, m, b, d)
        # the extremum over m between two of the masses that are tried: less than 1e-3 of the limit
        assert (limit >= low * (1 - 1e-3)).all()
        assert (limit <= high * (1 + 1e-3)).all()


def test_band_is_no_wider_than_theories_inside_it():
    low, high = theory_band(BOX, DAMPING)
    corners = np.stack([limits_at(BOX, m, b, d) for m in BOX.mass for b in BOX.viscous_damping for d in (3.0, 5.0)])
    assert low == pytest.approx(corners.min(axis=0), rel=1e-3)
    assert high == pytest.approx(corners.max(axis=0), rel=1e-3)


@pytest.mark.parametrize("name", ["viscous_damping", "delay_samples"])
def test_limit_is_monotone_in_damping_and_delay(name):
    values = np.linspace(0.0, 40.0, 41) if name == "viscous_damping" else np.linspace(1.0, 8.0, 71)
    found = np.stack([limits_at(BOX, 0.58, x, 4.0) if name[0] == "v" else limits_at(BOX, 0.58, 4.0, x) for x in values])
    steps = np.diff(found, axis=0) * (1 if name == "viscous_damping" else -1)
    assert steps.min() >= -1e-6  # N/m: rounding of limits of 1e4
    assert steps.max() > 1.0


def estimate(value: float | None, low: float | None = None, high: float | None = None, **methods: Estimate) -> Estimate:
    reason = None if value is not None else "none"
    return Estimate(value=value, low=low, high=high, unit="", method="", reason=reason, by_method=methods)


def test_box_takes_the_delays_that_occurred():
    m, b = estimate(0.58, 0.57, 0.59), estimate(-0.1, -0.3, 0.2)
    jitter = parameter_box(m, b, estimate(4, 3, 6, model=estimate(3.9, 3.85, 3.95)), 1e-3)
    assert jitter == ParameterBox((0.57, 0.59), (0.0, 0.2), (3, 5), 1e-3)
    part = parameter_box(m, b, estimate(4, 4, 5, model=estimate(4.4, 4.38, 4.42)), 1e-3)
    assert part is not None
    assert part.delay_samples == (4, 4.42)
    doubtful = parameter_box(m, b, estimate(4, 4, 5, model=estimate(4.4, 4.38, 4.42)), 1e-3, model_holds=False)
    assert doubtful is not None
    assert doubtful.delay_samples == (4, 5)  # all that (6.3) allows
    assert parameter_box(estimate(None), b, estimate(4), 1e-3) is None


def test_reversed_interval_is_refused():
    with pytest.raises(ParameterError, match="mass"):
        theory_band(ParameterBox((0.6, 0.5), (2.0, 6.0), (3.0, 5.0), 1e-3), DAMPING)


def limits(value: np.ndarray, reach: float = 10.0) -> MeasuredLimits:
    none = np.zeros(len(value), dtype=bool)
    return MeasuredLimits(DAMPING, value, value - reach, value + reach, none, ~none)


def test_departures_are_told_by_side_and_damping():
    low, high = theory_band(BOX, DAMPING)
    value = 0.5 * (low + high)
    value[5:9] = high[5:9] + 100
    value[20:22] = low[20:22] - 100
    found = band_score(limits(value), BOX)
    assert found is not None
    assert (found.points, found.inside) == (len(DAMPING), len(DAMPING) - 6)
    above, below = found.departures
    assert (above.side, above.damping_low, above.damping_high, above.dampings) == ("above", 20.0, 32.0, 4)
    assert (below.side, below.damping_low, below.damping_high, below.dampings) == ("below", 80.0, 84.0, 2)


def test_lower_bounds_count_only_where_they_lie_above_the_band():
    low, high = theory_band(BOX, DAMPING)
    value = 0.5 * low
    censored = np.ones(len(value), dtype=bool)
    bound = MeasuredLimits(DAMPING, value, value, value, censored, censored)
    assert band_score(bound, BOX) is None
    value[3] = high[3] + 1
    found = band_score(MeasuredLimits(DAMPING, value, value, value, censored, censored), BOX)
    assert found is not None
    assert (found.points, found.inside) == (1, 0)


def test_boundary_of_simulated_logs_lies_inside_the_band_of_their_estimates(falcon_outcome):
    result = falcon_outcome.result.experiments[0]
    band = next(s.band for s in result.scores if s.band)
    # constant delay of 4 samples, m = 0.58 kg, b = 4 Ns/m: the estimates hold the truth
    for (low, high), truth in zip((band.mass, band.viscous_damping, band.delay_samples), (0.58, 4, 4), strict=True):
        assert low - 1e-3 * truth <= truth <= high + 1e-3 * truth
    assert band.points == len(measured_limits(result.boundary).limit)
    assert band.inside == band.points
    assert band.departures == ()

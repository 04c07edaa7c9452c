"""Scores of whole experiments: simulated courses whose theory is known, and a measured branch that is theory itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.comparison.experiment_result import nominal_theories
from pipeline.comparison.scene.scene import open_scene
from pipeline.comparison.scores.scores import scores_of
from pipeline.records.findings import BoundaryPoint, Estimate
from pipeline.records.results import SourcedLoop
from pipeline.theory.boundary import stiffness_limit
from pipeline.theory.predictions import Theory


@pytest.fixture(scope="module")
def ideal(falcon, falcon_outcome):
    """Result, stages and theory of the ideal course."""
    theory = nominal_theories(open_scene("falcon", falcon.processed, None, None))["1"]
    return falcon_outcome.result.experiments[0], falcon.stages("1"), theory


@pytest.mark.slow
def test_device_without_a_file_is_scored_against_its_estimates(unknown_outcome):
    (only,) = unknown_outcome.result.experiments[0].scores
    assert only.basis == "estimates"
    assert only.parameters.mass == unknown_outcome.result.experiments[0].estimates["mass"].value


def test_ideal_course_agrees_with_the_theory_it_was_simulated_with(ideal):
    s = ideal[0].scores[0]
    # the limits are known to a part of their brackets (800 N/m coarse, 160 fine, of 13,000)
    assert s.region.overlap > 0.98
    assert s.region.overlap_low < s.region.overlap < s.region.overlap_high <= 1
    assert s.region.area_ratio == pytest.approx(1, abs=0.02)
    assert s.region.area_ratio_low < 1 < s.region.area_ratio_high
    assert abs(s.distance.median) < 0.01
    assert s.distance.rms < 160  # one fine step
    assert s.stiffness.theory == pytest.approx(s.stiffness.anywhere, rel=0.01)
    assert -800 < s.stiffness.measured - s.stiffness.theory <= 0
    assert s.verdicts.agreement > 0.97
    assert s.verdicts.only_theory_stable == 0
    assert (s.basis, s.missing) == ("device file", {})


def test_theory_against_itself_is_perfect(ideal):
    """The boundary is replaced by the theoretical one, the verdicts by those of theory."""
    result, stages, theory = ideal
    B = np.array([p.damping for p in result.boundary])
    K = np.maximum(stiffness_limit(theory.normalised, B / theory.units.damping), 0) * theory.units.stiffness
    points = tuple(
        BoundaryPoint(damping=b, stable=k or None, unstable=k + 1, censored=False, estimate=k, low=k, high=k)
        for b, k in zip(B.tolist(), K.tolist(), strict=True)
    )
    (found,) = scores_of(result.model_copy(update={"boundary": points}), stages, theory, by_file=True)
    region = found.region
    values = (region.overlap, region.overlap_low, region.overlap_high, region.covered, region.area_ratio)
    assert values == pytest.approx([1.0] * 5, rel=1e-12)
    assert found.distance.largest == found.distance.rms == 0.0
    assert found.stiffness.deviation_percent == pytest.approx(0.0, abs=1e-12)


def test_censored_dampings_bound_the_window(ideal):
    """Where the tested range ended first, theory above it does not count, and the measured maximum is a lower bound."""
    result, stages, theory = ideal
    points = tuple(
        p if p.stable is None else p.model_copy(update={"stable": 2000.0, "unstable": None, "censored": True})
        for p in result.boundary
    )
    (found,) = scores_of(result.model_copy(update={"boundary": points}), stages, theory, by_file=True)
    assert found.region.censored == sum(p.censored for p in points) > 5
    assert found.region.overlap > 0.9
    assert found.region.theory_area < 0.5 * result.scores[0].region.theory_area
    assert found.stiffness.lower_bound
    assert found.distance is None or found.distance.open > 5


def test_missing_scores_have_a_reason(ideal):
    result, stages, theory = ideal
    bare = result.model_copy(update={"boundary": ()})
    (found,) = scores_of(bare, stages, theory, by_file=True)
    for name in ("region", "distance", "stiffness"):
        assert getattr(found, name) is None
        assert found.missing[name]
    assert found.verdicts is not None


def test_the_largest_stable_damping_is_scored_against_that_of_theory(ideal):
    score = ideal[0].scores[0].damping
    # the ideal course was tested up to its own largest damping, where some wall is stable
    assert score.lower_bound
    assert score.theory > score.measured
    assert score.deviation_percent == pytest.approx(100 * (score.measured / score.theory - 1), abs=1e-9)


def test_the_largest_stable_damping_is_a_lower_bound_unless_a_soft_wall_beyond_it_is_unstable(ideal):
    result, stages, theory = ideal
    at = {"censored": False, "estimate": None, "low": None, "high": None}
    first = result.boundary[0].model_copy(update=at | {"damping": 152.0, "stable": 3600.0, "unstable": 9000.0})
    for unstable, bound in ((3680.0, True), (200.0, False)):
        last = first.model_copy(update={"damping": 184.0, "stable": None, "unstable": unstable})
        (found,) = scores_of(result.model_copy(update={"boundary": (first, last)}), stages, theory, by_file=True)
        assert (found.damping.measured, found.damping.lower_bound) == (152.0, bound)


@pytest.mark.parametrize(("low", "count"), [(3.0, 1), (5.0, 2)], ids=["agrees", "differs"])
def test_scores_with_the_measured_damping_follow_if_it_differs_from_the_file(ideal, low, count):
    result, stages, theory = ideal
    damping = Estimate(value=low + 2, low=low, high=low + 4, unit="Ns/m", method="test")
    changed = result.model_copy(update={"estimates": result.estimates | {"damping": damping}})
    found = scores_of(changed, stages, theory, by_file=True)
    assert [each.basis for each in found] == ["device file", "measured damping"][:count]
    assert found[0] == scores_of(result, stages, theory, by_file=True)[0]
    if count == 2:
        # a device file with this damping has the same scores
        loop = replace(theory.loop, damping=7.0)
        (expected,) = scores_of(
            result.model_copy(update={"estimates": {"damping": damping.model_copy(update={"low": 6.9, "high": 7.1})}}),
            stages,
            Theory(SourcedLoop(loop=loop, source="another file")),
            by_file=True,
        )
        assert found[1].region == expected.region
        assert found[1].damping.theory > found[0].damping.theory

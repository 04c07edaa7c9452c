"""Two experiments against each other: known differences are found, and chance is not taken for one."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.base.errors import DeviceError, UsageError
from pipeline.comparison.against import (
    against_document,
    against_experiments,
    compare_boundaries,
    compare_costs,
    compare_pair,
    difference_interval,
    names_of,
    read_document,
)
from pipeline.records.findings import BoundaryPoint, Estimate, Note, Optimum
from pipeline.records.results import Side
from pipeline.rendering.report.report_against import pair_tables, render
from pipeline.shell.cli import app

pytestmark = pytest.mark.usefixtures("one_process")

CRITERIA = ("settle_2pct", "overshoot")


def points(limit, damping, error=None, censored=()):
    return tuple(
        BoundaryPoint(
            damping=float(b),
            stable=float(k) - 5,
            unstable=None if b in censored else float(k) + 5,
            censored=b in censored,
            estimate=None if error is None or b in censored else float(k),
            low=None if error is None else float(k) - error,
            high=None if error is None or b in censored else float(k) + error,
        )
        for b, k in zip(damping, limit(np.asarray(damping, dtype=float)), strict=True)
    )


def line(b):
    return 1000.0 + 10.0 * b


ONE = (1.0, 1.0)


def test_a_boundary_against_itself_differs_nowhere():
    damping = np.arange(0.0, 50.0, 4.0)
    found, reason = compare_boundaries(points(line, damping, 20), points(line, damping, 20), ONE, ONE)
    assert reason is None
    assert (found.median_percent, found.largest_percent, found.significant) == (0, 0, 0)
    assert found.judged == len(damping)
    assert not found.interpolated


def test_a_shift_is_found_exactly_also_between_the_dampings_of_the_other():
    damping = np.arange(0.0, 50.0, 4.0)
    shifted = points(lambda b: 1.1 * line(b), np.arange(-1.0, 60.0, 5.0), 20)
    found, _ = compare_boundaries(points(line, damping, 20), shifted, ONE, ONE)
    # a straight line is interpolated without error
    assert found.median_percent == pytest.approx(10, abs=1e-9)
    assert found.largest_percent == pytest.approx(10, abs=1e-9)
    assert found.interpolated
    # 10 % of 1000 to 1480 stand against sqrt(2) * 20
    assert found.significant == found.judged == len(damping)
    small, _ = compare_boundaries(points(line, damping, 20), points(lambda b: line(b) + 25, damping, 20), ONE, ONE)
    assert small.significant == 0, "25 lies inside sqrt(2) * 20 = 28.3"
    enough, _ = compare_boundaries(points(line, damping, 20), points(lambda b: line(b) + 30, damping, 20), ONE, ONE)
    assert enough.significant == len(damping)


def test_censored_limits_are_left_out_and_brackets_stand_for_missing_estimates():
    damping = np.arange(0.0, 20.0, 4.0)
    found, _ = compare_boundaries(points(line, damping, censored=(16,)), points(line, damping), ONE, ONE)
    assert [p.damping for p in found.points] == [0, 4, 8, 12]
    assert [p.first for p in found.points] == line(damping[:4]).tolist()
    assert found.judged == 0
    none, reason = compare_boundaries(points(line, damping, censored=damping), points(line, damping), ONE, ONE)
    assert none is None
    assert "no trial was unstable up to the end" in reason
    apart, reason = compare_boundaries(points(line, damping), points(line, damping + 100), ONE, ONE)
    assert apart is None
    assert reason == "the boundaries cover no common damping"


def test_devices_that_differ_in_mass_and_period_alone_have_one_boundary_in_the_normalised_plane():
    beta = np.arange(0.0, 0.4, 0.04)

    def side(m, period):
        k, b = m / period**2, m / period
        return points(lambda damping: k * (0.01 + 0.02 * damping / b), beta * b, 1e-4 * k), (k, b)

    (a, a_scale), (b, b_scale) = side(0.58, 1e-3), side(0.19, 4e-3)
    found, _ = compare_boundaries(a, b, a_scale, b_scale)
    # rounding of K T^2/m, and of the ends of the covered range
    assert abs(found.largest_percent) < 1e-9
    assert len(found.points) >= len(beta) - 1
    physical, reason = compare_boundaries(a, b, ONE, ONE)
    assert physical is None or abs(physical.median_percent) > 50, reason


def test_interval_of_a_difference_covers_a_true_difference_in_95_percent():
    rng = np.random.default_rng(5)
    errors = rng.normal(size=(4000, 2)) * [1.0, 2.0]
    half = 1.96 * np.array([1.0, 2.0])
    inside = 0
    for x, y in np.add(errors, [3.0, 4.0]):
        low, high = difference_interval((x, x - half[0], x + half[0]), (y, y - half[1], y + half[1]))
        inside += low <= 1.0 <= high
    # 4000 draws: standard error 0.34 %; four of them
    assert inside / len(errors) == pytest.approx(0.95, abs=0.014)


def test_lopsided_intervals_count_with_the_side_that_faces_the_other():
    low, high = difference_interval((0.0, -1.0, 3.0), (10.0, 6.0, 11.0))
    assert (low, high) == (10 - 5, 10 + np.hypot(1, 1))


def estimate(value, half=None, unit="kg", reason=None):
    ends = {} if half is None else {"low": value - half, "high": value + half}
    return Estimate(value=value, unit=unit, method="m", reason=reason, **ends).model_dump()


def test_values_are_judged_where_they_can_be():
    first = {
        "mass": estimate(0.58, 0.01),
        "damping": estimate(4.0, 0.5),
        "delay_samples": estimate(4.0, 1.0, "samples"),
        "other": estimate(None, reason="no logs"),
        "gone": estimate(1.0),
    }
    second = {
        "mass": estimate(0.60, 0.01),
        "damping": estimate(4.2, 0.5),
        "delay_samples": estimate(5.0, 0.0, "samples"),
        "other": estimate(1.0),
    }
    best = Optimum(stiffness=5000, damping=80, cost=0.01, cost_low=0.008, cost_high=0.012).model_dump()
    other = best | {"stiffness": 5600, "damping": 88, "cost": 0.02, "cost_low": 0.018, "cost_high": 0.022}
    documents = (
        {"estimates": first, "boundary": [], "optimum": {"overshoot": best}},
        {"estimates": second, "boundary": [], "optimum": {"overshoot": other, "x": best}},
    )
    side = Side(device="a", experiment="1", version="1", code="x")
    pair = compare_pair((side, side), documents, "translation")
    found = {v.name: v for v in (*pair.estimates, *pair.optima)}
    places = {"overshoot/stiffness", "overshoot/damping", "overshoot/cost"}
    assert set(found) == {"mass", "damping", "delay_samples", "other", *places}
    assert [found[name].significant for name in ("mass", "damping", "delay_samples")] == [True, False, None]
    assert (found["delay_samples"].difference, found["other"].reason) == (1, "no logs")
    assert found["overshoot/cost"].significant is True
    assert (found["overshoot/stiffness"].difference, found["overshoot/stiffness"].significant) == (600, None)
    scaled = compare_pair((side, side), documents, "translation", ((1e3, 10.0), (2e3, 10.0)))
    place = next(v for v in scaled.optima if v.name == "overshoot/stiffness")
    assert (scaled.plane, place.first, place.second, place.unit) == ("normalised", 5.0, 2.8, "1")
    assert {v.reason for v in scaled.estimates} == {"devices differ"}


def test_costs_are_compared_at_common_points_alone():
    rng = np.random.default_rng(2)
    k, b = (v.ravel() for v in np.meshgrid(np.arange(20.0), np.arange(10.0)))
    cost = 10 + rng.random(k.size)
    more = np.concatenate([1.3 * cost, [1e6]])
    trials = {"energy_step_w0": (k, b, cost)}
    other = {"energy_step_w0": (np.append(k, 99.0), np.append(b, 99.0), more)}
    (found,) = compare_costs(trials, other)
    assert (found.points, found.kind) == (200, "ratio")
    assert found.median == pytest.approx(1.3, rel=1e-12)
    assert found.significant is True
    cost[::2] = np.nan
    (half,) = compare_costs(trials, other)
    assert half.points == 100
    (none,) = compare_costs(trials, {"energy_step_w0": (k + 0.5, b, cost)})
    assert (none.points, none.median) == (0, None)
    assert "equal stiffness and damping" in none.reason


def test_repeated_trials_at_a_point_count_by_their_median_and_overshoot_by_its_difference():
    k, b = np.array([1.0, 1.0, 1.0, 2.0]), np.zeros(4)
    first = {"overshoot": (k, b, np.array([0.1, 0.9, 0.2, 0.0]))}
    second = {"overshoot": (k[2:], b[2:], np.array([0.25, 0.05]))}
    (found,) = compare_costs(first, second)
    assert (found.kind, found.points) == ("difference", 2)
    assert found.median == pytest.approx(0.05)
    assert found.significant is None
    assert "at least 6 points" in found.reason


@pytest.mark.slow
def test_chance_is_called_significant_in_one_of_twenty_runs():
    rng = np.random.default_rng(8)
    k, b = np.arange(61.0), np.zeros(61)
    hits = 0
    for _ in range(2000):
        ratio = np.exp(rng.normal(size=61))
        (found,) = compare_costs({"energy_step_w0": (k, b, np.ones(61))}, {"energy_step_w0": (k, b, ratio)})
        hits += found.significant
    # by ranks at most 5 %, less for a discrete distribution: 3.9 % here; standard error 0.5 %
    assert 0.02 < hits / 2000 < 0.055


@pytest.mark.parametrize("count", [6, 20, 61])
def test_costs_of_the_first_against_the_second_are_the_mirror_image(count):
    k, b = np.arange(float(count)), np.zeros(count)
    difference = np.random.default_rng(9).normal(0.1, 0.05, count)
    trials = {"overshoot": (k, b, np.full(count, 0.3))}, {"overshoot": (k, b, 0.3 + difference)}
    (there,), (back,) = compare_costs(*trials), compare_costs(*trials[::-1])
    assert (back.low, back.high) == pytest.approx((-there.high, -there.low), abs=1e-12)
    # ranks of the ends by the binomial distribution: outside of them lie less than 2.5 % on each side
    below = sum(math.comb(count, i) for i in range(int((np.sort(difference) < there.low - 1e-12).sum()) + 1))
    assert below / 2.0**count < 0.025


# --- stored experiments, documents, commands --------------------------------------------------------------------------


@pytest.mark.slow
def test_two_delays_differ_as_the_theory_says(lwr):
    notes = [Note(experiment="delay-4", tags=("slow",), text="gears <greased>")]
    page = against_experiments(lwr.processed, ("lwr", "delay-2"), ("lwr", "delay-4"), CRITERIA, notes=((), notes))
    (pair,) = page.result.pairs
    # more delay, smaller region: the linear condition (3.25) gives K ~ 1/(d + 0.5), so 2.5/4.5 near the origin
    assert pair.boundary.median_percent < -40
    assert pair.boundary.significant > 0.8 * pair.boundary.judged
    delay = next(v for v in pair.estimates if v.name == "delay_samples")
    assert delay.difference == 2
    settling = next(c for c in pair.costs if c.criterion == "settle_2pct")
    assert settling.points > 10
    assert settling.median > 1
    drawn = [s for s in page.figures[0].panels[0].series if s.kind == "measured"]
    for series, side in zip(drawn, ("first", "second"), strict=True):
        limits = dict(zip(series.y.tolist(), series.x.tolist(), strict=True))
        assert [limits[p.damping] for p in pair.boundary.points] == [getattr(p, side) for p in pair.boundary.points]
        assert (series.low <= series.high)[np.isfinite(series.x)].all(), "the interval that the caption names"
    page_text = render(page)
    assert page_text.count("<svg") == 1
    assert "lwr delay-2 against lwr delay-4" in page_text
    names = [t.name for t in pair_tables(pair, "rotation")]
    assert names == ["estimates-0", "optima-0", "scores-0", "costs-0", "boundary-0", "notes-0"]
    assert "gears &lt;greased&gt;" in page_text


@pytest.mark.slow
def test_a_device_that_turns_keeps_its_units_beside_one_that_does_not(falcon, lwr, tmp_path):
    both = tmp_path / "processed"
    for lab in (falcon, lwr):
        shutil.copytree(lab.processed, both, dirs_exist_ok=True)
    page = against_experiments(both, ("falcon", "1"), ("lwr", "delay-2"), ("overshoot", "settle_2pct"))
    (pair,) = page.result.pairs
    units = {v.name: v.unit for v in pair.estimates}
    assert units["damping"] == "Ns/m and Nms/rad"
    assert units["delay_samples"] == "samples"
    html = render(page)
    assert "delay [samples]" in html


@pytest.mark.slow
def test_an_experiment_of_an_unknown_device_is_compared_in_the_normalised_plane(falcon, unknown, tmp_path):
    both = tmp_path / "processed"
    for lab in (falcon, unknown):
        shutil.copytree(lab.processed, both, dirs_exist_ok=True)
    page = against_experiments(both, ("falcon", "1"), ("mydevice", "1"), CRITERIA)
    (pair,) = page.result.pairs
    assert pair.plane == "normalised"
    # the same simulated device: the boundaries agree within the coarser steps of both courses (some 5 %)
    assert abs(pair.boundary.median_percent) < 5
    assert pair.costs == ()
    assert "α" in render(page)


def test_against_an_earlier_document_of_another_version(falcon_outcome, tmp_path):
    document = json.loads(falcon_outcome.report.with_suffix(".json").read_text(encoding="utf-8"))
    path = tmp_path / "old.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    (pair,) = against_document(falcon_outcome.result, read_document(path, "falcon")).result.pairs
    assert pair.boundary.largest_percent == 0
    assert all(v.difference in (0, None) for v in (*pair.estimates, *pair.optima))
    document["provenance"]["version"] = "0.0.9"
    experiment = document["experiments"][0]
    experiment["estimates"]["mass"]["value"] *= 1.1
    experiment["estimates"]["mass"] |= {"low": 0.63, "high": 0.64, "of_another_version": 1}
    experiment["of_another_version"] = {"a": 1}
    del experiment["configuration"]
    document["experiments"].append(experiment | {"experiment": "9"})
    path.write_text(json.dumps(document), encoding="utf-8")
    page = against_document(falcon_outcome.result, read_document(path, "falcon"))
    assert page.result.only_first == ("9",)
    assert page.result.pairs[0].first.version == "0.0.9"
    mass = next(v for v in page.result.pairs[0].estimates if v.name == "mass")
    assert mass.significant is True
    assert mass.difference < 0
    assert "falcon 1 before" in render(page)


def test_wrong_documents_and_pairs_are_refused(falcon, falcon_outcome, tmp_path):
    for text in ("", "[]", "{}", '{"device": "falcon", "experiments": [1]}'):
        (tmp_path / "x.json").write_text(text)
        with pytest.raises(UsageError, match="is not a result"):
            read_document(tmp_path / "x.json", "falcon")
    with pytest.raises(UsageError, match="cannot be read"):
        read_document(tmp_path / "none.json", "falcon")
    (tmp_path / "x.json").write_text('{"device": "lwr", "experiments": []}')
    with pytest.raises(UsageError, match="belongs to device 'lwr'; expected device 'falcon'"):
        read_document(tmp_path / "x.json", "falcon")
    with pytest.raises(UsageError, match="compared with itself"):
        against_experiments(falcon.processed, ("falcon", "1"), ("falcon", "1"))
    with pytest.raises(DeviceError):
        against_experiments(falcon.processed, ("falcon", "1"), ("falcon", "2"))


def test_names_of_the_other_experiment():
    assert names_of("2", "falcon", ["1", "2"]) == ("falcon", "2")
    assert names_of("lwr:delay-4", "falcon", ["1"]) == ("lwr", "delay-4")
    assert names_of("a:b", "falcon", ["1", "a:b"]) == ("falcon", "a:b")


def test_command_prints_and_writes_what_differs(lwr, tmp_path):
    runner = CliRunner()
    report = tmp_path / "pair.html"
    arguments = ["compare", "--device", "lwr", "-e", "delay-2", "--against", "delay-4", "--criteria", "overshoot"]
    arguments += ["--processed", str(lwr.processed), "--report", str(report)]
    result = runner.invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert re.search(r"The boundary of lwr delay-4 lies −\d", result.stdout)
    page = report.read_text(encoding="utf-8")
    assert "The logs of lwr delay-2 are simulated" in page
    assert page.count(">simulated</text>") == page.count("<svg") > 0
    document = json.loads(runner.invoke(app, [*arguments, "--json"]).stdout)
    assert document == json.loads(report.with_suffix(".json").read_text(encoding="utf-8"))
    failed = runner.invoke(
        app, ["compare", "--device", "lwr", "--against", "delay-4", "--processed", str(lwr.processed)]
    )
    assert failed.exit_code != 0


def test_the_document_of_the_report_itself_is_read_before_it_is_replaced(lwr, tmp_path):
    report = tmp_path / "lwr.html"
    arguments = ["compare", "--device", "lwr", "-e", "delay-2", "--criteria", "overshoot", "--report", str(report)]
    arguments += ["--processed", str(lwr.processed), "--json"]
    first = CliRunner().invoke(app, arguments)
    assert first.exit_code == 0, first.output
    document = json.loads(first.stdout)
    document["provenance"] |= {"version": "0.0.9", "key": "of another version"}
    pages = []
    (tmp_path / "old").mkdir()
    for path in (tmp_path / "old" / "lwr.json", report.with_suffix(".json")):
        path.write_text(json.dumps(document), encoding="utf-8")
        result = CliRunner().invoke(app, [*arguments, "--against", str(path)])
        assert result.exit_code == 0, result.output
        page = json.loads(result.stdout)
        assert page["pairs"][0]["first"]["version"] == "0.0.9"
        pages.append(page["report"])
    assert json.loads(report.with_suffix(".json").read_text(encoding="utf-8")) == json.loads(first.stdout)
    assert len(set(pages)) == 2, "two documents of one name have pages of their own"
    for page in pages:
        assert re.fullmatch(r"lwr-against-earlier-[0-9a-f]{8}\.html", Path(page).relative_to(tmp_path).name)

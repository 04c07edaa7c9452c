"""The page that lays experiments beside each other: differences with intervals, planes, and a file of its own."""

import html
import re

import pytest
from served import HTML, Browser, page

from pipeline.service.pages.comparing import differences, planes
from pipeline.service.results import DocumentRequest, limits

TWO = "/compare?runs=falcon/1&runs=falcon/2"


@pytest.fixture(scope="module")
def run(falcon_outcome):
    """The shared course as one side."""
    return "falcon", "1", falcon_outcome.result.model_dump(mode="json")


def changed(run, device, experiment, **estimates):
    """The same experiment under another name, with other numbers."""
    _, _, document = run
    (found,) = document["experiments"]
    new = {name: found["estimates"][name] | values for name, values in estimates.items()}
    found = found | {"experiment": experiment, "estimates": found["estimates"] | new}
    return device, experiment, document | {"device": device, "experiments": [found]}


def test_differences_are_those_of_the_estimates_with_their_intervals(run):
    mass = run[2]["experiments"][0]["estimates"]["mass"]
    value, low, high = mass["value"], mass["low"], mass["high"]
    far = {"value": value + 10 * (high - low), "low": low + 10 * (high - low), "high": high + 10 * (high - low)}
    pair, why = differences(run, changed(run, "falcon", "2", mass=far))
    assert why == ""
    found = {v.name: v for v in (*pair.estimates, *pair.scores, *pair.optima)}
    difference = found["mass"]
    assert difference.difference == pytest.approx(10 * (high - low))
    assert difference.low < difference.difference < difference.high
    # errors of both sides, added as squares
    half = ((value - low) ** 2 + (high - value) ** 2) ** 0.5
    assert difference.high - difference.difference == pytest.approx(half)
    assert difference.significant is True
    score = run[2]["experiments"][0]["scores"][0]["region"]
    same = found["region/overlap"]
    assert (same.first, same.difference, same.significant) == (score["overlap"], 0, False)
    assert same.low <= 0 <= same.high
    assert found["distance/median"].significant is None
    assert found["distance/median"].reason
    cost = found["settle_2pct/cost"]
    assert (cost.difference, cost.significant) == (0, False)


def test_scores_against_other_theories_are_not_judged(run):
    other = changed(run, "falcon", "2")
    (found,) = other[2]["experiments"]
    scores = [found["scores"][0] | {"basis": "estimates"}]
    other = (*other[:2], other[2] | {"experiments": [found | {"scores": scores}]})
    pair, _ = differences(run, other)
    assert {v.significant for v in pair.scores} == {None}
    assert all("device file" in v.reason for v in pair.scores)


def test_two_devices_are_compared_in_normalised_planes_or_not_at_all(run):
    pair, why = differences(run, changed(run, "new rig", "1"))
    assert (pair.plane, why) == ("normalised", "")
    assert not any(v.name.startswith("bound/") for v in pair.scores)
    other = changed(run, "new rig", "1")
    unknown = (*other[:2], other[2] | {"experiments": [other[2]["experiments"][0] | {"theory": None}]})
    pair, why = differences(run, unknown)
    assert pair is None
    assert "mass" in why


def test_planes_are_those_that_all_runs_share(run):
    assert list(planes([run])) == ["physical", "normalised"]
    turned = ("arm", "1", run[2] | {"motion": "rotation"})
    assert list(planes([run, turned])) == ["normalised"]
    alone = run[2]["experiments"][0] | {"theory": None}
    assert list(planes([run, ("arm", "1", run[2] | {"experiments": [alone]})])) == ["physical"]
    assert planes([]) == {}


def test_normalised_limits_are_those_in_k_and_b_by_units_of_the_loop(run, falcon_outcome):
    theory = run[2]["experiments"][0]["theory"]
    most = {}
    for plane in ("physical", "normalised"):
        (axes,) = limits(None, DocumentRequest(plane=plane), [falcon_outcome.result]).shown[0]["axes"]
        most[plane] = max(max(series[1]) for series in axes["series"] if not series[0].startswith("theory"))
    alpha = most["physical"] * theory["sampling_period_s"] ** 2 / theory["mass"]
    assert most["normalised"] == pytest.approx(alpha, rel=1e-3)


def settled(client, path):
    """A page after its jobs are done."""
    text = page(client, path)
    while 'http-equiv="refresh"' in text:
        client.all_done()
        text = page(client, path)
    return text


def test_the_page_keeps_its_plane_in_the_address(three):
    text = html.unescape(settled(three, TWO))
    assert 'plane=physical" aria-current="true"' in text
    other = re.search(r'href="(\?[^"]*plane=normalised)"', text)[1]
    normalised = html.unescape(settled(three, f"/compare{other}"))
    assert 'plane=normalised" aria-current="true"' in normalised
    assert "α = K T²/m" in normalised
    assert "α = K T²/m" not in text
    assert three.get(f"{TWO}&plane=round", **HTML).status == 422
    # eight logs each of the same content: nothing differs, and each estimate stands twice
    row = re.search(r'<th scope="row">mass \[kg\]</th>.*?</tr>', text)[0]
    assert '<td class="words">no</td>' in row
    # a report of the two, by the form of the page
    made = Browser(three).do(TWO, "POST", "comparisons")
    job = three.get(f"jobs/{made.headers['location'].rpartition('/')[2]}").content
    asked = job["request"]["asked"]
    assert (asked["experiments"], asked["against"]) == (["1"], {"device": "falcon", "experiment": "2"})
    assert "<h1>Report of falcon, experiment 1; falcon, experiment 2</h1>" in page(three, f"/jobs/{job['id']}")

"""The page of the next walls: what the planner says of an experiment, with the choice in its address."""

import html
import re
from urllib.parse import quote

from served import page

from pipeline.service.shared import run_of


def first_run(served):
    one = served.get("experiments").content["items"][0]
    return one["device"], one["experiment"], run_of(one["device"], one["experiment"])


def test_the_page_shows_what_the_planner_says(served):
    device, experiment, run = first_run(served)
    address = f"/plan?run={quote(run)}&goal=boundary"
    page(served, address)
    served.all_done()
    text = page(served, address)
    document = served.get(f"plan?device={quote(device)}&experiment={quote(experiment)}").content
    for wall in document["next"]:
        assert html.escape(wall["why"], quote=False) in html.unescape(text) or wall["why"] in html.unescape(text)
        assert "the limit at this damping is above" in text
    rows = re.findall(r'<tr><td class="num">', text)
    assert len(rows) == len(document["boundary"]) + len(document["next"])
    assert "aria-current" in text
    assert f"<option selected>{html.escape(run)}</option>" in text


def test_an_experiment_leads_to_its_plan(served):
    device, experiment, run = first_run(served)
    text = page(served, f"/devices/{quote(device)}/experiments/{quote(experiment)}")
    assert f'href="/plan?run={quote(run, safe="/")}"' in text


def test_an_unknown_experiment_is_named(served):
    answer = served.get("/plan?run=no/such", Accept="text/html")
    assert answer.status == 404
    assert b"There are no trials of this experiment" in answer.content


def test_deleting_asks_for_a_confirmation_that_names_what_goes(served):
    device, experiment, _ = first_run(served)
    text = page(served, f"/devices/{quote(device)}/experiments/{quote(experiment)}")
    box = re.search(r'<input type="checkbox" required> (.*?)</label> <button class="plain">Delete', text)
    assert box is not None
    assert device in html.unescape(box[1])
    assert f"experiment {experiment}" in html.unescape(box[1])

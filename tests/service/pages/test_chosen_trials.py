"""Trials of an experiment page: scatter of two quantities, filters, columns, CSV of all, many at once."""

import re
import shutil

import pytest
from served import Browser, form, page, serving

from pipeline.service.settings import Settings

AT = "/devices/falcon/experiments/1"


@pytest.fixture
def lab(falcon, tmp_path):
    shutil.copytree(falcon.processed, tmp_path / "processed")
    with serving(Settings(tmp_path / "processed", tmp_path / "reports", wait_s=240.0, renew=False)) as client:
        client.all_done()
        yield client


def test_any_two_quantities_are_plotted_and_columns_chosen(served):
    trials = served.get("trials?device=falcon&experiment=1&limit=1000").content["items"]
    with_both = [t for t in trials if {"overshoot", "energy_step_w1"} <= t["costs"].keys()]
    text = page(served, f"{AT}?x=energy_step_w1&y=overshoot&column=energy_step_w1")
    plot = re.search(r'<svg class="scatter".*?</svg>', text, re.DOTALL)[0]
    assert plot.count("<circle") == len(with_both)
    best = min(with_both, key=lambda t: t["costs"]["energy_step_w1"]["value"])
    leftmost = re.search(rf'href="/trials/{best["id"]}".*?cx="([\d.]+)"', plot)[1]
    assert float(leftmost) == 80.0
    heads = re.findall(r'<th scope="col" class="num">(.*?)</th>', text.split("<h2>Trials</h2>")[1])
    assert heads[2:3] == ["energy cost, w = 1 (ITSE-like)"]
    assert served.get(f"{AT}?x=nothing").status == 422
    unstable = page(served, f"{AT}?verdict=unstable&all=true")
    rows = re.findall(r'aria-label="Choose trial', unstable)
    assert len(rows) == sum(t["verdict"] == "unstable" for t in trials)
    lines = page(served, "/trials?device=falcon&experiment=1&format=all").splitlines()
    assert len(lines) - 1 == len(trials)


def test_many_trials_are_tagged_and_excluded_at_once(lab):
    ids = [t["id"] for t in lab.get("trials?limit=6").content["items"]]
    browser = Browser(lab)

    def send(act, words, chosen):
        body = [("form", browser.token(AT)), ("next", AT), ("act", act), ("words", words)]
        sent = form([], **dict(body))
        parts = b"".join(
            b'--a-boundary\r\nContent-Disposition: form-data; name="trial"\r\n\r\n' + one.encode() + b"\r\n"
            for one in chosen
        )
        return browser.ask("POST", "/marked", parts + sent["body"], sent["headers"])

    assert send("tag", "odd, loud", ids[:3]).status == 303
    assert [lab.get(f"trials/{one}").content["tags"] for one in ids[:4]] == [["odd", "loud"]] * 3 + [[]]
    tagged = page(lab, f"{AT}?tag=odd&all=true")
    assert len(re.findall(r'aria-label="Choose trial', tagged)) == 3
    assert send("exclude", "", ids[3:5]).status == 422, "a reason is needed"
    assert send("exclude", "loose screw", ids[3:5]).status == 303
    reasons = [lab.get(f"trials/{one}").content["excluded"] for one in ids]
    assert reasons == [None] * 3 + ["loose screw"] * 2 + [None]
    assert send("exclude", "again", [*ids[:1], "nothing"]).status == 404
    assert lab.get(f"trials/{ids[0]}").content["excluded"] is None, "all are looked for before one is excluded"
    assert send("overlay", "", ids[:2]).headers["location"] == f"/overlay?trial={ids[0]}&trial={ids[1]}"


def test_the_list_of_jobs_says_how_long_each_took_and_what_it_did(lab, logs):
    broken = ("broken.csv", b"# device: falcon\n# experiment: 1\ntime_s,command,position\n")
    _, job = lab.upload([broken, ("broken2.csv", broken[1] + b"0,0,0\n")])
    assert len(job["result"]["quarantined"]) == 2
    lab.all_done()
    text = page(lab, "/jobs")
    row = re.search(r"<tr><th scope=\"row\"><a href=\"/jobs/[^\"]*\">Ingest of logs.*?</tr>", text, re.DOTALL)[0]
    assert re.search(r"<td>\d+ s</td>", row)
    assert " refused: " in row

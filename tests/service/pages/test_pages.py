"""Pages show what the API tells, escape what logs and people say, and take forms of their own only."""

import html
import re
from pathlib import Path
from urllib.parse import parse_qs, urlencode, urlsplit

import pytest
from served import HTML, Browser, form, page, serving

from pipeline.service.database import Database
from pipeline.service.settings import Settings

PAGES = ("/", "/devices/falcon", "/devices/falcon/experiments/1", "/trials?sort=-stiffness", "/compare?runs=falcon/1",
         "/upload", "/jobs", "/quarantine", "/reports", "/audit", "/api", "/login", "/nothing")  # fmt: skip


@pytest.mark.parametrize("path", PAGES)
def test_pages_need_no_script_and_no_other_server(served, path):
    text = page(served, path)
    assert text.rstrip().endswith("</html>")
    assert re.findall(r"<script(?! src=\"/static/service.js\" defer>)", text) == []
    assert re.findall(r"style=|javascript:|\son\w+=|(?:src|href)=\"(?:https?:)?//", text) == []
    assert len(re.findall("<h1>", text)) == 1


def test_the_experiment_page_has_the_numbers_of_the_api(served, falcon):
    estimate = served.get("experiments/falcon/1/estimates").content["mass"]
    text = page(served, "/devices/falcon/experiments/1")
    row = re.search(r"<th scope=\"row\">mass m</th>.*?</tr>", text)[0]
    value, percent = (float(word) for word in re.findall(r"\d[\d.]*(?=[< ])", row))
    assert value == pytest.approx(estimate["value"], rel=1e-4)
    assert 1 - percent / 100 <= estimate["low"] / estimate["value"] <= 1 <= estimate["high"] / estimate["value"]
    assert estimate["high"] / estimate["value"] <= 1 + percent / 100
    trials = falcon.stages("1").trials.num_rows
    # those behind no wall lie beyond the axes
    assert 0.9 * trials <= text.count('class="hit"') <= trials
    assert "limit by theory" in text


def test_lists_turn_pages_and_keep_their_state(served):
    first = page(served, "/trials?sort=-stiffness&verdict=stable")
    assert '<option value="stable" selected>' in first
    following = html.unescape(re.search(r'href="(\?[^"]*cursor[^"]*)" rel="next"', first)[1])
    second = page(served, f"/trials{following}")
    ids = [re.findall(r'href="/trials/(\w{16})"', text) for text in (first, second)]
    assert len(ids[0]) == 100
    assert set(ids[0]) & set(ids[1]) == set()
    whole = served.get("trials?sort=-stiffness&verdict=stable&limit=1000").content["items"]
    assert [t["id"] for t in whole] == ids[0] + ids[1]
    lines = page(served, "/trials?sort=-stiffness&verdict=stable&format=csv").splitlines()
    assert [line.split(",")[0] for line in lines[1:]] == ids[0]
    empty = page(served, "/trials?q=&device=&stiffness_min=&sort=id")
    assert "trials." in empty


def test_a_trial_page_offers_its_samples(served):
    trial = served.get("trials?limit=1").content["items"][0]["id"]
    text = page(served, f"/trials/{trial}")
    links = re.findall(r'href="(/api/v1/trials/\w+/samples\?format=\w+)"', text)
    assert len(links) == 4
    for link in links:
        assert served.get(link).headers["content-disposition"].startswith("attachment")


def test_a_trial_page_draws_theory_and_fits_once(served):
    trial = served.get("trials?limit=1&verdict=stable&sort=-stiffness").content["items"][0]["id"]
    first = page(served, f"/trials/{trial}")
    # a worker that has the experiment draws while the page waits for it
    assert ("<svg" in first) != ('<meta name="reload"' in first)
    assert 'http-equiv="refresh"' not in first, "it would drop unsaved notes"
    served.all_done()
    job = served.get("jobs?limit=1").content["items"][0]["id"]
    drawn = page(served, f"/trials/{trial}")
    assert drawn.count("<svg") == 3
    for word in ("theory", "fitted loop", "residual [", "simulated", "Logged command", "Outcome:"):
        assert word in drawn, word
    assert '<meta name="reload"' not in drawn
    assert "style=" not in drawn
    page(served, f"/trials/{trial}")
    assert served.get("jobs?limit=1").content["items"][0]["id"] == job


def test_a_read_only_server_says_what_was_not_drawn(falcon, tmp_path):
    with serving(Settings(falcon.processed, tmp_path / "reports", read_only=True)) as client:
        trial = client.get("trials?limit=1").content["items"][0]["id"]
        text = page(client, f"/trials/{trial}")
        assert "samples?format=csv" in text
        assert "cannot be drawn: This result has not been computed yet" in text
        assert "cannot be computed because the server is read-only." in text
        # theory needs no store
        assert client.get("theory/optimum?delay=2&criterion=overshoot").content["cost"] == pytest.approx(0.0, abs=1e-6)


def test_what_is_not_there_is_a_page(served):
    for path in ("/trials/none", "/devices/none", "/devices/falcon/experiments/9", "/jobs/none", "/static/none"):
        answer = served.get(path, **HTML)
        assert answer.status == 404
        assert b"<h1>Not found</h1>" in answer.content
    assert served.get("/compare?runs=a,b,c", **HTML).status == 422
    assert served.get("/trials?stiffness_min=high", **HTML).status == 422


def test_forms_of_a_browser(tmp_path, logs):
    with serving(Settings(tmp_path / "processed", tmp_path / "reports")) as client:
        browser = Browser(client)
        sent = form(logs[:2], form=browser.token("/upload"), profile="")
        answer = browser.ask("POST", "/upload", sent["body"], sent["headers"])
        assert answer.status == 303
        assert client.done(answer.headers["location"].rpartition("/")[2])["result"]["ingested"] == 2
        forged = form(logs[2:4], form="0" * 64)
        assert browser.ask("POST", "/upload", forged["body"], forged["headers"]).status == 403
        assert Browser(client).ask("POST", "/upload", sent["body"], sent["headers"]).status == 403
        assert len(list((tmp_path / "processed-service" / "logs").iterdir())) == 1
        at, path = "/devices/falcon/experiments/1", "experiments/falcon/1"
        for kind, said in (("notes", {"text": "stiff\r\nspring"}), ("tags", {"tags,": "a, b,,"})):
            answer = browser.do(at, "PUT", f"{path}/{kind}", **said)
            assert (answer.status, answer.headers["location"]) == (303, at)
        late = browser.do(at, "PUT", f"{path}/notes", match='"old"', text="late")
        assert (late.status, b"changed this text in the meantime" in late.content) == (412, True)
        assert client.get("experiments/falcon/1/notes").content["text"] == "stiff\nspring"
        assert client.get("experiments/falcon/1/tags").content["tags"] == ["a", "b"]
        compare = ("/do", "/upload")
        for asked, status in (
            ({"method": "PUT", "path": "trials/none/notes", "text": ""}, 404),
            ({"method": "PUT", "path": "nothing"}, 404),
            ({"method": "TRACE", "path": "trials"}, 405),
            ({"method": "POST", "path": "comparisons", "device": "nobody"}, 404),
            ({"method": "POST", "path": "comparisons"}, 422),
            ({"method": "POST", "path": "comparisons", "device": "falcon", "criteria[]": "beauty"}, 422),
        ):
            answer = browser.send(*compare, **asked)
            assert (answer.status, b"<h1>" in answer.content) == (status, True), asked
        sent = urlencode({"form": "0" * 64, "method": "DELETE", "path": "devices/falcon"})
        kind = {"Content-Type": "application/x-www-form-urlencoded"}
        assert browser.ask("POST", "/do", sent, kind).status == 403, "forged"
        for away in ("//evil.example", "https://evil.example", "/\\evil.example"):
            sent = browser.send(*compare, method="PUT", path=f"{path}/notes", text="x", next=away)
            assert sent.headers["location"] == "/"


def test_a_login(tmp_path):
    settings = Settings(tmp_path / "processed", tmp_path / "reports", host="0.0.0.0")
    token = Database(settings.data).create_token("viewer", "")
    with serving(settings) as client:
        browser = Browser(client)
        answer = browser.ask("GET", "/")
        assert (answer.status, answer.headers["location"]) == (303, "/login")
        assert browser.send("/login", "/login", secret="hp_wrong").status == 401
        assert browser.send("/login", "/login", secret=token).status == 303
        assert browser.ask("GET", "/").status == 200
        for method in ("POST", "DELETE"):
            assert browser.send("/do", "/", method=method, path="comparisons", device="x").status == 403
        session = dict(browser.cookies)["pipeline-session"].value
        assert browser.send("/logout", "/").status == 303
        assert client.get("devices", Cookie=f"pipeline-session={session}").status == 401


AWAY = ("//evil.example", "https://evil.example/", "/\\evil.example", "/\t/evil.example", "javascript:x", "", "x")


def test_a_login_leads_to_the_page_that_was_asked_for(tmp_path):
    settings = Settings(tmp_path / "processed", tmp_path / "reports", host="0.0.0.0")
    token = Database(settings.data).create_token("viewer", "")
    named, wanted = "/devices/new%20rig/experiments/%C3%BC%252F1", "/trials?q=a%2Fb&sort=-stiffness"
    with serving(settings) as client:
        browser = Browser(client)
        for path in (named, wanted):
            answer = browser.ask("GET", path)
            assert answer.status == 303
            door = answer.headers["location"]
            assert parse_qs(urlsplit(door).query)["next"] == [path]
        assert door.startswith("/login?")
        assert browser.send(door, door, secret="hp_wrong").status == 401
        assert browser.send(door, door, secret=token).headers["location"] == wanted
        assert browser.ask("GET", wanted).status == 200
        for address in AWAY:
            door = f"/login?{urlencode({'next': address})}"
            assert "evil" not in page(client, door)
            assert browser.send(door, door, secret=token).headers["location"] == "/", address


@pytest.mark.browser
def test_figures_of_a_served_report_are_saved(chromium, served, compared):
    tab = chromium.new_page()
    tab.goto(f"http://127.0.0.1:{served.port}/api/v1/comparisons/{compared[2]}/report")
    for name, begins in (("CSV", b""), ("SVG", b"<svg")):
        with tab.expect_download(timeout=60_000) as saving:
            tab.get_by_role("button", name=re.compile(rf"as {name}$")).first.click()
        content = Path(saving.value.path()).read_bytes()
        assert saving.value.suggested_filename.endswith(f".{name.lower()}")
        assert content.startswith(begins)
        assert len(content) > 100

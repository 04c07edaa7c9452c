"""A page that waits for a result does not load itself again while a form on it has unsaved text; in Chromium."""

import json
import time

import pytest
from served import serving
from wall_logs import named_logs, profile_text

from pipeline.service import documents
from pipeline.service.database import Database
from pipeline.service.settings import Settings

pytestmark = [pytest.mark.slow, pytest.mark.browser]

TEXTS = {
    "trial": "textarea[name=text]",
    "experiment": "form:has(textarea) textarea",
    "device": "input[name=device]:not([type=hidden])",
}
FAILED = "no figure today"


class Lab:
    """A server with two trials, of which no result is ever computed until `end` says why."""

    def __init__(self, client):
        self.client, self.place = client, f"http://127.0.0.1:{client.port}"
        self.database = Database(client.settings.data)
        (self.trial, *_) = (item["id"] for item in client.get("trials").content["items"])
        of = ["bench", "1"]
        self.pages = {
            "trial": (f"/trials/{self.trial}", "drawing", {"what": "trials", "places": [[*of, self.trial]]}),
            "experiment": ("/devices/bench/experiments/1", "experiment", documents.whole(*of)),
            "device": ("/devices/bench", "drawing", {"what": "limits", "places": [of], "plane": "physical"}),
        }
        for _, kind, request in self.pages.values():
            key = documents.key_of(client.settings, request)
            with self.database.transaction():
                job = self.database.add_job(kind, {"key": key, "request": request}, key)
                self.database.run("UPDATE jobs SET state = 'running', owner = 'x', lease = 1e18 WHERE id = ?", job)

    def begin(self):
        """Let all pages wait, without notes."""
        self.database.run("UPDATE jobs SET state = 'running', problem = NULL WHERE owner = 'x'")
        self.client.ask("PUT", f"trials/{self.trial}/notes", document={"text": ""})

    def end(self):
        """End all that is waited for."""
        problem = json.dumps({"title": "x", "status": 503, "detail": FAILED})
        self.database.run(
            "UPDATE jobs SET state = 'failed', problem = ?, changed = ? WHERE owner = 'x'", problem, time.time()
        )


@pytest.fixture(scope="module")
def served_lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unsaved")
    with serving(Settings(folder / "processed", folder / "reports", renew=False)) as client:
        client.ask("PUT", "profiles/lab", document={"profile": profile_text()})
        client.upload(named_logs(2), profile="lab")
        client.all_done()
        yield Lab(client)


@pytest.fixture
def lab(served_lab):
    served_lab.begin()
    return served_lab


@pytest.fixture
def opened(chromium, lab):
    """Call it with the name of a page: the page in the browser, what was loaded, and the questions of the browser."""
    contexts = []

    def of(name, **options):
        contexts.append(chromium.new_context(**options))
        page = contexts[-1].new_page()
        page.set_default_timeout(20_000)
        page.loads, page.questions = [], []
        address = lab.place + lab.pages[name][0]
        page.on("framenavigated", lambda frame: page.loads.append(frame.url))
        page.on("dialog", lambda dialog: (page.questions.append(dialog.type), dialog.dismiss()))
        page.goto(address)
        page.loads.clear()
        return page

    yield of
    for context in contexts:
        context.close()


@pytest.mark.parametrize("name", TEXTS)
def test_a_page_waits_for_unsaved_text_and_then_shows_the_result(lab, opened, name):
    page, field = opened(name), TEXTS[name]
    assert page.locator("meta[name=reload]").count() == 1
    before = page.input_value(field)
    page.fill(field, "slipped twice")
    page.evaluate("document.activeElement.blur()")
    lab.end()
    page.wait_for_selector("#reload-notice")
    page.wait_for_timeout(4000)
    assert page.input_value(field) == "slipped twice"
    assert FAILED not in page.inner_text("main")
    page.fill(field, before)
    page.evaluate("document.activeElement.blur()")
    page.locator("main", has_text=FAILED).wait_for()
    assert page.locator("#reload-notice").count() == 0
    assert page.loads == []


def test_a_field_in_use_is_not_taken_away(lab, opened):
    page = opened("trial")
    page.click(TEXTS["trial"])
    lab.end()
    page.wait_for_selector("#reload-notice")
    page.keyboard.type("slip")
    page.wait_for_timeout(2500)
    page.keyboard.type("ped")
    assert page.input_value(TEXTS["trial"]) == "slipped"


def test_text_that_is_typed_while_the_new_page_is_on_its_way_stays(lab, opened):
    page = opened("trial")

    def late(route):
        answer = route.fetch()
        page.fill(TEXTS["trial"], "typed meanwhile")
        route.fulfill(response=answer)

    page.route(f"**/trials/{lab.trial}", late)
    lab.end()
    page.wait_for_selector("#reload-notice")
    page.wait_for_timeout(1500)
    assert page.input_value(TEXTS["trial"]) == "typed meanwhile"
    assert FAILED not in page.inner_text("main")


def test_without_scripts_a_page_with_fields_stays(lab, opened):
    page = opened("trial", java_script_enabled=False)
    page.fill(TEXTS["trial"], "slipped")
    page.wait_for_timeout(4500)
    assert page.loads == []
    assert page.input_value(TEXTS["trial"]) == "slipped"
    assert "reload it manually" in page.inner_text("main")


def test_another_form_is_not_sent_over_unsaved_text_without_a_question(lab, opened):
    page = opened("trial")
    page.click(TEXTS["trial"])
    page.keyboard.type("slipped")
    page.fill("input[name='tags,']", "check")
    page.click("text=Save tags")
    page.wait_for_timeout(1000)
    assert page.questions == ["beforeunload"]
    assert page.input_value(TEXTS["trial"]) == "slipped"
    page.fill("input[name='tags,']", "")
    page.click("text=Save notes")
    page.wait_for_timeout(1000)
    assert page.questions == ["beforeunload"]
    assert lab.client.get(f"trials/{lab.trial}/notes").content["text"] == "slipped"

"""What people say of trials: notes, tags and exclusions, in pages, by REST and in reports."""

from pathlib import Path

import pytest
from served import Browser, page

from pipeline.base.disk import writing
from pipeline.service.rest import remarks
from pipeline.shell.verify import verify

WHY = "gripper slipped"
TWO = {"device": "falcon", "experiments": ["2"], "criteria": ["overshoot"]}


def verdicts(client):
    return {t["id"]: t["verdict"] for t in client.get("trials?limit=1000").content["items"]}


@pytest.mark.slow
def test_an_excluded_trial_is_used_for_nothing_until_it_is_used_again(three):
    before = verdicts(three)
    trial = three.get("trials?device=falcon&experiment=2").content["items"][0]["id"]
    path = f"trials/{trial}/exclusion"
    assert three.get(path).content == {"excluded": {}}
    key = three.ask("POST", "comparisons", document=TWO).content["key"]
    assert three.ask("PUT", path, document={"reason": f" {WHY}\n"}).content == {"excluded": {trial: WHY}}
    three.all_done()
    assert verdicts(three) == before | {trial: "excluded"}
    shown = three.get(f"trials/{trial}").content
    assert (shown["excluded"], shown["costs"]) == (WHY, {})
    assert three.get("trials?verdict=excluded").content["total"] == 1
    assert three.get("experiments/falcon/2/exclusion").content == {"excluded": {trial: WHY}}
    for address in (f"/trials/{trial}", "/devices/falcon/experiments/2"):
        assert WHY in page(three, address)
    again = three.ask("POST", "comparisons", document=TWO).content["key"]
    assert again != key
    assert three.ask("PUT", path, document={"reason": None}).content == {"excluded": {}}
    assert three.ask("PUT", path, document={"reason": None}).status == 200
    three.all_done()
    assert verdicts(three) == before


@pytest.mark.slow
def test_all_of_an_experiment(three):
    before = verdicts(three)
    browser, at = Browser(three), "/devices/new%20rig/experiments/1"
    path = "experiments/new%20rig/1/exclusion"
    assert browser.do(at, "PUT", path, reason=" ").status == 422
    answer = browser.do(at, "PUT", path, reason=WHY)
    assert (answer.status, answer.headers["location"]) == (303, at)
    three.all_done()
    jobs = three.get("jobs").content["items"]
    assert next(job["result"]["failed"] for job in jobs if job["kind"] == "stages") == {}
    (found,) = three.get("experiments?device=new%20rig").content["items"]
    assert found["verdicts"] == {"excluded": 8}
    answer = three.get("experiments/new%20rig/1/estimates")
    assert (answer.status, "excluded manually" in answer.content["detail"]) == (409, True)
    assert "excluded manually" in page(three, at)
    assert three.ask("POST", "comparisons", document={"device": "new rig"}).status == 409
    assert three.ask("POST", "comparisons", document=TWO).status in (200, 202), "others are compared"
    assert browser.do(at, "PUT", path).status == 303
    three.all_done()
    assert verdicts(three) == before
    assert three.get("experiments/new%20rig/1/exclusion").content == {"excluded": {}}


@pytest.mark.parametrize("document", [{"reason": ""}, {"reason": "  "}, {}, {"reason": 1}, {"why": "x"}])
def test_an_exclusion_has_a_reason(three, document):
    trial = three.get("trials?limit=1").content["items"][0]["id"]
    assert three.ask("PUT", f"trials/{trial}/exclusion", document=document).status == 422
    assert three.get(f"trials/{trial}/exclusion").content == {"excluded": {}}
    assert three.ask("PUT", "trials/none/exclusion", document={"reason": WHY}).status == 404


def test_while_others_write_an_exclusion_is_refused_and_said(three, monkeypatch):
    monkeypatch.setattr(remarks, "CORRECT_S", 0.0)
    trial = three.get("trials?limit=1").content["items"][0]["id"]
    with writing(three.settings.processed, 1.0, None):
        answer = three.ask("PUT", f"trials/{trial}/exclusion", document={"reason": WHY})
    assert answer.status == 503
    assert three.get(f"trials/{trial}/exclusion").content == {"excluded": {}}


@pytest.mark.slow
def test_reports_repeat_what_people_said_and_can_be_verified(three):
    trials = [t["id"] for t in three.get("trials?device=falcon&experiment=1").content["items"]]
    asked = {"device": "falcon", "experiments": ["1"], "criteria": ["overshoot"]}
    said = {
        "experiments/falcon/1/notes": ({"text": "new <b>grease</b>"}, {"text": ""}),
        "experiments/falcon/1/tags": ({"tags": ["summer"]}, {"tags": []}),
        f"trials/{trials[0]}/notes": ({"text": "cable & plug"}, {"text": ""}),
        f"trials/{trials[1]}/exclusion": ({"reason": WHY}, {"reason": None}),
        "experiments/falcon/2/notes": ({"text": "not of this report"}, {"text": ""}),
    }
    for path, (document, _) in said.items():
        assert three.ask("PUT", path, document=document).status == 200
    answer = three.ask("POST", "comparisons", document=asked).content
    assert three.done(answer["job"])["state"] == "done"
    document = three.get(f"comparisons/{answer['key']}").content
    own = {"experiment": "1", "trial_id": None, "tags": ["summer"], "text": "new <b>grease</b>"}
    assert document["notes"] == [own, {"experiment": "1", "trial_id": trials[0], "tags": [], "text": "cable & plug"}]
    report = three.get(f"comparisons/{answer['key']}/report").content.decode()
    for text in ("new &lt;b&gt;grease&lt;/b&gt;", "summer", "cable &amp; plug", WHY, trials[0], trials[1]):
        assert text in report, text
    assert "not of this report" not in report
    assert "<b>grease" not in report
    told = page(three, "/devices/falcon/experiments/1")
    assert "cable &amp; plug" in told
    assert "not of this report" not in told
    assert "not of this report" in page(three, "/devices/falcon/experiments/2")
    file = Path(three.settings.comparisons / f"{answer['key']}.html")
    assert verify(file, three.settings.processed).differences == ()
    assert three.ask("POST", "comparisons", document=asked).content == {"key": answer["key"]}
    for path, (_, empty) in said.items():
        assert three.ask("PUT", path, document=empty).status == 200
    assert three.ask("POST", "comparisons", document=asked).content["key"] != answer["key"]
    three.all_done()

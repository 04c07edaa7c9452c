"""A profile whose sample contradicts the wall law is kept only once it is corrected, or confirmed in words."""

import html
import re
import tomllib
from urllib.parse import urlencode

import pytest
from served import Browser, form
from wall_logs import profile_text, wall_log

WORDS = "The amplifier doubles the command; the gain was measured on 3 June."
FORM = {"Content-Type": "application/x-www-form-urlencoded"}


def draft(client, *logs):
    files = logs or [("K2.5_B6.txt", wall_log(2500.0, 6.0).encode())]
    answer = client.ask("POST", "profiles/draft", **form(files))
    assert answer.status == 200, answer.content
    return answer.content["sample"]


def put(client, text, **more):
    return client.ask("PUT", "profiles/lab", document={"profile": text, **more})


def entries(client):
    return [e["what"] for e in client.get("audit").content["items"] if e["did"] == "kept a profile"]


FIXED = profile_text().replace("_B(?P<damping>[0-9]+[.,]?[0-9]*)", "_B")
FIXED = FIXED.replace("[constants]", "[constants]\ndamping = 60")
CONTRADICTIONS = {
    "stiffness": (profile_text(unit="N/m"), "stiffness 2500", "stiffness 2.5 N/m"),
    "damping": (FIXED, "damping 6", "damping 60 Ns/m"),
    "step": (profile_text(step=2.0), "step 8", "step 2 N"),
}


@pytest.mark.sampled
@pytest.mark.parametrize("kind", CONTRADICTIONS)
def test_rest_refuses_a_contradiction_and_says_what_was_expected_and_found(empty, kind):
    text, obeyed, stated = CONTRADICTIONS[kind]
    sample = draft(empty)
    answer = put(empty, text, sample=sample)
    assert answer.status == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert "K2.5_B6.txt" in answer.content["where"]
    assert stated in answer.content["expected"][0]
    assert f"the command follows {obeyed}" in answer.content["found"][0]
    assert obeyed in answer.content["detail"]
    assert empty.get("profiles/lab").status == 404
    assert put(empty, text, sample=sample, confirmation="  ").status == 422
    assert entries(empty) == []


def test_a_resolved_contradiction_is_kept(empty):
    sample = draft(empty)
    assert put(empty, profile_text(unit="N/m"), sample=sample).status == 422
    assert put(empty, profile_text(), sample=sample).status == 200
    assert empty.get("profiles/lab").content == {"profile": profile_text()}
    (entry,) = entries(empty)
    assert (set(entry), entry["name"], len(entry["version"])) == ({"name", "version"}, "lab", 64)


def test_a_confirmation_is_kept_with_the_profile_and_in_the_audit(empty):
    sample, text = draft(empty), profile_text(unit="N/m")
    words = WORDS + '\n[constants]\nstep = 1\x00 "'
    answer = put(empty, text, sample=sample, confirmation=words)
    assert answer.status == 200, answer.content
    kept = empty.get("profiles/lab").content["profile"]
    assert answer.content["profile"] == kept
    assert WORDS in kept
    assert "the command follows stiffness 2500" in kept
    assert tomllib.loads(kept) == tomllib.loads(text), "words are remarks alone"
    (entry,) = entries(empty)
    assert entry["confirmed"].startswith(WORDS)
    assert "stiffness 2500" in entry["contradictions"][0]
    page = empty.get("/audit", Accept="text/html").content.decode()
    assert html.escape(WORDS) in page


def test_a_confirmation_without_a_contradiction_leaves_the_profile_as_it_is(empty):
    assert put(empty, profile_text(), sample=draft(empty), confirmation=WORDS).status == 200
    assert empty.get("profiles/lab").content == {"profile": profile_text()}
    assert "confirmed" not in entries(empty)[0]


@pytest.mark.slow
def test_every_log_of_a_sample_counts(empty):
    logs = [(f"K{k}_B6.txt", wall_log(1e3 * k, 6.0).encode()) for k in (1.5, 2.5)]
    wrong = ("K2.0_B6.txt", wall_log(3000.0, 6.0).encode())
    answer = put(empty, profile_text(), sample=draft(empty, *logs, wrong))
    assert (answer.status, answer.content["where"]) == (422, "K2.0_B6.txt")
    assert put(empty, profile_text(), sample=draft(empty, *logs)).status == 200


def test_without_a_sample_the_request_is_as_before(empty):
    assert put(empty, profile_text(unit="N/m")).status == 200
    assert put(empty, profile_text(unit="N/m"), sample="0" * 16).status == 404
    assert put(empty, profile_text(unit="N/m"), sample="x").status == 422


def sent(browser, **fields):
    body = urlencode({"form": browser.token("/upload"), **fields})
    return browser.ask("POST", "/profile", body, FORM)


@pytest.mark.slow
def test_the_form_keeps_nothing_until_the_contradiction_is_confirmed(empty):
    browser, sample, text = Browser(empty), draft(empty), profile_text(unit="N/m")
    fields = {"sample": sample, "profile": text, "name": "lab"}
    tried = sent(browser, **fields, act="try").content.decode()
    assert 'name="confirmation"' in tried
    assert "contradicts the wall" in tried
    refused = sent(browser, **fields, act="keep")
    page = html.unescape(refused.content.decode())
    assert (refused.status, 'name="confirmation"' in page) == (200, True)
    assert "the profile states stiffness 2.5 N/m" in page
    assert "the command follows stiffness 2500" in page
    assert re.search(r'<textarea[^>]*>name = "lab"', page), "the text is still there"
    assert empty.get("profiles/lab").status == 404
    kept = sent(browser, **fields, act="keep", confirmation=WORDS)
    assert (kept.status, kept.headers["location"]) == (303, "/upload?profile=lab")
    assert WORDS in empty.get("profiles/lab").content["profile"]
    assert entries(empty)[0]["confirmed"] == WORDS


@pytest.mark.slow
def test_the_form_keeps_a_profile_that_agrees_without_a_question(empty):
    browser, fields = Browser(empty), {"sample": draft(empty), "profile": profile_text(), "name": "lab"}
    assert 'name="confirmation"' not in sent(browser, **fields, act="try").content.decode()
    assert sent(browser, **fields, act="keep").status == 303


def test_the_form_of_a_sample_that_is_gone_asks_for_words(empty):
    browser, fields = Browser(empty), {"sample": "0" * 16, "profile": profile_text(), "name": "lab", "act": "keep"}
    page = sent(browser, **fields).content.decode()
    assert "The sample is no longer stored" in page
    assert 'name="confirmation"' in page
    assert sent(browser, **fields, confirmation=WORDS).status == 303
    assert entries(empty)[0]["confirmed"] == WORDS

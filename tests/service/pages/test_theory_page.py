"""The explorer on a page of the service: of its own files, under the policy of all pages."""

import json
import re

import pytest
from served import page

from pipeline.explorer.page import script


def test_the_page_begins_with_each_known_device(served):
    text = page(served, "/theory")
    assert '<a href="/theory" aria-current="page">Theory</a>' in text
    entries = json.loads(re.search(r'<script type="application/json" id="explorer-entries">(.*?)</script>', text)[1])
    assert "Novint Falcon, 1" in [entry["label"] for entry in entries]
    assert re.findall(r"<script(?! (?:src=\"/static/|type=\"application/json\"))", text) == []
    assert page(served, "/static/explorer.js") == script()
    assert ".what-if" in page(served, "/static/explorer.css")


@pytest.mark.slow
@pytest.mark.browser
def test_it_is_computed_under_the_policy_of_the_service(chromium, served):
    tab = chromium.new_page()
    complaints = []
    tab.on("console", lambda message: complaints.append(message.text))
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.goto(f"http://127.0.0.1:{served.port}/theory")
    tab.get_by_label("device", exact=True).select_option(label="Novint Falcon, 1")
    tab.get_by_text("13,629 N/m at B = 104.4 Ns/m").wait_for()
    tab.locator(".what-if .bar").first.wait_for()
    assert complaints == []
    tab.close()

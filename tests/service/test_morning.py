"""A lab's morning in Chromium: a shared link, own logs described, verdicts, three trials, a report and the way back."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from served import serving
from test_colleague import own_layout

from pipeline.service.database import Database
from pipeline.service.settings import Settings

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture
def page():
    if CHROMIUM is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started.new_page()
        started.close()


def dropped(page, form: str, files: list[Path]) -> None:
    """Drop files on the field of a form."""
    page.locator(f"{form} input[type=file]").set_input_files([str(file) for file in files])
    page.locator(f"{form} button").click()


@pytest.mark.slow
def test_a_morning_in_a_browser(page, logs, tmp_path):
    settings = Settings(tmp_path / "processed", tmp_path / "reports", host="0.0.0.0", renew=False)
    token = Database(settings.data).create_token("admin", "Ada")
    files, faults = [], []
    for _, data in logs:
        told, text = own_layout(data)
        files.append(tmp_path / f"K{told['stiffness']}_B{told['damping']}.csv")
        files[-1].write_bytes(text)
    page.on("pageerror", lambda error: faults.append(str(error)))
    with serving(settings) as client:
        place = f"http://127.0.0.1:{client.port}"
        page.goto(f"{place}/upload?x=1")
        page.fill("input[name=secret]", token)
        page.click("main button")
        page.wait_for_url(f"{place}/upload?x=1")
        # a layout of the lab's own: asked, tried, kept
        dropped(page, "form[action='/draft']", files[:1])
        page.wait_for_selector("textarea", state="attached", timeout=60_000)
        page.locator("details").evaluate("part => { part.open = true }")
        page.fill("textarea", re.sub(r'^name = ".*"', 'name = "rig"', page.input_value("textarea"), flags=re.MULTILINE))
        given = {"constants.device": "rig", "constants.step": told["step"], "columns.command.name": "force"}
        for label in page.locator("label:has(input[name^=answer])").all():
            key = label.locator("code").inner_text()
            if key in given:
                label.locator("input").fill(given[key])
        page.fill("input[name=name]", "rig")
        page.click("button[value=try]")
        page.wait_for_load_state()
        assert "Refused" not in page.inner_text("main")
        page.click("button[value=keep]")
        page.wait_for_url(f"{place}/upload")
        page.select_option("select[name=profile]", "rig")
        dropped(page, "#upload", files)
        page.wait_for_url(re.compile("/jobs/"))
        known = {"Authorization": f"Bearer {token}"}
        while client.get("trials", **known).content["facets"]["verdict"].keys() <= {"none yet"}:
            page.wait_for_timeout(200)
        # three trials over each other, a report, and the way back without another login
        page.goto(f"{place}/trials?device=rig&experiment=1")
        for box in page.locator("input[name=trial]").all()[:3]:
            box.check()
        page.click("button:has-text('over each other')")
        page.wait_for_selector("main svg", timeout=240_000)
        page.goto(f"{place}/devices/rig")
        page.click("main button:has-text('eport')")
        page.wait_for_load_state()
        while client.get("comparisons", **known).content == []:
            page.wait_for_timeout(500)
        page.goto(f"{place}/reports")
        page.locator("main tbody a").first.click()
        with page.expect_download() as download:
            page.locator("button:has-text('CSV')").first.click()
        assert download.value.suggested_filename.endswith(".csv")
        page.click("a:has-text('All reports')")
        page.wait_for_url(f"{place}/reports")
        page.goto(f"{place}/audit")
        assert "Ada" in page.inner_text("main")
    assert faults == []

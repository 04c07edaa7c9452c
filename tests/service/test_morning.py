"""A lab's morning in Chromium: a shared link, own logs described, verdicts, three trials, last week's, who did what."""

import re

import pytest
from served import drop, serving

from pipeline.service.database import Database
from pipeline.service.settings import Settings

WEEK_47, WEEK_48 = "/devices/rig/experiments/week%2047", "/devices/rig/experiments/week%2048"


def own_layout(data):
    """A native log as the lab's own recorder writes it: other names, units and no header; and what the header told."""
    head, _, rows = data.decode().partition("time_s,command,position\n")
    told = dict(re.findall(r"# (\w+): (\S+)", head))
    cells = [row.split(",") for row in rows.splitlines()]
    lines = [f"{time};{force};{float(position) * 1e3!r}" for time, force, position, *_ in cells]
    return told, "\n".join(["t;force;x_mm", *lines, ""])


@pytest.fixture
def course(logs, tmp_path):
    """A folder with own logs, one of them further down, and a hidden file."""
    folder = tmp_path / "course"
    (folder / "late").mkdir(parents=True)
    (folder / ".hidden").write_text("no log")
    for number, (_, data) in enumerate(logs):
        told, text = own_layout(data)
        name = f"K{told['stiffness']}_B{told['damping']}.txt"
        (folder / ("late" if number == 0 else "") / name).write_text(text)
    return folder


def entered(browser, address, token):
    """Open a link in a browser that knows nobody, and log in."""
    page = browser.new_context().new_page()
    page.set_default_timeout(300_000)
    page.goto(address)
    page.fill("input[name=secret]", token)
    page.click("main button")
    page.wait_for_url(address)
    return page


@pytest.mark.slow
@pytest.mark.browser
def test_a_morning(chromium, logs, course, tmp_path):
    settings = Settings(tmp_path / "processed", tmp_path / "reports", host="0.0.0.0", renew=False)
    ada, ben = (Database(settings.data).create_token(*of) for of in (("admin", "Ada"), ("viewer", "Ben")))
    last = [(name, data.replace(b"device: falcon", b"device: rig").replace(b"experiment: 1", b"experiment: week 47"))
            for name, data in logs]  # fmt: skip
    step, faults = own_layout(logs[0][1])[0]["step"], []
    with serving(settings) as client:
        place, known = f"http://127.0.0.1:{client.port}", {"Authorization": f"Bearer {ada}"}
        plain, client.ask = (
            client.ask,
            lambda *of, **more: plain(*of, **{**more, "headers": {**known, **(more.get("headers") or {})}}),
        )
        client.upload(last)
        page = entered(chromium, place + WEEK_47, ada)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda said: faults.append(said.text) if said.type == "error" else None)

        def dropped(form, then):
            drop(page, f"{form} .drop", course)
            page.get_by_text(f"{len(logs)} files are ready.").wait_for()
            page.click(f"{form} button")
            page.wait_for_url(then)

        # a folder that no profile reads: refused, and said once
        page.goto(f"{place}/upload")
        dropped("#upload", "**/jobs/*")
        page.get_by_text("no profile claims").wait_for()
        assert page.locator("main .banner").count() == 1
        # its layout is described: asked, tried, kept
        page.click("text=describe their layout")
        page.wait_for_url("**/upload#describe")
        dropped("#describe", "**/draft")
        given = {"constants.device": "rig", "constants.experiment": "week 48", "constants.step": step,
                 "columns.command.name": "force"}  # fmt: skip
        for key, value in given.items():
            page.locator("label", has=page.get_by_text(key, exact=True)).locator("input").fill(value)
        page.fill("input[name=name]", "own")
        page.click("button[value=try]")
        page.get_by_text("x_mm [mm]").first.wait_for()
        assert "Refused" not in page.inner_text("main")
        page.click("button[value=keep]")
        page.wait_for_url("**/upload?profile=own")
        # dropped again it is read, what was refused as well
        dropped("#upload", "**/jobs/*")
        page.locator("dl.counts").wait_for()
        assert page.locator("dl.counts dd").all_inner_texts() == [str(len(logs)), str(len(logs)), "0", "0"]
        page.click("text=Quarantine")
        page.get_by_text("0 refused logs").wait_for()
        # verdicts come in, the experiment tells its answer
        while "none yet" in client.get("trials").content["facets"]["verdict"]:
            page.wait_for_timeout(200)
        page.goto(f"{place}/trials?q=Ada&sort=-stiffness")
        assert page.locator("tbody tr").count() == 2 * len(logs)
        page.goto(place)
        page.click("h3 >> text=week 48")
        page.wait_for_url(place + WEEK_48)
        page.locator("main figure svg").wait_for()
        page.get_by_text("Which wall?").wait_for()
        # three trials over each other, one is excluded
        for box in page.locator("input[name=trial]").all()[:3]:
            box.check()
        page.click("text=Overlay the chosen trials")
        page.locator("main figure svg").wait_for()
        page.locator("tbody th a").first.click()
        page.fill("input[name=reason]", "slipped")
        page.click("text=Exclude the trial")
        page.get_by_text("trial was excluded manually").wait_for()
        # compared with last week's; the link is shared
        page.goto(place + WEEK_48)
        page.click(".lead >> text=Compare")
        page.check("text=rig, week 47")
        page.click("main button")
        page.locator("h2", has_text="minus").wait_for()
        page.locator("main figure svg").wait_for()
        guest = entered(chromium, page.url, ben)
        assert guest.locator("h2", has_text="minus").inner_text() == page.locator("h2", has_text="minus").inner_text()
        # a report, its numbers, and the way back without another login
        page.goto(f"{place}/devices/rig")
        page.click("text=Write the report")
        page.click("text=The report")
        with page.expect_download() as download:
            page.locator("button:has-text('CSV')").first.click()
        assert download.value.suggested_filename.endswith(".csv")
        page.click("a:has-text('All reports')")
        page.wait_for_url(f"{place}/reports")
        # who did what
        page.click("text=Who did what")
        deeds = page.locator("tbody tr").all_inner_texts()
    assert re.search(r"Ada\s+excluded", deeds[0])
    assert re.search(r"Ada\s+kept a profile", deeds[1])
    assert "slipped" in deeds[0]
    assert faults == []

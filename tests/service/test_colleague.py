"""A lab's morning in a browser: own logs are described, come in, are looked at, corrected, compared; all is by name."""

import html
import re
from urllib.parse import unquote

import pytest
from served import Browser, form, serving

from pipeline.service.database import Database
from pipeline.service.settings import Settings


def own_layout(data):
    """A native log as the lab's own recorder writes it: other names, units and a header of its own."""
    head, _, rows = data.decode().partition("time_s,command,position\n")
    told = dict(re.findall(r"# (\w+): (\S+)", head))
    lines = [",".join([row.split(",")[0], row.split(",")[1], repr(float(row.split(",")[2]) * 1e3)])
             for row in rows.splitlines()]  # fmt: skip
    return told, ("t,force,x_mm\n" + "\n".join(lines) + "\n").encode()


@pytest.fixture
def lab(tmp_path):
    settings = Settings(tmp_path / "processed", tmp_path / "reports", host="0.0.0.0", wait_s=240.0, renew=False)
    token = Database(settings.data).create_token("admin", "Ada")
    with serving(settings) as client:
        browser = Browser(client)
        answer = browser.send("/login?next=%2Fupload%3Fx%3D1", "/login", secret=token)
        assert (answer.status, answer.headers["location"]) == (303, "/upload?x=1"), "a shared link leads through login"
        client.asked = client.ask
        client.ask = lambda method, path, body=None, headers=None, document=None: client.asked(
            method, path, body, {"Authorization": f"Bearer {token}", **(headers or {})}, document
        )
        browser.client.plain = client.asked
        yield client, browser


def shown(browser, path):
    return html.unescape(browser.ask("GET", path).content.decode())


def test_a_morning(lab, logs):
    client, browser = lab
    told = [own_layout(data)[0] for _, data in logs]
    sent = [
        (f"K{t['stiffness']}_B{t['damping']}.log.csv", own_layout(data)[1])
        for t, (_, data) in zip(told, logs, strict=True)
    ]

    def upload(files, **fields):
        body = form(files, form=browser.token("/upload"), **fields)
        answer = browser.ask("POST", "/upload", body["body"], body["headers"])
        assert answer.status == 303, answer.content
        return client.done(answer.headers["location"].rpartition("/")[2])

    # no profile reads them: refused, and named with who sent them
    job = upload(sent[:1], profile="")
    assert (job["author"], len(job["result"]["quarantined"])) == ("Ada", 1)
    assert "uploaded by Ada" in shown(browser, "/quarantine")
    # one is described, tried and kept
    body = form(sent[:1], form=browser.token("/upload"))
    drafted = html.unescape(browser.ask("POST", "/draft", body["body"], body["headers"]).content.decode())
    assert "open question" in drafted
    sample = re.search(r'name="sample" value="(\w+)"', drafted)[1]
    text = re.search(r"<textarea[^>]*>(.*?)</textarea>", drafted, re.DOTALL)[1].replace(
        'name = "', 'name = "rig" # ', 1
    )
    asked = re.findall(r"<code>([\w.]+)</code>.*?name=\"(answer-\d+)\" value=\"(.*?)\">", drafted)
    given = {"constants.device": "rig", "constants.step": told[0]["step"], "columns.command.name": "force"}
    answers = {field: given.get(key, proposal) for key, field, proposal in asked}
    tried = browser.send("/profile", "/upload", profile=text, sample=sample, name="rig", act="try", **answers)
    tried = html.unescape(tried.content.decode())
    assert "Refused" not in tried, tried
    assert "x_mm [mm]" in tried
    text = re.search(r"<textarea[^>]*>(.*?)</textarea>", tried, re.DOTALL)[1]
    assert browser.send("/profile", "/upload", profile=text, sample=sample, name="rig", act="keep").status == 303
    assert "rig" in client.get("profiles").content
    # the refused one is read again by it, and the others come
    (one,) = client.get("quarantine").content
    answer = browser.do("/quarantine", "POST", f"quarantine/{one['id']}/retry", profile="rig")
    client.done(answer.headers["location"].rpartition("/")[2])
    assert client.get("quarantine").content == []
    job = upload(sent[1:], profile="rig")
    assert job["result"]["ingested"] == len(sent) - 1
    client.all_done()
    items = client.get("trials?q=Ada&sort=-stiffness").content["items"]
    assert [item["uploader"] for item in items] == ["Ada"] * len(sent)
    assert all(item["verdict"] for item in items)
    # the experiment, three trials over each other, one excluded, a device renamed
    at = "/devices/rig/experiments/1"
    client.get("experiments/rig/1/boundary")
    assert "Next wall" in shown(browser, at) or client.all_done()
    three = "&".join(f"trial={item['id']}" for item in items[:3])
    browser.ask("GET", f"/overlay?{three}")
    client.all_done()
    assert "Displacement over time of 3 trials" in shown(browser, f"/overlay?{three}")
    path = f"trials/{items[0]['id']}"
    out = browser.do(f"/{path}", "PUT", f"{path}/exclusion", reason="slipped")
    assert out.status == 303
    for kind, said in (("notes", {"text": "gears greased"}), ("tags", {"tags,": "new"})):
        assert browser.do(at, "PUT", f"experiments/rig/1/{kind}", **said).headers["location"] == at
    moved = browser.do(at, "PATCH", "experiments/rig/1", device="new rig", experiment="1")
    assert unquote(moved.headers["location"]) == "/devices/new rig/experiments/1"
    assert client.get("experiments/new%20rig/1/notes").content["author"] == "Ada"
    assert client.get("trials?q=greased").content["total"] == len(sent)
    done = shown(browser, "/audit")
    for deed in ("kept a profile", "tried again", "excluded", "wrote notes", "moved"):
        assert deed in done
    assert done.count("Ada") >= 5

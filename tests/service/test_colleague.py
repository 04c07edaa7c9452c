"""A colleague's way: upload from the browser, mend what is refused, compare, write a note, move the lab elsewhere."""

import html
import re

import pytest
from served import Browser, form, page, serving

from pipeline.service.backup import backup, restore
from pipeline.service.settings import Settings


def settings_of(folder):
    return Settings(folder / "processed", folder / "reports", wait_s=200.0)


@pytest.mark.slow
def test_a_colleague_s_way(kept, falcon, tmp_path):
    """The lab has a Falcon; 30 logs of a new rig come, two of them damaged."""
    restore(settings_of(tmp_path), kept[0])
    files = sorted(falcon.raw.rglob("*.csv"))[::6][:30]
    logs = {file.name: file.read_bytes().replace(b"# device: falcon", b"# device: new rig") for file in files}
    assert len(logs) == 30
    broken = [*logs][3:5]
    sent = {name: data.replace(b"\n0.01", b"\nzero", 1) if name in broken else data for name, data in logs.items()}
    with serving(settings_of(tmp_path)) as client:
        browser = Browser(client)

        def upload(files):
            body = form(files, form=browser.token("/upload"), profile="")
            answer = browser.ask("POST", "/upload", body["body"], body["headers"])
            assert answer.status == 303
            job = client.done(answer.headers["location"].rpartition("/")[2])
            return job["result"], html.unescape(page(client, answer.headers["location"]))

        result, told = upload([*sent.items()])
        assert (result["ingested"], len(result["quarantined"])) == (28, 2)
        for refused in result["quarantined"]:
            assert refused["path"] in broken
            assert f"{refused['path']}</strong>, row {refused['row']}: {refused['reason']}" in told
        result, _ = upload([(name, logs[name]) for name in broken])
        assert (result["ingested"], result["quarantined"]) == (2, [])
        client.all_done()
        link = "/compare?runs=new%20rig/1&runs=falcon/1"
        client.get("experiments/new%20rig/1/estimates")
        compared = page(client, link)
        assert compared.count("key-mark run-") == 2
        mass = re.search(r'<th scope="row">mass</th>.*?</tr>', compared)[0]
        assert len(re.findall(r"<small>[^<]* to [^<]*</small>", mass)) == 2
        at = "/devices/new%20rig/experiments/1"
        words = {"of": ["experiment", "new rig", "1"], "notes": "gears greased", "tags": "new"}
        assert browser.send("/words", at, **words).status == 303
        backup(settings_of(tmp_path), tmp_path / "lab.zip")
    elsewhere = settings_of(tmp_path / "elsewhere")
    restore(elsewhere, tmp_path / "lab.zip")
    with serving(elsewhere) as client:
        assert page(client, link) == compared
        assert client.get("experiments/new%20rig/1/notes").content == {"text": "gears greased"}
        assert "gears greased" in page(client, at)

"""Reports that were made are made anew when logs have come, once, and without being asked."""

import os
import time

import pytest
from served import page, serving

from pipeline.service.database import KEPT_S, Database
from pipeline.service.settings import Settings
from pipeline.service.workers import remove_old


def comparisons(client):
    """Keys of all reports, the newest first, when no job is left."""
    jobs = client.get("jobs?limit=1000").content["items"]
    if any(job["state"] in ("queued", "running") for job in jobs):
        return []
    assert {job["state"] for job in jobs} == {"done"}
    return [job["result"]["key"] for job in jobs if job["kind"] == "comparison"]


def wait_for(client, number):
    until = time.monotonic() + 240
    while len(found := comparisons(client)) < number:
        assert time.monotonic() < until, found
        time.sleep(0.2)
    return found


@pytest.mark.slow
def test_a_report_follows_the_logs(tmp_path, logs):
    with serving(Settings(tmp_path / "processed", tmp_path / "reports")) as client:
        client.upload(logs[:4])
        client.all_done()
        asked = {"device": "falcon", "criteria": ["overshoot"]}
        first = client.done(client.ask("POST", "comparisons", document=asked).content["job"])["result"]["key"]
        client.upload(logs[4:])
        assert wait_for(client, 2)[1:] == [first]
        new, _ = comparisons(client)
        trials = [client.get(f"comparisons/{key}").content["experiments"][0]["trials"] for key in (first, new)]
        assert trials == [4, 8]
        assert client.ask("POST", "comparisons", document=asked).content == {"key": new}
        listed = page(client, "/reports")
        assert listed.index(new) < listed.index(first)
        assert listed.count('<span class="badge">earlier</span>') == 1
        # an upload of what is there changes nothing
        client.upload(logs[4:])
        client.all_done()
        time.sleep(3)
        assert comparisons(client) == [new, first]


def test_what_ended_long_ago_is_removed_but_for_uploads_and_each_last_report(tmp_path):
    settings = Settings(tmp_path / "processed", tmp_path / "reports")
    database = Database(settings.data)
    settings.comparisons.mkdir(parents=True)
    kinds = {
        "upload": {},
        "stages": {},
        "first": {"asked": 1},
        "last": {"asked": 1},
        "other": {"asked": 2},
        "new": {"asked": 1},
    }
    jobs = {}
    for name, request in kinds.items():
        kind = name if name in ("upload", "stages") else "comparison"
        jobs[name] = database.add_job(kind, request, name)
        database.claim(name)
        database.finish(jobs[name], name, {})
        (settings.comparisons / f"{name}.html").touch()
    long_ago = time.time() - KEPT_S - 1
    for name in kinds.keys() - {"new"}:
        database.run("UPDATE jobs SET changed = ? WHERE id = ?", long_ago, jobs[name])
        os.utime(settings.comparisons / f"{name}.html", (long_ago, long_ago))
    (settings.comparisons / "unknown.html").touch()
    remove_old(settings, database.forget_old())
    assert {name for name, job in jobs.items() if database.job(job) is not None} == {"upload", "other", "new"}
    kept = {file.stem for file in settings.comparisons.iterdir()}
    assert kept == {"upload", "other", "new", "unknown"}, "what is young may be about to be named"

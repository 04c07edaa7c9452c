"""What a lab brings and corrects by REST: profiles, refused logs, names, deletions; walls, figures, theory in SI."""

import json
import subprocess
import sys

import pytest
from served import HTML, form

PROFILE = """name = "own"
format = "native"
files = ["*.own"]
"""


def patch(client, path, **document):
    return client.ask("PATCH", path, document=document)


def test_a_profile_is_kept_by_name_and_sent_by_push(empty, logs, tmp_path):
    assert empty.get("profiles/own").status == 404
    assert empty.ask("PUT", "profiles/own", document={"profile": PROFILE}).status == 200
    assert empty.get("profiles").content[0] == "own"
    assert empty.get("profiles/own").content == {"profile": PROFILE}
    assert empty.ask("PUT", "profiles/other", document={"profile": PROFILE}).status == 200
    assert empty.get("profiles/other").content == {"profile": PROFILE.replace('"own"', '"other"')}
    for name, text in (("native", PROFILE), ("own", PROFILE + "nonsense = 1\n"), ("own", "= ")):
        answer = empty.ask("PUT", f"profiles/{name}", document={"profile": text})
        assert answer.status in (409, 422), answer.content
        assert str(tmp_path) not in json.dumps(answer.content)
    for bad in ("..%2Fx", "a.b", "x" * 65):
        assert empty.ask("PUT", f"profiles/{bad}", document={"profile": PROFILE}).status in (404, 422)
    (tmp_path / "own.toml").write_text(PROFILE.replace('"own"', '"sent"'))
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "a.own").write_bytes(logs[0][1])
    to = ["--to", f"http://127.0.0.1:{empty.port}", "--profile", tmp_path / "own.toml", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "pipeline", "push", tmp_path / "raw", *to], capture_output=True, check=True
    )
    assert json.loads(done.stdout)["ingested"] == 1
    assert empty.get("profiles/sent").status == 200


def test_a_refused_log_is_read_by_another_profile_or_dismissed(empty, logs):
    empty.upload([("a.own", logs[0][1]), ("b.own", b"nothing")])
    refused = {one["name"]: one for one in empty.get("quarantine").content}
    assert set(refused) == {"a.own", "b.own"}
    assert {one["author"] for one in refused.values()} == {"this computer"}
    empty.ask("PUT", "profiles/own", document={"profile": PROFILE})
    both = ",".join(one["id"] for one in refused.values())
    assert empty.ask("POST", f"quarantine/{both}/retry", document={"profile": "none"}).status == 422
    assert empty.ask("POST", f"quarantine/{both},x/retry", document={"profile": "own"}).status == 404
    result = empty.done(empty.ask("POST", f"quarantine/{both}/retry", document={"profile": "own"}).content["job"])[
        "result"
    ]
    assert (result["ingested"], [one["path"] for one in result["quarantined"]]) == (1, ["b.own"])
    which = refused["b.own"]["id"]
    assert empty.ask("DELETE", f"quarantine/{which}").status == 204
    assert empty.get("quarantine").content == []
    assert empty.ask("DELETE", f"quarantine/{which}").status == 404
    # what was dismissed may come again
    _, job = empty.upload([("b.own", b"nothing")])
    assert len(job["result"]["quarantined"]) == 1
    assert [deed["did"] for deed in empty.get("audit").content["items"]] == [
        "dismissed",
        "tried again",
        "kept a profile",
    ]


def test_names_are_mended_and_what_is_deleted_comes_back(three):
    before = [(e["device"], e["experiment"], e["trials"]) for e in three.get("experiments").content["items"]]
    assert three.ask("PUT", "experiments/falcon/2/notes", document={"text": "greased"}).status == 200
    assert patch(three, "experiments/falcon/2", experiment="3").content == {"trials": 8}
    assert three.get("experiments/falcon/2/notes").status == 404
    assert three.get("experiments/falcon/3/notes").content["text"] == "greased"
    assert patch(three, "devices/new%20rig", device="rig/1").content == {"trials": 8}
    assert three.get("experiments?device=rig/1").content["items"][0]["trials"] == 8
    assert patch(three, "devices/none", device="x").status == 404
    assert patch(three, "devices/falcon", name="x").status == 422
    assert three.ask("DELETE", "devices/rig%252F1").content == {"trials": 8}
    assert {one["device"] for one in three.get("bin").content} == {"rig/1"}
    assert three.get("trials?device=rig/1").content["total"] == 0
    assert three.ask("POST", "bin/restore", document={"device": "rig/1"}).content == {"trials": 8}
    assert patch(three, "devices/rig%252F1", device="new rig").status == 200
    assert patch(three, "experiments/falcon/3", experiment="2").status == 200
    three.ask("PUT", "experiments/falcon/2/notes", document={"text": ""})
    three.all_done()
    after = [(e["device"], e["experiment"], e["trials"]) for e in three.get("experiments").content["items"]]
    assert after == before


def test_next_walls_figures_and_theory_in_si(three):
    plan = three.get("plan?device=falcon&experiment=1").content
    assert {"next", "done", "boundary", "trials_used", "trials_expected"} <= set(plan)
    for name in ("limits", "response"):
        figure = three.get(f"figures/falcon/1/{name}.svg")
        assert figure.headers["content-type"] == "image/svg+xml"
        assert figure.content.startswith(b"<svg xmlns=")
        assert b"var(" not in figure.content
    assert three.get("figures/falcon/1/none.svg").status == 404
    # each kind of job has its page
    three.get("/devices/falcon", **HTML)
    done = {job["kind"]: job["id"] for job in three.all_done()}
    assert {"upload", "stages", "plan", "drawing"} <= set(done)
    assert {kind: three.get(f"/jobs/{job}", **HTML).status for kind, job in done.items()} == dict.fromkeys(done, 200)
    boundary = three.get("theory/boundary?device=falcon&experiment=1").content
    assert boundary["stiffness_max"] == pytest.approx(max(boundary["stiffness"]), rel=1e-6)
    (point,) = three.get("theory/points?device=falcon&stiffness=1000&damping=50").content
    assert point["stable"] is True
    for wrong in ("boundary", "boundary?device=falcon&delay=2", "points?device=falcon&stiffness=1", "points?delay=2"):
        assert three.get(f"theory/{wrong}").status == 422
    assert three.get("theory/boundary?device=nobody").status == 404
    best = three.get("theory/optimum?device=falcon&experiment=1&criterion=overshoot").content
    assert (best["device"], best["stiffness"] < boundary["stiffness_max"]) == ("falcon", True)
    assert three.get("theory/optimum?device=nobody&criterion=overshoot").status == 404
    assert three.get("theory/optimum?delay=1&delta=-9&criterion=overshoot").status == 422


def test_a_draft_asks_and_a_preview_shows(empty, logs):
    found = empty.ask("POST", "profiles/draft", **form([("a.txt", b"t;f;x\n" + b"0;1;2\n" * 9)])).content
    assert {"sample", "profile", "questions"} == set(found)
    assert all({"line", "key", "question", "proposal"} == set(each) for each in found["questions"])
    answer = empty.ask("POST", "profiles/preview", document={"sample": found["sample"], "profile": found["profile"]})
    assert (answer.status, "QUESTION" in answer.content["detail"] or "columns" in answer.content["detail"]) == (
        422,
        True,
    )
    tried = {"sample": found["sample"], "profile": PROFILE}
    (sample,) = empty.ask("POST", "profiles/preview", document=tried).content
    assert "matches none of files" in sample["reason"]
    assert sample["path"] == "a.txt"
    assert empty.ask("POST", "profiles/preview", document={"sample": "0" * 16, "profile": PROFILE}).status == 404

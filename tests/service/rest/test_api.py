"""What the API tells of stored trials is what the command line tells."""

import csv
import io
import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline import __version__
from pipeline.records.criteria import REPORTED
from pipeline.store.samples import load_trials


def pages(client, path, limit):
    found, cursor = [], ""
    while True:
        page = client.get(f"{path}limit={limit}{cursor}").content
        assert len(page["items"]) <= limit
        found += page["items"]
        if page["next_cursor"] is None:
            return found
        cursor = f"&cursor={page['next_cursor']}"


def test_health_and_schema(served):
    health = served.get("health").content
    assert (health["state"], health["version"]) == ("ok", __version__)
    paths = served.get("openapi.json").content["paths"]
    assert {"/api/v1/trials/{trial}/samples", "/api/v1/logs", "/api/v1/theory/points"} <= set(paths)


def test_lists_are_those_of_the_store(served, falcon):
    trials = falcon.stages("1").trials
    (device,) = served.get("devices").content["items"]
    assert device == {"device": "falcon", "experiments": 1, "trials": trials.num_rows}
    (experiment,) = served.get("experiments?device=falcon").content["items"]
    verdicts = falcon.stages("1").verdicts.verdict
    assert experiment["verdicts"] == {name: int((verdicts == name).sum()) for name in sorted(set(verdicts))}
    assert served.get("experiments?device=other").content["items"] == []


@pytest.mark.parametrize(
    "sort", ["id", "-id", "stiffness", "-damping", "settle_2pct", "-settle_2pct", "verdict", "-outcome"]
)
def test_pages_hold_each_trial_once_in_order(served, falcon, sort):
    found = pages(served, f"trials?sort={sort}&", 17)
    whole = served.get(f"trials?sort={sort}&limit=1000").content["items"]
    assert [t["id"] for t in found] == [t["id"] for t in whole]
    assert sorted(t["id"] for t in found) == sorted(falcon.stages("1").trials.column("trial_id").to_pylist())
    name = sort.lstrip("-")
    values = [t["costs"].get(name, {}).get("value") if name in REPORTED else t[name] for t in found]
    known = [v for v in values if v is not None]
    assert known == sorted(known, reverse=sort.startswith("-"))
    assert len(known) > 50
    assert all(v is None for v in values[len(known) :])


def test_a_trial_has_verdict_and_costs_of_the_stages(served, falcon):
    stages = falcon.stages("1")
    cost, (low, high) = stages.cost("overshoot")[0], stages.cost_interval("overshoot")
    rows = {name: i for i, name in enumerate(stages.texts("response", "trial_id"))}
    judged = 0
    for trial in served.get("trials?verdict=stable&limit=20").content["items"]:
        row = rows[trial["id"]]
        assert trial["verdict"] == stages.verdicts.verdict[row] == "stable"
        shown = trial["costs"].get("overshoot")
        if np.isnan(cost[row]):
            assert shown is None
            continue
        judged += 1
        assert shown["value"] == cost[row]
        for end, value in (("low", low[row]), ("high", high[row])):
            assert shown[end] == (None if np.isnan(value) else value)
    assert judged > 5


def test_filters_facets_and_search(served, falcon):
    whole = served.get("trials?limit=1000").content
    assert whole["facets"]["device"] == {"falcon": whole["total"]}
    stiff = served.get("trials?stiffness_min=3000&stiffness_max=9000&damping_min=10&verdict=stable&limit=1000").content
    expected = [
        t["id"]
        for t in whole["items"]
        if 3000 <= t["stiffness"] <= 9000 and t["damping"] >= 10 and t["verdict"] == "stable"
    ]
    assert [t["id"] for t in stiff["items"]] == expected
    assert 0 < len(expected) == stiff["total"] < whole["total"]
    one = whole["items"][5]
    (found,) = served.get(f"trials?q={one['id'].upper()}").content["items"]
    assert found["id"] == one["id"]
    assert served.get("trials?device=nobody").content["total"] == 0


@pytest.mark.parametrize(
    ("path", "where"),
    [
        ("trials?sort=rank", "query.sort"),
        ("trials?sort=--id", "query.sort"),
        ("trials?limit=0", "query.limit"),
        ("trials?limit=5000", "query.limit"),
        ("trials?stiffness_min=nan", "query.stiffness_min"),
        ("theory/boundary?delay=1e9", "query.delay"),
        ("theory/points?delay=1&alpha=1&beta=1&beta=2", "alpha, beta"),
    ],
)
def test_wrong_values_are_named(served, path, where):
    answer = served.get(path)
    assert answer.status == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert (answer.content["status"], answer.content["where"]) == (422, where)


@pytest.mark.parametrize("cursor", ["x", "bnVsbA==", "W10=", "W251bGwsIDFd"])
def test_a_foreign_cursor_is_refused(served, cursor):
    from urllib.parse import quote

    assert served.get(f"trials?cursor={quote(cursor)}").status == 400
    assert served.get(f"jobs?cursor={quote(cursor)}").status == 400
    assert served.get("jobs?cursor=%C3%A9").status == 422


def test_samples_in_every_form(served, falcon):
    trials = falcon.stages("1").trials.slice(3, 1)
    (trial,) = load_trials(falcon.processed, trials)
    document = served.get(f"trials/{trial.trial_id}/samples").content
    assert document["units"]["position"] == "m"
    text = served.get(f"trials/{trial.trial_id}/samples", Accept="text/csv").content.decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    parquet = served.get(f"trials/{trial.trial_id}/samples", Accept="application/vnd.apache.parquet").content
    stream = served.get(f"trials/{trial.trial_id}/samples", Accept="application/vnd.apache.arrow.stream").content
    forms = [
        document["columns"],
        {name: [float(row[name]) for row in rows] for name in rows[0]},
        pq.read_table(io.BytesIO(parquet)).to_pydict(),
        pa.ipc.open_stream(stream).read_all().to_pydict(),
    ]
    for columns in forms:
        assert list(columns) == ["time_s", "command", "position"]
        np.testing.assert_array_equal(columns["command"], trial.command)
        np.testing.assert_array_equal(columns["position"], trial.position)
    assert served.get(f"trials/{trial.trial_id}/samples", Accept="image/png").status == 406


MISSING = ("trials/0", "trials/0/samples", "trials/0/notes", "jobs/0", "experiments/falcon/9/optima", "nothing")


@pytest.mark.parametrize("path", [*MISSING, "experiments/other/1/boundary", f"comparisons/{'0' * 16}"])
def test_what_is_not_there_is_a_problem(served, path):
    answer = served.get(path)
    assert answer.status == 404
    assert answer.content["title"] == "Not found"


@pytest.mark.slow
def test_an_experiment_is_as_in_compare(served, falcon_outcome):
    document = falcon_outcome.result.model_dump(mode="json")["experiments"][0]
    for part, name in (("estimates", "estimates"), ("boundary", "boundary"), ("optima", "optimum")):
        answer = served.get(f"experiments/falcon/1/{part}")
        assert answer.status == 200
        assert answer.content == document[name]
    assert all(cause["sentence"] for cause in served.get("experiments/falcon/1/causes").content)


def test_theory_is_that_of_the_commands(served):
    from pipeline.loop.normalised_loop import NormalisedLoop
    from pipeline.theory.cases import Case, best_wall, limits_of_walls

    assert (
        served.get("theory/boundary?delay=2&delta=0.01").content
        == limits_of_walls(Case(NormalisedLoop.ideal(0.0, 0.01, 2.0))).to_json()
    )
    optimum = best_wall(Case(NormalisedLoop.ideal(0.0, 0.0, 1.0)), "settle_2pct", "discrete").to_json()
    assert served.get("theory/optimum?criterion=settle_2pct&delay=1&signal=discrete").content == optimum
    (point,) = served.get("theory/points?delay=1&alpha=0.1&beta=0.4").content
    assert point["stable"] is True
    wrong = served.get("theory/optimum?criterion=best&delay=1")
    assert (wrong.status, "settle_2pct" in wrong.content["detail"]) == (422, True)


@pytest.mark.parametrize("owner", ["trials/{trial}", "experiments/falcon/1"])
def test_notes_and_tags_are_kept(served, owner):
    trial = served.get("trials?limit=1").content["items"][0]["id"]
    path = owner.format(trial=trial)
    assert served.get(f"{path}/notes").content == {"text": "", "author": None, "changed": None}
    assert served.get(f"{path}/tags").content["tags"] == []
    assert served.ask("PUT", f"{path}/notes", document={"text": "<b>stiff</b> ü"}).status == 200
    assert served.ask("PUT", f"{path}/tags", document={"tags": ["check"]}).status == 200
    found = served.get(f"{path}/notes")
    assert (found.content["text"], found.content["author"]) == ("<b>stiff</b> ü", "this computer")
    assert served.get(f"{path}/tags").content["tags"] == ["check"]
    known = {"If-Match": found.headers["etag"]}
    assert served.ask("PUT", f"{path}/notes", document={"text": "mine"}, headers=known).status == 200
    assert served.ask("PUT", f"{path}/notes", document={"text": "late"}, headers=known).status == 412
    assert served.ask("PUT", f"{path}/notes", document={"txt": ""}).status == 422
    assert served.ask("PUT", f"{path}/notes", document={"text": ""}).status == 200
    assert served.ask("PUT", f"{path}/tags", document={"tags": []}).status == 200


def test_a_comparison_is_made_once_and_found_by_its_key(served, compared):
    asked, first, key = compared
    assert (first.status, first.content["key"]) == (202, key)
    again = served.ask("POST", "comparisons", document=asked)
    assert (again.status, again.content) == (200, {"key": key})
    document = served.get(f"comparisons/{key}").content
    assert (document["device"], document["criteria"]) == ("falcon", ["overshoot"])
    report = served.get(f"comparisons/{key}/report")
    assert report.content.rstrip().endswith(b"</html>")
    assert "sandbox" in report.headers["content-security-policy"]
    assert "allow-same-origin" not in report.headers["content-security-policy"]


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        ({"device": "nobody"}, 404),
        ({"device": "falcon", "experiments": ["9"]}, 404),
        ({"device": "falcon", "criteria": ["beauty"]}, 422),
        ({"device": "falcon", "criteria": []}, 422),
        ({"device": "falcon", "experiments": ["1"], "against": {"device": "falcon", "experiment": "8"}}, 404),
        ({}, 422),
    ],
)
def test_a_comparison_that_cannot_be_made_is_refused(served, asked, status):
    answer = served.ask("POST", "comparisons", document=asked)
    assert (answer.status, answer.content["status"]) == (status, status)


def test_events_tell_of_a_job_until_it_ends(served):
    job = served.get("jobs?limit=1000").content["items"][-1]["id"]
    lines = served.get(f"jobs/{job}/events").content.decode().splitlines()
    assert lines[0] == "event: done"
    assert json.loads(lines[1].removeprefix("data: "))["id"] == job


ODD = ("%0d%0aX", "%00", "%ff%fe", "%F0%9F%92%A5", "a" * 3000, "-1", "1e400", "NaN", "'%3B--", "%2e%2e%2f", "{}", "[]",
       "")  # fmt: skip


@pytest.mark.parametrize("odd", ODD)
def test_odd_words_are_no_defect(served, odd):
    """Every parameter of every GET takes every odd word without a status of 500."""
    trial = served.get("trials?limit=1").content["items"][0]["id"]
    found = {}
    for path, methods in served.get("openapi.json").content["paths"].items():
        if "get" not in methods or path.endswith("/events"):
            continue
        names = [p["name"] for p in methods["get"].get("parameters", ()) if p["in"] == "query"]
        filled = path.replace("{trial}", trial).replace("{device}", "falcon").replace("{experiment}", "1")
        broken = [path.replace(part, odd or "x") for part in {part for part in path.split("/") if part[:1] == "{"}]
        plain = [filled + f"?{name}={odd}" for name in names]
        for asked in [p.replace("{trial}", odd or "x").replace("{device}", odd or "x") for p in broken] + plain:
            if "{" not in asked.replace("{}", "") and " " not in asked:
                found[asked] = served.get(asked).status
    assert {asked: status for asked, status in found.items() if status >= 500 and status != 503} == {}
    assert len(found) > 20


BODIES = (b"", b"{", b"[]", b"null", b'{"text": "\\ud800"}', b"\xff", b'{"text": 1}', b'{"text": "\\u0000"}')


@pytest.mark.parametrize("body", BODIES)
def test_odd_bodies_are_no_defect(served, body):
    words = [("PUT", f"experiments/falcon/1/{kind}") for kind in ("notes", "tags")]
    for method, path in (*words, ("POST", "comparisons")):
        answer = served.ask(method, path, body, {"Content-Type": "application/json"})
        assert answer.status in (200, 400, 422), (path, answer.content)
    served.ask("PUT", "experiments/falcon/1/notes", document={"text": ""})


def test_other_methods_are_told_which_there_are(served):
    paths = served.get("openapi.json").content["paths"]
    for path, methods in paths.items():
        for method in {"TRACE", "PATCH"} - {word.upper() for word in methods}:
            answer = served.ask(method, path.replace("{", "").replace("}", ""))
            assert answer.status == 405
            # names may be those of other paths, too
            assert set(answer.headers["allow"].split(", ")) >= set(map(str.upper, methods))


UNKNOWN = ("health?x=1", "devices?limitt=2", "trials?verdikt=stable", "trials?limit=1&limits=2", "experiments?q=x",
           "jobs?state=done", "theory/optimum?criterion=settle_2pct&delays=4", "/trials?verdikt=stable")  # fmt: skip


@pytest.mark.parametrize("path", UNKNOWN)
def test_an_unknown_parameter_is_refused_and_named(served, path):
    answer = served.get(path)
    assert answer.status == 422
    name = path.partition("?")[2].split("&")[-1].partition("=")[0]
    assert name in answer.content["where"]


def test_the_id_of_a_trial_is_16_digits(served):
    ids = [t["id"] for t in served.get("trials?limit=1000").content["items"]]
    assert len(set(ids)) == len(ids) > 100
    assert all(re.fullmatch("[0-9a-f]{16}", name) for name in ids)

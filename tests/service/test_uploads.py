"""What is acknowledged is stored, once, whatever happens; what is refused is named."""

import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from served import Client, form, serving
from stored import stored_rows

from pipeline.intake.ingest import ingest
from pipeline.service import results
from pipeline.service.database import WORKS, Database
from pipeline.service.settings import Settings
from pipeline.service.workers import work
from pipeline.store.storage import stage_file


def test_an_upload_is_what_an_ingest_is(empty, logs, tmp_path):
    bad = ("bad.csv", logs[0][1].replace(b"\n0.01", b"\nzero", 1))
    answer, job = empty.upload([*logs, bad, (f"again/{logs[0][0]}", logs[0][1])])
    assert [file["state"] for file in answer["files"]] == ["queued"] * (len(logs) + 1) + ["skipped"]
    assert [file["name"] for file in answer["files"]][-1] == f"again/{logs[0][0]}"
    folder = tmp_path / "raw"
    folder.mkdir()
    for name, data in (*logs, bad):
        (folder / name).write_bytes(data)
    expected = ingest([folder], tmp_path / "other").model_dump(mode="json", exclude={"plan"})
    (refused,) = expected["quarantined"]
    refused["path"] = "bad.csv"
    expected |= {"found": expected["found"] + 1, "skipped": expected["skipped"] + 1}
    assert job["result"] == expected
    assert stored_rows(tmp_path / "processed") == stored_rows(tmp_path / "other")
    items = empty.get("trials?limit=100").content["items"]
    assert {item["id"] for item in items} == set(stored_rows(tmp_path / "other"))
    assert empty.get(f"trials/{items[0]['id']}").content["source"] in [name for name, _ in logs]


def test_what_is_there_is_skipped(empty, logs, tmp_path):
    empty.upload(logs[:3])
    answer, job = empty.upload(logs[:4])
    assert [file["state"] for file in answer["files"]] == ["skipped"] * 3 + ["queued"]
    assert [job["result"][name] for name in ("found", "ingested", "skipped")] == [4, 1, 3]
    _, job = empty.upload(logs[:4])
    assert (job["result"]["found"], job["result"]["skipped"], job["result"]["quarantined"]) == (4, 4, [])
    assert stored_rows(tmp_path / "processed").total() == 4


@pytest.mark.slow
def test_the_command_line_works_beside(empty, logs, tmp_path):
    """Two writers: what the command line stored meanwhile is listed, and not stored again."""
    folder = tmp_path / "raw"
    folder.mkdir()
    for name, data in logs[:5]:
        (folder / name).write_bytes(data)
    answer = empty.ask("POST", "logs", **form(logs[3:]))
    report = ingest([folder], tmp_path / "processed")
    job = empty.done(answer.content["job"])
    assert report.ingested + job["result"]["ingested"] == len(logs)
    assert stored_rows(tmp_path / "processed").total() == len(logs)
    time.sleep(0.6)  # `catalogue.LOOK_S`
    assert empty.get("trials").content["total"] == len(logs)


@pytest.mark.slow
def test_a_damaged_file_stays_with_its_experiment(empty, logs, tmp_path):
    empty.upload(logs)
    empty.all_done()
    (file,) = (tmp_path / "processed" / "trials").rglob("*.parquet")
    file.write_bytes(b"nonsense")
    time.sleep(0.6)
    assert empty.get("trials").content["total"] == 0
    answer = empty.get("experiments/falcon/1/boundary")
    assert (answer.status, file.name in answer.content["detail"]) == (503, True)


@pytest.fixture
def lab(tmp_path):
    """Settings without a server, and their database."""
    settings = Settings(tmp_path / "processed", tmp_path / "reports")
    return settings, Database(settings.data)


@pytest.fixture
def database(lab):
    return lab[1]


def test_a_waiting_job_is_cancelled(database):
    job = database.add_job("stages", {})
    database.cancel(job)
    assert database.job(job).state == "cancelled"
    assert database.claim("worker") is None


def test_a_job_of_a_dead_worker_is_taken_again(database):
    job = database.add_job("stages", {})
    for worker in ("first", "second"):
        assert database.claim(worker).id == job
        assert database.claim("other") is None
        database.free(worker)
    assert not database.heartbeat(job, "first", None)
    assert database.claim("third").id == job
    database.free("third")
    found = database.job(job)
    assert (found.state, found.problem.status) == ("failed", 500)


def test_what_a_former_worker_finishes_late_does_not_count(database):
    job = database.add_job("stages", {})
    database.claim("first")
    database.free("first")
    database.claim("second")
    database.finish(job, "first", {"result": 1})
    assert database.job(job).state == "running"
    database.finish(job, "second", {"result": 2})
    assert database.job(job).result == {"result": 2}


def test_a_job_that_cannot_be_done_says_why(lab):
    settings, database = lab
    asked = {"device": "nobody", "experiments": ["1"], "criteria": None}
    job = database.add_job("experiment", {"key": "0", "request": asked})
    assert work(settings, database, "worker")
    found = database.job(job)
    assert found.state == "failed"
    assert "nobody" in found.problem.detail


def test_a_defect_fails_its_job_and_ends_the_worker(lab, monkeypatch):
    settings, database = lab
    job = database.add_job("stages", {})
    monkeypatch.setitem(results.KINDS, "stages", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        work(settings, database, "worker")
    found = database.job(job)
    assert (found.state, found.problem.status) == ("failed", 500)
    assert not work(settings, database, "worker"), "it is not tried again"


def test_what_was_never_acknowledged_is_removed(lab):
    settings, _ = lab
    left = settings.data / "logs" / "0123" / "a.csv"
    left.parent.mkdir(parents=True)
    left.write_text("half")
    with serving(settings):
        assert not left.exists()


def started(folder, port):
    folders = ["--processed", folder / "processed", "--reports", folder / "reports"]
    command = [sys.executable, "-m", "pipeline", "serve", *folders, "--port", str(port)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    for _ in range(1200):
        try:
            Client(port).get("health")
            return process
        except OSError:
            assert process.poll() is None, "the server did not start"
            time.sleep(0.05)
    raise AssertionError("the server did not answer")


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [0.0, 0.1, 0.8, 1.6])
def test_kill_loses_nothing_and_doubles_nothing(tmp_path, logs, after_s):
    """Killed during uploads and their jobs; the next server finishes what was acknowledged."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = started(tmp_path, port)
    client = Client(port)
    taken = []
    try:
        for log in logs[:4]:
            taken.append(client.ask("POST", "logs", **form([log])).content["job"])
        with socket.create_connection(("127.0.0.1", port)) as half:
            sent = form(logs[4:])
            lines = ["POST /api/v1/logs HTTP/1.1", "Host: localhost", f"Content-Length: {len(sent['body'])}"]
            head = "\r\n".join([*lines, f"Content-Type: {sent['headers']['Content-Type']}"])
            half.sendall(f"{head}\r\n\r\n".encode() + sent["body"][:-3])
            time.sleep(after_s)
            os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process = started(tmp_path, port)
        assert [client.done(job)["state"] for job in taken] == ["done"] * 4
        client.all_done()
        assert stored_rows(tmp_path / "processed").total() == 4
        assert set(stored_rows(tmp_path / "processed").values()) == {1}
        assert client.get("trials").content["total"] == 4
        assert len(list((tmp_path / "processed-service" / "logs").iterdir())) == 4
    finally:
        process.terminate()
        process.wait()


def running(client, database, job):
    while client.get(f"jobs/{job}").content["state"] == "queued":
        time.sleep(0.01)
    return database.run("SELECT owner FROM jobs WHERE id = ?", job)[0]["owner"]


@pytest.mark.slow
def test_a_running_job_ends_when_it_is_cancelled(empty, logs, database):
    empty.upload(logs)
    empty.all_done()
    job = empty.ask("POST", "comparisons", document={"device": "falcon"}).content["job"]
    worker = running(empty, database, job)
    assert empty.ask("DELETE", f"jobs/{job}").content["state"] == "cancelled"
    _, after = empty.upload(logs[:1])
    assert after["state"] == "done"
    assert database.run("SELECT owner FROM jobs WHERE id = ?", after["id"])[0]["owner"] != worker
    assert empty.get(f"jobs/{job}").content["state"] == "cancelled"


@pytest.mark.slow
def test_a_killed_worker_is_followed_by_another(empty, logs, database):
    empty.upload(logs)
    empty.all_done()
    asked = {"device": "falcon", "criteria": ["overshoot"]}
    job = empty.ask("POST", "comparisons", document=asked).content["job"]
    first = running(empty, database, job)
    os.kill(int(first.partition("-")[0]), signal.SIGKILL)
    found = empty.done(job)
    assert (found["state"], found["problem"]) == ("done", None)
    assert database.run("SELECT owner FROM jobs WHERE id = ?", job)[0]["owner"] != first


def test_logs_and_verdicts_come_before_what_is_looked_at(database):
    for number in range(3):
        database.add_job("drawing", {}, f"{number}")
    database.add_job("comparison", {}, "renewed", late=1)
    kinds = ("comparison", "drawing", "experiment", "stages", "upload")
    for kind in kinds:
        database.add_job(kind, {}, kind)
    assert database.claim("other", WORKS[-1]).kind == "experiment"
    taken = [database.claim("one").kind for _ in range(8)]
    assert taken == ["upload", "stages", "comparison", *["drawing"] * 4, "comparison"]
    for number in range(150):
        database.add_job("drawing", {}, f"left {number}")
    assert database.job_counts()["queued"] == 100, "who asked for older ones has left their page"


def test_an_upload_has_its_verdicts_while_costs_of_others_are_computed(lab, logs):
    settings, database = lab
    (settings.data / "logs" / "a").mkdir(parents=True)
    (settings.data / "logs" / "a" / logs[0][0]).write_bytes(logs[0][1])
    database.add_job("stages", {}, "stages")
    database.claim("busy", "stages")
    database.add_job("upload", {"folder": "a", "profile": "", "skipped": 0}, job="a")
    assert work(settings, database, "one", WORKS[0])
    assert database.job("a").result["ingested"] == 1
    assert stage_file(settings.processed, "falcon", "1", "outcome") is not None
    assert database.job_counts("kind = 'stages'") == {"queued": 1, "running": 1}


@pytest.mark.slow
def test_costs_that_two_jobs_need_are_computed_once(lab, tmp_path, logs):
    settings, _ = lab
    for name, data in logs[:3]:
        (tmp_path / name).write_bytes(data)
    ingest([tmp_path], settings.processed)
    with ThreadPoolExecutor(2) as pool:
        computed = pool.map(lambda _: results._computed(settings, ("falcon", "1"), {}), range(2))
        assert sorted(computed) == [False, True]


def test_verdicts_are_asked_for_once_and_come_after_logs(database):
    stages = database.add_job("stages", {}, "stages")
    assert database.add_job("stages", {}, "stages") == stages
    upload = database.add_job("upload", {})
    assert [database.claim(worker).id for worker in "ab"] == [upload, stages]
    # a running one may have passed what is new
    assert database.add_job("stages", {}, "stages") != stages

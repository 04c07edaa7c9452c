"""A profile that was corrected under its name: the logs that it read before are read again, and the audit has it."""

import json
import subprocess
import sys

import pytest
from served import Browser, form, serving
from wall_logs import named_logs, profile_text

from pipeline.intake.ingest import ingest
from pipeline.profiles.profile_files import read_profile
from pipeline.service.results import READ_AGAIN
from pipeline.service.settings import Settings
from pipeline.store.storage import read_trials


def keep(client, text):
    answer = client.ask("PUT", "profiles/lab", document={"profile": text})
    assert answer.status == 200, answer.content


def by_rest(client, logs, folder):
    return client.upload(logs, profile="lab")[1]["result"]


def by_page(client, logs, folder):
    browser = Browser(client)
    sent = form(logs, form=browser.token("/upload"), profile="lab")
    answer = browser.ask("POST", "/upload", sent["body"], sent["headers"])
    assert answer.status == 303, answer.content
    return client.done(answer.headers["location"].rpartition("/")[2])["result"]


def by_push(client, logs, folder):
    (folder / "raw").mkdir(exist_ok=True)
    for name, data in logs:
        (folder / "raw" / name).write_bytes(data)
    (folder / "lab.toml").write_text(client.get("profiles/lab").content["profile"])
    to = ["--to", f"http://127.0.0.1:{client.port}", "--profile", folder / "lab.toml", "--json"]
    done = subprocess.run([sys.executable, "-m", "pipeline", "push", folder / "raw", *to], capture_output=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def counts(result):
    return (result["found"], result["ingested"], result["skipped"], len(result["quarantined"]))


def stiffness(client):
    return sorted(item["stiffness"] for item in client.get("trials?limit=100").content["items"])


def read_again(client):
    return [e["what"] for e in client.get("audit").content["items"] if e["did"] == READ_AGAIN]


def version(folder, text):
    (folder / "version.toml").write_text(text)
    return read_profile(folder / "version.toml").digest


@pytest.fixture
def settings(tmp_path):
    return Settings(tmp_path / "processed", tmp_path / "reports", renew=False)


@pytest.mark.sampled
@pytest.mark.parametrize("send", [by_rest, by_page, by_push])
def test_a_corrected_profile_reads_its_logs_again_after_a_restart(settings, tmp_path, send):
    logs, wrong, right = named_logs(), profile_text(unit="N/m"), profile_text(unit="N/mm")
    with serving(settings) as client:
        keep(client, wrong)
        assert counts(send(client, logs, tmp_path)) == (4, 4, 0, 0)
        soft, ids = stiffness(client), {item["id"] for item in client.get("trials").content["items"]}
        trial = min(ids)
        client.ask("PUT", f"trials/{trial}/notes", document={"text": "the cable slipped"})
        client.ask("PUT", f"trials/{trial}/tags", document={"tags": ["check"]})
        assert client.ask("PUT", f"trials/{trial}/exclusion", document={"reason": "cable"}).status == 200
        assert counts(send(client, logs, tmp_path)) == (4, 0, 4, 0)
        assert read_again(client) == []
        keep(client, right)
    with serving(settings) as client:
        assert stiffness(client) == soft
        assert counts(send(client, logs, tmp_path)) == (4, 4, 0, 0)
        assert stiffness(client) == pytest.approx([1000 * k for k in soft])
        assert {item["id"] for item in client.get("trials").content["items"]} == ids
        shown = client.get(f"trials/{trial}").content
        assert (shown["notes"], shown["tags"], shown["excluded"]) == ("the cable slipped", ["check"], "cable")
        (entry,) = read_again(client)
        assert (entry["profile"], entry["logs"]) == ("lab", 4)
        assert (entry["before"], entry["now"]) == (version(tmp_path, wrong), version(tmp_path, right))
        assert counts(send(client, logs, tmp_path)) == (4, 0, 4, 0)
        assert len(read_again(client)) == 1
        page = client.get("/audit", Accept="text/html").content.decode()
        assert READ_AGAIN in page
        assert version(tmp_path, wrong)[:12] in page


def test_part_of_the_logs_is_read_again_with_new_ones(settings):
    logs = named_logs(5)
    with serving(settings) as client:
        keep(client, profile_text(unit="N/m"))
        by_rest(client, logs[:4], None)
        keep(client, profile_text(unit="N/mm"))
        assert counts(by_rest(client, logs[2:], None)) == (3, 3, 0, 0)
        assert [k > 500 for k in stiffness(client)] == [False, False, True, True, True]
        assert [entry["logs"] for entry in read_again(client)] == [2]
        assert counts(by_rest(client, logs, None)) == (5, 2, 3, 0)
        assert all(k > 500 for k in stiffness(client))


def test_a_profile_of_which_only_remarks_changed_reads_nothing_again(settings):
    logs = named_logs(2)
    with serving(settings) as client:
        keep(client, profile_text())
        by_rest(client, logs, None)
        keep(client, "# of the new bench\n" + profile_text() + "\n# end\n")
        answer, job = client.upload(logs, profile="lab")
        assert {file["state"] for file in answer["files"]} == {"skipped"}
        assert counts(job["result"]) == (2, 0, 2, 0)
        assert read_again(client) == []


@pytest.mark.slow
def test_a_profile_corrected_while_its_logs_wait_leaves_none_behind(settings):
    """The second upload comes before the first one is stored."""
    logs = named_logs(6)
    with serving(settings) as client:
        keep(client, profile_text(unit="N/m"))
        first = client.ask("POST", "logs", **form(logs, profile="lab")).content["job"]
        keep(client, profile_text(unit="N/mm"))
        _, second = client.upload(logs, profile="lab")
        client.done(first)
        assert second["result"]["found"] == 6
        assert all(k > 500 for k in stiffness(client))


@pytest.mark.slow
def test_a_renamed_folder_or_a_copy_reads_the_stored_log_again(settings, tmp_path):
    logs = [(name.removeprefix("K"), data) for name, data in named_logs(3)]
    fixed = profile_text().replace("name_pattern = 'K(", "#'").replace("[constants]", "[constants]\ndamping = 2")
    with serving(settings) as client:
        keep(client, fixed + "stiffness = 1\n")
        by_rest(client, logs, None)
        ids = {item["id"] for item in client.get("trials").content["items"]}
        keep(client, fixed + "stiffness = 2\n")
        copies = [(f"copy/{number}.txt", data) for number, (_, data) in enumerate(logs)]
        assert counts(by_rest(client, copies, None)) == (3, 3, 0, 0)
        assert stiffness(client) == [2000.0] * 3
        assert {item["id"] for item in client.get("trials").content["items"]} == ids


def test_a_corrected_profile_that_refuses_its_logs_leaves_their_trials(settings):
    logs = named_logs(2)
    with serving(settings) as client:
        keep(client, profile_text())
        by_rest(client, logs, None)
        before = stiffness(client)
        keep(client, profile_text().replace('name = "x"', 'name = "y"'))
        assert counts(by_rest(client, logs, None)) == (2, 0, 0, 2)
        assert stiffness(client) == before
        assert read_again(client) == []
        keep(client, profile_text(step=9.0))
        assert counts(by_rest(client, logs, None)) == (2, 2, 0, 0)
        assert client.get("quarantine").content == []
        assert [entry["logs"] for entry in read_again(client)] == [2]


def test_logs_that_were_moved_are_read_again_by_a_corrected_profile(tmp_path):
    """Without a service: nothing is left at the former place that could be read again there."""
    raw, profile = tmp_path / "raw", tmp_path / "lab.toml"
    raw.mkdir()
    for name, data in named_logs(3):
        (raw / name).write_bytes(data)
    profile.write_text(profile_text(unit="N/m"))
    assert ingest([raw], tmp_path / "processed", profile).ingested == 3
    raw.rename(tmp_path / "moved")
    profile.write_text(profile_text(unit="N/mm"))
    assert ingest([tmp_path / "moved"], tmp_path / "processed", profile).ingested == 3
    walls = read_trials(tmp_path / "processed").column("stiffness").to_pylist()
    assert (len(walls), min(walls) > 500) == (3, True)


@pytest.mark.slow
def test_logs_of_the_command_line_are_read_again_where_they_are(settings, tmp_path):
    raw = tmp_path / "raw"
    raw.mkdir()
    for name, data in named_logs(2):
        (raw / name).write_bytes(data)
    (tmp_path / "lab.toml").write_text(profile_text(unit="N/m"))
    assert ingest([raw], settings.processed, tmp_path / "lab.toml").ingested == 2
    with serving(settings) as client:
        keep(client, profile_text(unit="N/mm"))
        assert counts(by_rest(client, named_logs(2), None)) == (2, 2, 0, 0)
        assert all(k > 500 for k in stiffness(client))

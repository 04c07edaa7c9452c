"""A server with the trials of the shared Falcon course, computed once; tests that upload use one of their own."""

import shutil

import pytest
from served import serving

from pipeline.service.backup import backup
from pipeline.service.database import Database
from pipeline.service.settings import Settings

TOLD = ("devices", "experiments", "trials?limit=1000&sort=settle_2pct", "jobs?limit=1000", "experiments/falcon/1/notes",
        "experiments/falcon/1/tags", "experiments/falcon/1/estimates", "experiments/falcon/1/boundary")  # fmt: skip


@pytest.fixture(scope="session")
def served(falcon, tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    shutil.copytree(falcon.processed, folder / "processed")
    with serving(Settings(folder / "processed", folder / "reports", wait_s=240.0, renew=False)) as client:
        client.all_done()
        yield client


@pytest.fixture
def empty(tmp_path):
    with serving(Settings(tmp_path / "processed", tmp_path / "reports")) as client:
        yield client


@pytest.fixture(scope="session")
def logs(falcon):
    """Names and contents of eight logs."""
    files = sorted(falcon.raw.rglob("*.csv"))[::20][:8]
    return [(file.name, file.read_bytes()) for file in files]


@pytest.fixture(scope="session")
def three(logs, tmp_path_factory):
    """A server with eight logs each of two experiments and of a device of its own; tests leave it as it was."""
    folder = tmp_path_factory.mktemp("three")
    others = (("falcon", "2"), ("new rig", "1"))
    files = list(logs)
    for device, name in others:
        head = {
            b"# device: falcon": f"# device: {device}".encode(),
            b"# experiment: 1": f"# experiment: {name}".encode(),
        }
        for file, data in logs:
            for old, new in head.items():
                assert data.count(old) == 1
                data = data.replace(old, new)
            files.append((f"{device}-{name}-{file}", data))
    with serving(Settings(folder / "processed", folder / "reports", wait_s=240.0, renew=False)) as client:
        _, job = client.upload(files)
        assert job["result"]["ingested"] == len(files)
        client.all_done()
        for path in ("falcon/1", "falcon/2"):
            assert client.get(f"experiments/{path}/estimates").status == 200
        yield client


@pytest.fixture(scope="session")
def compared(served):
    """What was asked for, what was answered, and the key of a comparison that is there now."""
    asked = {"device": "falcon", "criteria": ["overshoot"]}
    first = served.ask("POST", "comparisons", document=asked)
    job = served.done(first.content["job"])
    assert (job["state"], job["problem"]) == ("done", None)
    return asked, first, job["result"]["key"]


@pytest.fixture(scope="session")
def kept(served, compared, tmp_path_factory, logs):
    """A backup of a running server with an upload, notes, a token and a report, and what the server told."""
    file, settings = tmp_path_factory.mktemp("kept") / "lab.zip", served.settings
    served.upload(logs)
    served.all_done()
    words = {"notes": {"text": "a stiff spring"}, "tags": {"tags": ["spring"]}}
    for kind, document in words.items():
        served.ask("PUT", f"experiments/falcon/1/{kind}", document=document)
    served.get("experiments/falcon/1/estimates")
    token = Database(settings.data).create_token("viewer", "Ada")
    found = backup(settings, file)
    told = {path: served.get(path).content for path in (*TOLD, f"comparisons/{compared[2]}/report")}
    for kind, document in (("notes", {"text": ""}), ("tags", {"tags": []})):
        served.ask("PUT", f"experiments/falcon/1/{kind}", document=document)
    assert found["files"] > 10
    return file, told, token, logs

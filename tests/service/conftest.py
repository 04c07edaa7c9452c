"""A server with the trials of the shared Falcon course, computed once; tests that upload use one of their own."""

import shutil

import pytest
from served import serving

from pipeline.service.settings import Settings


@pytest.fixture(scope="session")
def served(falcon, tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    shutil.copytree(falcon.processed, folder / "processed")
    with serving(Settings(folder / "processed", folder / "reports", wait_s=240.0, renew=False)) as client:
        client.all_done()
        yield client


@pytest.fixture
def chromium():
    """The browser of the system."""
    sync = pytest.importorskip("playwright.sync_api")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with sync.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield started
        started.close()


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

"""A server with the trials of the shared Falcon course, computed once; tests that upload use one of their own."""

import shutil
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import pytest
from served import serving

from pipeline.service.settings import Settings


def settings(folder: Path) -> Settings:
    return Settings(folder / "processed", folder / "reports", wait_s=240.0, renew=False)


@pytest.fixture(scope="session")
def kept(made_once, tmp_path_factory):
    """Call it with a name and what fills a folder: filled by one worker, copied and served by each."""

    @contextmanager
    def of(name: str, fill: Callable[[Path], None]):
        folder = made_once(name, lambda folder: fill(folder) or folder)
        copy = tmp_path_factory.mktemp(name) / "lab"
        shutil.copytree(folder, copy)
        with serving(settings(copy)) as client:
            client.all_done()
            yield client

    return of


@pytest.fixture(scope="session")
def served(falcon, kept):
    def fill(folder: Path) -> None:
        shutil.copytree(falcon.processed, folder / "processed")
        with serving(settings(folder)) as client:
            client.all_done()

    with kept("served", fill) as client:
        yield client


@pytest.fixture
def chromium(browser):
    """Another name for the browser of the system, beside `Browser`, which keeps cookies and sends forms."""
    return browser


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
def three(logs, kept):
    """A server with eight logs each of two experiments and of a device of its own; tests leave it as it was."""
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

    def fill(folder: Path) -> None:
        with serving(settings(folder)) as client:
            _, job = client.upload(files)
            assert job["result"]["ingested"] == len(files)
            client.all_done()
            for path in ("falcon/1", "falcon/2"):
                assert client.get(f"experiments/{path}/estimates").status == 200

    with kept("three", fill) as client:
        yield client


@pytest.fixture(scope="session")
def compared(served):
    """What was asked for, what was answered, and the key of a comparison that is there now."""
    asked = {"device": "falcon", "criteria": ["overshoot"]}
    first = served.ask("POST", "comparisons", document=asked)
    job = served.done(first.content["job"])
    assert (job["state"], job["problem"]) == ("done", None)
    return asked, first, job["result"]["key"]

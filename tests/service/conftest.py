"""A server with the trials of the shared Falcon course, computed once; tests that upload use one of their own."""

import shutil

import pytest
from served import serving

from pipeline.service.settings import Settings


@pytest.fixture(scope="session")
def served(falcon, tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    shutil.copytree(falcon.processed, folder / "processed")
    with serving(Settings(folder / "processed", folder / "reports", wait_s=240.0)) as client:
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

"""An S3 server that the tests of this folder share, and an empty store on it for each."""

import pytest
from clusters import moto

from pipeline.base.provenance import digest


@pytest.fixture(scope="session")
def server():
    with moto() as running:
        yield running


@pytest.fixture
def s3(server, monkeypatch, request):
    """URL of an empty store; this process finds its server."""
    for name, value in server.env.items():
        monkeypatch.setenv(name, value)
    return server.url(digest(request.node.nodeid))

"""The ideal Falcon course, compared."""

from __future__ import annotations

import pytest

from pipeline.comparison.scene.scene import open_scene


@pytest.fixture(scope="module")
def data(falcon):
    return open_scene("falcon", falcon.processed, None, None)


@pytest.fixture(scope="module")
def result(falcon_outcome):
    return falcon_outcome.result

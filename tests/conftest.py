"""Small simulated courses that several test files share: simulated, written and ingested once per session."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from labs import Lab, make_lab

from pipeline.base import provenance
from pipeline.comparison.compare import Outcome
from pipeline.device_data.devices import load_device


def pytest_collection_modifyitems(items):
    """Of the cases of a test that is marked `sampled`, all but the first are slow."""
    seen = set()
    for item in items:
        if item.get_closest_marker("sampled") and item.function in seen:
            item.add_marker(pytest.mark.slow)
        seen.add(getattr(item, "function", None))


@pytest.fixture
def edit(monkeypatch):
    """Call it with modules: from then on the source of each has a line more, though what runs stays the same."""
    original = provenance._source
    edited = set()

    def edit_modules(*modules):
        edited.update(Path(module.__file__) for module in modules)
        provenance.code_digest.cache_clear()

    def source(file):
        return original(file) + (b"# edited\n" if file in edited else b"")

    monkeypatch.setattr(provenance, "_source", source)
    yield edit_modules
    provenance.code_digest.cache_clear()


@pytest.fixture(scope="session", autouse=True)
def _heeded_signals():
    """A shell starts what it runs in its background with signals ignored; the commands under test heed them."""
    for number in (getattr(signal, name) for name in ("SIGINT", "SIGHUP") if hasattr(signal, name)):
        if signal.getsignal(number) is signal.SIG_IGN:
            # a handler that does nothing ignores it here, and is not inherited
            signal.signal(number, lambda *_: None)


@pytest.fixture(scope="session")
def one_process():
    """Theory in this process: the pool takes seconds to start, and what is computed here is kept for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: 1)
        yield


@pytest.fixture(scope="session")
def falcon(tmp_path_factory) -> Lab:
    """Ideal experiment 1, 180 trials: every fourth damping, four times the stiffness step."""
    return make_lab(tmp_path_factory.mktemp("falcon"), load_device("falcon"), ("1",), ideal=True, coarsen=4)


@pytest.fixture(scope="session")
def patient(tmp_path_factory) -> Lab:
    """Ideal experiment 1 with logs of 1.5 s: most stable responses have decayed to nothing at their end."""
    folder = tmp_path_factory.mktemp("patient")
    return make_lab(folder, load_device("falcon"), ("1",), ideal=True, coarsen=5, duration_s=1.5)


@pytest.fixture(scope="session")
def noisy(tmp_path_factory) -> Lab:
    """The same with jitter, sensor noise and quantum of the device file."""
    return make_lab(tmp_path_factory.mktemp("noisy"), load_device("falcon"), ("1",), seed=11, coarsen=4)


@pytest.fixture(scope="session")
def lwr(tmp_path_factory) -> Lab:
    """Ideal sweep over two delays, some 200 trials."""
    folder = tmp_path_factory.mktemp("lwr")
    return make_lab(folder, load_device("lwr"), ("delay-2", "delay-4"), ideal=True, coarsen=4)


@pytest.fixture(scope="session")
def sweep(tmp_path_factory) -> Lab:
    """All seven delays of the LWR, some 230 trials."""
    device = load_device("lwr")
    names = tuple(e.name for e in device.experiments)
    return make_lab(tmp_path_factory.mktemp("sweep"), device, names, ideal=True, coarsen=8)


@pytest.fixture(scope="session")
def sticky(tmp_path_factory) -> Lab:
    """A device with friction, stiction and jitter, 88 trials: most rest elsewhere than at x_0 + F_0/K."""
    return make_lab(tmp_path_factory.mktemp("sticky"), load_device("falcon-real"), ("1",), seed=1, coarsen=6)


@pytest.fixture(scope="session")
def unknown(tmp_path_factory) -> Lab:
    """A device without a device file that moves like the Falcon."""
    device = load_device("falcon").model_copy(update={"name": "mydevice"})
    return make_lab(tmp_path_factory.mktemp("unknown"), device, ("1",), ideal=True, coarsen=6)


@pytest.fixture(scope="session")
def falcon_outcome(falcon, one_process) -> Outcome:
    return falcon.compare(report=falcon.raw.parent / "falcon.html")


@pytest.fixture(scope="session")
def lwr_outcome(lwr, one_process) -> Outcome:
    return lwr.compare(report=lwr.raw.parent / "lwr.html")


@pytest.fixture(scope="session")
def sticky_outcome(sticky, one_process) -> Outcome:
    return sticky.compare(report=sticky.raw.parent / "sticky.html")


@pytest.fixture(scope="session")
def unknown_outcome(unknown, one_process) -> Outcome:
    return unknown.compare(report=unknown.raw.parent / "unknown.html")


@pytest.fixture
def record_property(record_property):
    """As pytest's own, for numpy's numbers too: parallel runs cannot send these from worker to worker and crash."""

    def record(name, value):
        record_property(name, value.item() if isinstance(value, np.generic) else value)

    return record


@pytest.fixture
def logs(tmp_path) -> Path:
    """An empty folder for logs."""
    folder = tmp_path / "logs"
    folder.mkdir()
    return folder


@pytest.fixture
def processed(tmp_path) -> Path:
    """Where tables go; not made yet."""
    return tmp_path / "processed"

"""Small simulated courses that several test files share: simulated, written and ingested once per session."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from labs import Lab, Outcome, make_lab

from pipeline.base import provenance
from pipeline.device_data.devices import load_device
from pipeline.shell.cli import run


def pytest_collection_modifyitems(items):
    """Of the cases of a test that is marked `sampled`, all but the first are slow."""
    seen = set()
    for item in items:
        if item.get_closest_marker("sampled") and item.function in seen:
            item.add_marker(pytest.mark.slow)
        seen.add(getattr(item, "function", None))


@pytest.fixture(scope="module")
def browser():
    """The Chromium of the system, without a window."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install -e '.[dev]'")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        # in a container tests run as root, where Chromium has no sandbox
        started = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield started
        started.close()


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


@pytest.fixture
def call(capsys, monkeypatch, tmp_path):
    """Run the command line in an empty folder; returns exit status, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def run_here(*arguments):
        with pytest.raises(SystemExit) as leaving:
            run([str(a) for a in arguments])
        out, err = capsys.readouterr()
        return leaving.value.code or 0, out, err

    return run_here


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
def made_once(tmp_path_factory) -> Callable[[str, Callable[[Path], Any]], Any]:
    """Call it with a name and what makes something in a folder: made by one worker, and taken over by the others."""
    own = tmp_path_factory.getbasetemp()
    shared = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def taken(name: str, make: Callable[[Path], Any]) -> Any:
        folder = shared / "made-once" / name
        folder.mkdir(parents=True, exist_ok=True)
        kept = folder.with_suffix(".pickle")
        with FileLock(folder.with_suffix(".lock")):
            if not kept.exists():
                kept.write_bytes(pickle.dumps(make(folder)))
            return pickle.loads(kept.read_bytes())

    return taken


@pytest.fixture(scope="session")
def falcon(made_once) -> Lab:
    """Ideal experiment 1, 180 trials: every fourth damping, four times the stiffness step."""
    return made_once("falcon", lambda folder: make_lab(folder, load_device("falcon"), ("1",), ideal=True, coarsen=4))


@pytest.fixture(scope="session")
def patient(made_once) -> Lab:
    """Ideal experiment 1 with logs of 1.5 s: most stable responses have decayed to nothing at their end."""
    device, options = load_device("falcon"), {"ideal": True, "coarsen": 5, "duration_s": 1.5}
    return made_once("patient", lambda folder: make_lab(folder, device, ("1",), **options))


@pytest.fixture(scope="session")
def noisy(made_once) -> Lab:
    """The same with jitter, sensor noise and quantum of the device file."""
    return made_once("noisy", lambda folder: make_lab(folder, load_device("falcon"), ("1",), seed=11, coarsen=4))


@pytest.fixture(scope="session")
def lwr(made_once) -> Lab:
    """Ideal sweep over two delays, some 200 trials."""
    device, options = load_device("lwr"), {"ideal": True, "coarsen": 4}
    return made_once("lwr", lambda folder: make_lab(folder, device, ("delay-2", "delay-4"), **options))


@pytest.fixture(scope="session")
def sweep(made_once) -> Lab:
    """All seven delays of the LWR, some 230 trials."""
    device = load_device("lwr")
    names = tuple(e.name for e in device.experiments)
    return made_once("sweep", lambda folder: make_lab(folder, device, names, ideal=True, coarsen=8))


@pytest.fixture(scope="session")
def sticky(made_once) -> Lab:
    """A device with friction, stiction and jitter, 88 trials: most rest elsewhere than at x_0 + F_0/K."""
    device = load_device("falcon-real")
    return made_once("sticky", lambda folder: make_lab(folder, device, ("1",), seed=1, coarsen=6))


@pytest.fixture(scope="session")
def unknown(made_once) -> Lab:
    """A device without a device file that moves like the Falcon."""
    device = load_device("falcon").model_copy(update={"name": "mydevice"})
    return made_once("unknown", lambda folder: make_lab(folder, device, ("1",), ideal=True, coarsen=6))


@pytest.fixture(scope="session")
def falcon_outcome(falcon, one_process, made_once) -> Outcome:
    return made_once("falcon-report", lambda _: falcon.compare(report=falcon.raw.parent / "falcon.html"))


@pytest.fixture(scope="session")
def lwr_outcome(lwr, one_process, made_once) -> Outcome:
    return made_once("lwr-report", lambda _: lwr.compare(report=lwr.raw.parent / "lwr.html"))


@pytest.fixture(scope="session")
def sticky_outcome(sticky, one_process, made_once) -> Outcome:
    return made_once("sticky-report", lambda _: sticky.compare(report=sticky.raw.parent / "sticky.html"))


@pytest.fixture(scope="session")
def unknown_outcome(unknown, one_process, made_once) -> Outcome:
    return made_once("unknown-report", lambda _: unknown.compare(report=unknown.raw.parent / "unknown.html"))


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

"""Stages by a Dask cluster: what this machine computes, byte by byte, and an end with words where a part is killed."""

import errno
import os
import re
import shutil
import signal
import threading
import time
from types import SimpleNamespace

import pytest
from clusters import dask, free_port, moto
from distributed import KilledWorker
from labs import copied_experiments

from pipeline.base.errors import StoreError, UsageError
from pipeline.comparison import executors, stage_pool
from pipeline.comparison.executors import ClusterError, compute_on_cluster, executor_of
from pipeline.comparison.stage_pool import compute_stages
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.measured.stages import stage_tables
from pipeline.measured.stages.stage_needs import NEEDS
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.store import objects
from pipeline.store.objects import opened, stored_by
from pipeline.store.storage import list_experiments

NEEDED = {"response", "wall_law", "boundary", "delay", "outcome"}
ALL = NEEDED | {"parts", "device", "model", "mass", "energy", "settling", "overshoot"}
NAMES = ("1", "2", "3", "4")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("copied")
    return copied_experiments(folder, load_device("lwr"), "delay-2", NAMES, ideal=True, coarsen=16)


@pytest.fixture(scope="module")
def local(logs, tmp_path_factory):
    """A folder with trials, and one with all that this process computes of them."""
    folder = tmp_path_factory.mktemp("local")
    ingest([logs], folder / "trials-only")
    shutil.copytree(folder / "trials-only", folder / "whole")
    for own in experiments(folder / "whole"):
        for stage in sorted(NEEDED, key=list(NEEDS).index):
            own.table(stage)
    return folder


@pytest.fixture(scope="module")
def server():
    with moto() as running, pytest.MonkeyPatch.context() as patch:
        for name, value in running.env.items():
            patch.setenv(name, value)
        yield running


@pytest.fixture(scope="module")
def cluster(server, tmp_path_factory):
    with dask(tmp_path_factory.mktemp("dask"), 2, server.env) as running:
        yield running


@pytest.fixture
def trials(local, tmp_path):
    """A folder with trials and no results."""
    return shutil.copytree(local / "trials-only", tmp_path / "processed")


def experiments(processed):
    return [ExperimentStages.stored(processed, "lwr", name) for name in list_experiments(processed, "lwr")]


def results(processed):
    return {file.relative_to(processed): file.read_bytes() for file in (processed / "stages").rglob("*.parquet")}


def test_a_folder_gets_the_same_bytes(cluster, trials, local):
    executor_of(cluster.address)(experiments(trials), NEEDED)
    assert results(trials) == results(local / "whole")
    assert len(results(trials)) == len(NAMES) * len(NEEDED)


def test_a_store_gets_the_same_bytes(cluster, server, logs, local, monkeypatch):
    url = server.url("cluster")
    stored_by(url, lambda processed: ingest([logs], processed))
    with opened(url, "lwr") as processed:
        own = experiments(processed)
        executor_of(cluster.address)(own, NEEDED)
        assert not any(stages._tables for stages in own), "what is stored need not pass the scheduler"
        assert results(processed) == results(local / "whole")
    monkeypatch.setattr(executors, "do", None)
    with opened(url, "lwr") as processed:
        assert results(processed) == results(local / "whole")
        executor_of(cluster.address)(experiments(processed), NEEDED)


@pytest.mark.slow
def test_all_stages_of_a_store_by_both_executors(cluster, server, logs, local, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    shutil.copytree(local / "trials-only", tmp_path / "processed")
    compute_stages(experiments(tmp_path / "processed"), ALL)
    expected = results(tmp_path / "processed")
    assert len(expected) == len(NAMES) * len(ALL)
    for executor in (compute_stages, executor_of(cluster.address)):
        url = server.url(f"all-{executor is compute_stages}")
        stored_by(url, lambda processed: ingest([logs], processed))
        with opened(url, "lwr") as processed:
            own = experiments(processed)
            executor(own, ALL)
            assert all(bool(stages._tables) == (executor is compute_stages) for stages in own)
        with opened(url, "lwr") as processed:
            assert results(processed) == expected


def test_what_a_worker_may_not_store_is_handed_back(trials, local, monkeypatch):
    """Its tables come back, as from a process of this machine."""

    def refuse(*_):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    (own, *_), (expected, *_) = experiments(trials), experiments(local / "whole")
    assert stage_pool.do(stage_pool.job_of(expected, NEEDED), stored_suffices=True) == {}
    monkeypatch.setattr(stage_tables, "write_result", refuse)
    done = stage_pool.do(stage_pool.job_of(own, NEEDED), stored_suffices=True)
    assert {name: table.equals(expected.table(name)) for name, table in done.items()} == dict.fromkeys(NEEDED, True)


def test_parts_without_the_package_are_told(cluster, trials, monkeypatch):
    """The scheduler reads what it is sent, too."""
    monkeypatch.setattr(executors, "do", _unknown_to_others)
    with pytest.raises(ClusterError, match=r"scheduler or a worker lacks haptic-pipeline.*same version"):
        executor_of(cluster.address)(experiments(trials), NEEDED)


def _unknown_to_others(job, stored_suffices):
    raise AssertionError("its module is not theirs")


def test_workers_of_another_version_are_refused(cluster, trials, monkeypatch):
    monkeypatch.setattr(stage_pool, "__version__", "0.0.0")
    with pytest.raises(StoreError, match=r"a worker runs other code.*Install the same version"):
        executor_of(cluster.address)(experiments(trials), NEEDED)


def test_a_folder_that_workers_do_not_see_is_told(cluster, trials, monkeypatch, tmp_path):
    monkeypatch.setattr(stage_pool, "origin", lambda *_: str(tmp_path / "elsewhere"))
    with pytest.raises(StoreError, match=r"elsewhere: a worker cannot access this folder.*s3://BUCKET/PREFIX"):
        executor_of(cluster.address)(experiments(trials), NEEDED)


@pytest.mark.parametrize("text", ["dask", "dask://", "dask://host", "dask://host:x", "ray://host:1", "tcp://host:1"])
def test_other_executors_are_refused(text):
    with pytest.raises(UsageError, match=r"expected local, or dask://HOST:PORT"):
        executor_of(text)


def test_executors_by_name(monkeypatch):
    assert executor_of("local") is compute_stages
    made = executor_of("dask://[::1]:8786")
    assert (made.func, made.args) == (compute_on_cluster, ("tcp://[::1]:8786",))
    monkeypatch.setattr(objects, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"executor dask://h:1 needs distributed.*pip install '.\[cluster\]'"):
        executor_of("dask://h:1")


def test_no_scheduler(trials, monkeypatch):
    monkeypatch.setattr(executors, "CONNECT_S", 0.5)
    with pytest.raises(ClusterError, match=r"cannot be reached.*0 of 4 experiments are done.*Repeat the command"):
        executor_of(f"dask://127.0.0.1:{free_port()}")(experiments(trials), NEEDED)


def test_an_experiment_that_ends_its_workers_is_told():
    last = SimpleNamespace(address="tcp://h:2")
    words = r"ended 4 workers in a row.*1 of 2 experiments are done"
    with pytest.raises(ClusterError, match=words), executors._reported("tcp://h:1", ["1"], 2):
        raise KilledWorker("job", last, 3)


def test_other_faults_stay_as_they_are():
    for fault in (PermissionError("no"), RuntimeError("a defect")):
        with pytest.raises(type(fault)), executors._reported("tcp://h:1", [], 2):
            raise fault


class Run(threading.Thread):
    """An executor at work."""

    def __init__(self, address, processed):
        super().__init__()
        self.own, self.address, self.error = experiments(processed), address, None

    def run(self):
        try:
            executor_of(self.address)(self.own, NEEDED)
        except Exception as error:
            self.error = error

    def wait_for_results(self, processed, number):
        until = time.monotonic() + 60
        while len(results(processed)) < number and self.is_alive() and time.monotonic() < until:
            time.sleep(0.01)

    def ended(self):
        self.join(90)
        assert not self.is_alive()
        return self.error


@pytest.mark.slow
def test_a_worker_and_then_the_scheduler_are_killed(trials, local, tmp_path):
    with dask(tmp_path, 2) as cluster:
        run = Run(cluster.address, trials)
        run.start()
        run.wait_for_results(trials, 1)
        cluster.workers[0].kill()
        assert run.ended() is None
        assert results(trials) == results(local / "whole")
        shutil.rmtree(trials / "stages")
        run = Run(cluster.address, trials)
        run.start()
        run.wait_for_results(trials, len(NEEDED) + 1)
        cluster.scheduler.kill()
        error = run.ended()
        assert isinstance(error, ClusterError)
        assert re.search(r"its scheduler is gone.*[12] of 4 experiments are done and stored\. Repeat", str(error))
    before = results(trials)
    assert len(before) > len(NEEDED)
    assert before.items() <= results(local / "whole").items(), "what was computed is stored, and right"
    compute_stages(experiments(trials)[:1], NEEDED)
    assert all(one.is_stored(stage) for one in experiments(trials)[:1] for stage in NEEDED)


@pytest.mark.slow
def test_all_workers_are_killed_and_another_cluster_does_the_rest(trials, local, tmp_path, monkeypatch):
    monkeypatch.setattr(executors, "NO_WORKER_S", 0.5)
    with dask(tmp_path, 1) as cluster:
        run = Run(cluster.address, trials)
        run.start()
        run.wait_for_results(trials, len(NEEDED) + 1)
        cluster.workers[0].kill()
        error = run.ended()
        assert isinstance(error, ClusterError)
        assert "has had no worker for 0.5 s" in str(error)
        assert "Repeat the command" in str(error)
    before = results(trials)
    assert len(NEEDED) < len(before) < len(NAMES) * len(NEEDED)
    assert before.items() <= results(local / "whole").items()
    with dask(tmp_path, 1) as cluster:
        executor_of(cluster.address)(experiments(trials), NEEDED)
    assert results(trials) == results(local / "whole")


@pytest.mark.slow
def test_the_store_is_killed(logs, monkeypatch):
    """Its server is stopped for a moment, which is waited for, and then killed."""
    monkeypatch.setattr(objects, "RETRIES", 3)
    with moto() as own, pytest.MonkeyPatch.context() as patch:
        for name, value in own.env.items():
            patch.setenv(name, value)
        url = own.url("x")
        stored_by(url, lambda processed: ingest([logs / "1"], processed))
        own.process.send_signal(signal.SIGSTOP)
        threading.Timer(1.0, own.process.send_signal, [signal.SIGCONT]).start()

        def compute(processed):
            (stages,) = experiments(processed)
            own.process.kill()
            stages.table("boundary")

        with pytest.raises(StoreError, match=r"s3://lab/x: a request failed.*repeat the command"):
            stored_by(url, compute)

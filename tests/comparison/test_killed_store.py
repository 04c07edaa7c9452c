"""A store that keeps its files, SeaweedFS, killed while a cluster works, started again, and the command repeated."""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from clusters import Seaweed, dask
from labs import copied_experiments

from pipeline.base.errors import StoreError
from pipeline.comparison.executors import executor_of
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.store.objects import Objects, opened
from pipeline.store.storage import list_experiments, read_trials

pytestmark = pytest.mark.slow

NEEDED = {"response", "boundary", "delay", "outcome"}
COMMAND = [sys.executable, "-c", "import sys; from pipeline.shell.cli import run; run(sys.argv[1:])"]


def experiments(processed):
    return [ExperimentStages.stored(processed, "lwr", name) for name in list_experiments(processed, "lwr")]


def results(processed):
    return {file.relative_to(processed): file.read_bytes() for file in (processed / "stages").rglob("*.parquet")}


def stages_stored(url):
    return len(Objects(url).list("stages/"))


def test_a_store_that_is_killed_is_whole_when_it_is_back(tmp_path, monkeypatch):
    names = [str(number) for number in range(8)]
    logs = copied_experiments(tmp_path, load_device("lwr"), "delay-2", names, ideal=True, coarsen=10)
    ingest([logs], tmp_path / "local")
    for own in experiments(tmp_path / "local"):
        for stage in ("response", "boundary", "delay", "outcome"):
            own.table(stage)
    (tmp_path / "weed").mkdir()
    server = Seaweed(tmp_path / "weed")
    with server.running() as s3:
        for name, value in s3.env.items():
            monkeypatch.setenv(name, value)
        url = s3.url("x")
        halves = [[logs / name for name in names[start::2]] for start in (0, 1)]
        commands = [[*COMMAND, "ingest", *map(str, half), "--processed", url] for half in halves]
        with ThreadPoolExecutor(2) as pool:
            done = list(pool.map(lambda command: subprocess.run(command, capture_output=True, text=True), commands))
        assert [one.returncode for one in done] == [0, 0], [one.stderr for one in done]
    with dask(tmp_path, 2, s3.env) as cluster:
        with server.running() as s3, opened(url, "lwr") as processed, ThreadPoolExecutor(1) as pool:
            assert read_trials(processed).num_rows == read_trials(tmp_path / "local").num_rows
            run = pool.submit(executor_of(cluster.address), experiments(processed), NEEDED)
            while stages_stored(url) < 2 * len(NEEDED):
                time.sleep(0.02)
                assert not run.done()
            s3.process.kill()
            with pytest.raises(StoreError, match=r"a request failed.*repeat the command"):
                run.result()
        with server.running():
            before = stages_stored(url)
            assert 2 * len(NEEDED) <= before < len(names) * len(NEEDED)
            with opened(url, "lwr") as processed:
                executor_of(cluster.address)(experiments(processed), NEEDED)
                assert results(processed) == results(tmp_path / "local")

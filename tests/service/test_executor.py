"""A server with a cluster: its jobs leave the experiments to it, all at once."""

import pytest
from native_logs import short_log

from pipeline.base.errors import UsageError
from pipeline.comparison.executors import ClusterError
from pipeline.intake.ingest import ingest
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.service.database import Database
from pipeline.service.jobs import results
from pipeline.service.jobs.worker import work
from pipeline.service.settings import Settings
from pipeline.shell.commands.cli_serve import serve

ADDRESS = "dask://127.0.0.1:1"


@pytest.fixture
def settings(tmp_path):
    (tmp_path / "logs").mkdir()
    for number in range(3):
        (tmp_path / "logs" / f"{number}.csv").write_text(short_log(1.0, str(number)))
    ingest([tmp_path / "logs"], tmp_path / "processed")
    return Settings(tmp_path / "processed", tmp_path / "reports", executor=ADDRESS)


def test_stages_of_all_experiments_are_sent_together(settings, monkeypatch):
    sent = []

    def executor_of(text):
        assert text == ADDRESS
        return lambda experiments, needed: sent.append(([one.experiment for one in experiments], needed))

    monkeypatch.setattr(results, "executor_of", executor_of)
    monkeypatch.setattr(results, "compute_stages", lambda *_: None)
    monkeypatch.setattr(ExperimentStages, "table", lambda self, stage: None)
    database = Database(settings.data)
    done = results.run_stages(settings, database, {}, lambda _: None)
    assert done == {"computed": 3, "failed": {}}
    assert [experiments for experiments, _ in sent] == [["0", "1", "2"]]
    assert "response" in sent[0][1]


def test_a_cluster_that_is_gone_fails_the_job_with_words(settings, monkeypatch):
    monkeypatch.setattr("pipeline.comparison.executors.CONNECT_S", 0.5)
    database = Database(settings.data)
    job = database.add_job("stages", {})
    assert work(settings, database, "worker")
    found = database.job(job)
    assert found["state"] == "failed"
    assert "0 of 3 experiments are done and stored. Repeat" in found["problem"]["detail"]
    with pytest.raises(ClusterError):
        results.run_stages(settings, database, {}, lambda _: None)


def test_a_server_refuses_an_executor_that_there_is_not(tmp_path):
    with pytest.raises(UsageError, match="expected local, or dask"):
        serve(processed=tmp_path / "processed", reports=tmp_path / "reports", executor="ray://x:1")

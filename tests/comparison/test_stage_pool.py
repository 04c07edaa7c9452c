"""Stages of several experiments in processes of their own: the same tables as one after the other."""

from __future__ import annotations

import errno
import os
import shutil

import pytest

from pipeline.comparison import stage_pool
from pipeline.comparison.stage_pool import compute_stages
from pipeline.measured.stages import stage_tables
from pipeline.records.table_files import read_table

NEEDED = {"response", "boundary", "delay"}


@pytest.fixture
def copy(lwr, tmp_path, monkeypatch):
    """The trials of the sweep without any stage, and two processors."""
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    shutil.copytree(lwr.processed / "trials", tmp_path / "trials")
    return tmp_path


def test_processes_store_what_one_process_computes(lwr, copy):
    experiments = [lwr.stages(name, copy) for name in lwr.courses]
    compute_stages(experiments, NEEDED)
    for own in experiments:
        assert all(own.is_stored(stage) for stage in NEEDED)
        assert set(own._tables) == NEEDED, "they were computed elsewhere, and taken over"
        alone = lwr.stages(own.experiment)
        for stage in NEEDED:
            assert own.table(stage).equals(alone.table(stage), check_metadata=True)
            assert read_table(own._file(stage)).num_rows > 0
    assert not own.is_stored("mass"), "only what is needed is computed"


def test_one_experiment_or_one_processor_is_left_for_later(lwr, copy, monkeypatch):
    experiments = [lwr.stages(name, copy) for name in lwr.courses]
    compute_stages(experiments[:1], NEEDED)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    compute_stages(experiments, NEEDED)
    assert not (copy / "stages").exists()


def no_file(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.slow
def test_the_trials_of_a_large_experiment_are_shared(lwr, copy, monkeypatch):
    monkeypatch.setattr(stage_pool, "LARGE", 50)
    shared = []
    original = stage_pool.SharedTrials.__call__

    def noted(self, function, places, verdicts):
        shared.append(len({place % len(self._pools) for place in places}))
        return original(self, function, places, verdicts)

    monkeypatch.setattr(stage_pool.SharedTrials, "__call__", noted)
    own = lwr.stages("delay-2", copy)
    assert own.count_new_trials() == own.trials.num_rows
    needed = {*NEEDED, "model", "mass", "outcome", "overshoot", "settling", "energy"}
    compute_stages([own], needed)
    assert set(shared) == {2}, "each process has a part of the trials"
    assert len(shared) > len(needed) - 3, "which it keeps for several stages"
    monkeypatch.undo()
    alone = lwr.stages("delay-2")
    for stage in needed:
        assert own.table(stage).equals(alone.table(stage)), stage
    assert own.count_new_trials() == 0


def test_what_is_not_new_is_not_computed_by_several_processes_either(lwr, copy, monkeypatch):
    whole = lwr.stages("delay-2", copy)
    some = stage_tables.ExperimentStages(copy, "lwr", "delay-2", whole.trials.slice(30))
    some.table("wall_law")
    some.table("delay")
    monkeypatch.setattr(stage_pool, "LARGE", 20)
    computed = []
    original = stage_pool.SharedTrials.__call__

    def counted(self, function, places, verdicts):
        computed.append(len(places))
        return original(self, function, places, verdicts)

    monkeypatch.setattr(stage_pool.SharedTrials, "__call__", counted)
    compute_stages([whole], NEEDED)
    monkeypatch.undo()
    assert computed == [30, 30, 30], "response, wall law and delay"
    for stage in NEEDED:
        assert whole.table(stage).equals(lwr.stages("delay-2").table(stage)), stage


def test_large_experiments_that_fill_all_processors_are_not_cut(lwr, copy, monkeypatch):
    """Each in a process of its own they need not wait for each other after every stage."""
    monkeypatch.setattr(stage_pool, "LARGE", 20)
    monkeypatch.setattr(stage_tables.ExperimentStages, "compute", no_file)
    experiments = [lwr.stages(name, copy) for name in lwr.courses]
    compute_stages(2 * experiments, NEEDED)
    assert all(own.is_stored("delay") for own in experiments)

"""Stages of several experiments in processes of their own: the same tables as one after the other."""

from __future__ import annotations

import os
import shutil

from pipeline.comparison import stage_pool
from pipeline.comparison.stage_pool import compute_stages
from pipeline.records import groups
from pipeline.records.table_files import read_table

NEEDED = {"response", "boundary", "delay"}


def test_processes_store_what_one_process_computes(lwr, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    copy = tmp_path / "processed"
    for part in ("trials", "samples"):
        shutil.copytree(lwr.processed / part, copy / part)
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


def test_one_experiment_or_one_processor_is_left_for_later(lwr, tmp_path, monkeypatch):
    copy = tmp_path / "processed"
    for part in ("trials", "samples"):
        shutil.copytree(lwr.processed / part, copy / part)
    experiments = [lwr.stages(name, copy) for name in lwr.courses]
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    compute_stages(experiments, NEEDED)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    compute_stages(experiments[:1], NEEDED)
    assert not (copy / "stages").exists()


def test_the_groups_of_a_large_experiment_are_shared(lwr, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(stage_pool, "LARGE", 50)
    monkeypatch.setattr(groups, "READINGS", 10_000)
    shutil.copytree(lwr.processed / "trials", tmp_path / "trials")
    shutil.copytree(lwr.processed / "samples", tmp_path / "samples")
    own = lwr.stages("delay-2", tmp_path)
    assert len(own.samples.parts) > 2
    assert own.count_new_trials() == own.trials.num_rows
    needed = {*NEEDED, "model", "damping", "mass", "outcome", "overshoot", "settling", "energy", "windows"}
    compute_stages([own], needed)
    monkeypatch.undo()
    alone = lwr.stages("delay-2")
    for stage in needed:
        assert own.table(stage).equals(alone.table(stage)), stage
    assert own.count_new_trials() == 0

"""Stages of several experiments in processes of their own: the same tables as one after the other."""

from __future__ import annotations

import os
import shutil

from pipeline.comparison.stage_pool import compute_stages
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
        assert not own._tables, "they were computed elsewhere"
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

"""What a comparison tells where logs are odd: nothing that rests on them, and why."""

from __future__ import annotations

import pipeline
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.simulation.course import run_course, write_course


def ingested(folder, device, **options):
    """Ingest a simulated course of the first experiment of a device, and return the folder of its trials."""
    write_course(run_course(device, device.experiments[0].name, **options), folder / "raw")
    ingest([folder / "raw"], folder / "processed", jobs=1)
    return folder / "processed"


def test_an_undecided_log_far_below_the_limit_moves_no_limit(tmp_path):
    """With jitter a trial at a quarter of the limit is undecided, below dozens of stable ones."""
    limits = pipeline.boundary(ingested(tmp_path, load_device("falcon"), seed=8, coarsen=4), "falcon")
    below = limits[limits["undecided"] > 0]
    assert len(below)
    assert (below["low"] >= 0.8 * below["stable"]).all(), below[["damping", "stable", "low", "estimate"]]

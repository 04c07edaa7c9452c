"""A device without delay: what a fit puts below zero ends no comparison."""

from __future__ import annotations

from pathlib import Path

import pytest

import pipeline

M, DAMPER, T, STEP = 0.6, 4.0, 0.001, 2.0


def log_of(K: float, B: float, rows: int = 500, edge: int = 50, fine: int = 10) -> str:
    """A log of a device that moves half a tenth of a sample too early: integrated by Euler's method."""
    x = v = before = 0.0
    lines = [f"# device: early\n# experiment: 1\n# stiffness: {K}\n# damping: {B}\n# step: {STEP}"]
    lines += [f"# sampling_period_s: {T}\ntime_s,command,position"]
    for k in range(rows):
        force = STEP * (k >= edge) - K * x - B * (x - before) / T
        lines.append(f"{k * T!r},{force!r},{x!r}")
        before = x
        for _ in range(fine):
            v += (force - DAMPER * v) / M * T / fine
            x += v * T / fine
    return "\n".join(lines) + "\n"


@pytest.mark.slow
def test_a_delay_of_nothing_is_compared(tmp_path: Path) -> None:
    raw, processed = tmp_path / "raw", tmp_path / "processed"
    raw.mkdir()
    for K, B in [(500, 5), (1000, 10), (1500, 15), (2000, 20), (2500, 30), (3000, 20), (4000, 40), (6000, 40)]:
        (raw / f"{K}-{B}.csv").write_text(log_of(K, B), encoding="utf-8")
    pipeline.ingest([raw], processed)
    rows = pipeline.compare("early", processed).estimates
    rows = rows[rows["recommended"]].set_index("quantity")
    assert rows.loc["delay_samples", "value"] == 0
    assert 0.99 * M < rows.loc["mass", "value"] < 1.01 * M

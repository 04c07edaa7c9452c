"""Logs of decaying oscillations in the native format, as many as a benchmark needs, and the bare loop beside ingest."""

from __future__ import annotations

from pathlib import Path

import numpy as np

BODIES = 2200
"""Logs whose samples differ; further ones repeat them under another stiffness, which saves time in preparation."""

BARE = """
import sys
from pathlib import Path
import pyarrow as pa, pyarrow.csv as csv, pyarrow.parquet as pq
options = csv.ReadOptions(skip_rows=10)
files = sorted(Path(sys.argv[1]).iterdir())
tables = [csv.read_csv(file, read_options=options) for file in files]
pq.write_table(pa.concat_tables(tables, promote_options="permissive"), sys.argv[2])
"""


def wall(number: int) -> tuple[float, float]:
    """Stiffness [N/m] and damping [Ns/m] of a log."""
    return 100.0 + number, float(number % 180)


def text_of(stiffness: float, damping: float, body: str, experiment: int = 1) -> str:
    header = {
        "device": "falcon",
        "experiment": f"{experiment}",
        "stiffness": f"{stiffness:g} [N/m]",
        "damping": f"{damping:g} [Ns/m]",
        "step": "8 [N]",
        "sampling_period_s": "0.001",
        "added_delay_samples": "0",
        "grip": "none",
        "motion": "translation",
        "origin": "simulated",
    }
    return "".join(f"# {key}: {value}\n" for key, value in header.items()) + "time_s,command,position\n" + body


def write_logs(folder: Path, logs: int, rows: int, experiments: int = 1) -> list[str]:
    """Write logs of decaying oscillations with the quantum of a sensor; returns their samples as text.

    All differ by their stiffness; their experiments take turns. The command obeys the header, as that of most logs
    does: an ingest looks longer at the others.
    """
    folder.mkdir(parents=True)
    random = np.random.default_rng(0)
    time_s = np.arange(rows) * 1e-3
    bodies = []
    for number in range(min(logs, BODIES)):
        decay, frequency, (stiffness, damping) = random.uniform(3, 30), random.uniform(20, 200), wall(number)
        x = 0.12 - 1e-3 * (1 - np.exp(-decay * time_s) * np.cos(frequency * time_s)) + random.normal(size=rows) * 2e-6
        x = np.round(x / 2e-6) * 2e-6
        command = 8 + stiffness * (x[0] - x) - damping * np.diff(x, prepend=x[:1]) / 1e-3
        values = zip(time_s.tolist(), command.tolist(), x.tolist(), strict=True)
        bodies.append("".join(["%.17g,%.17g,%.17g\n" % row for row in values]))  # noqa: UP031  three times faster
    for number in range(logs):
        text = text_of(*wall(number), bodies[number % BODIES], 1 + number % experiments)
        (folder / f"{number:06d}.csv").write_text(text, encoding="utf-8")
    return bodies

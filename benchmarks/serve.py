"""The service: lists of 100,000 trials under readers, uploads, memory while jobs run, first paint, kills.

The trials are copies of one log under names of their own, in 50 experiments; nothing is computed of them. Uploads are
held against ``pipeline ingest`` of the same logs, both on the server's core. First paint needs Chromium and Playwright.
Prints one JSON document a part, each number beside its limit.

    python benchmarks/serve.py [--parts lists,readers,uploads,jobs,paint,kills] [--trials 100000] [--logs 2200]
                               [--seconds 60] [--kills 50]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from serve_writes import jobs, kills, paint, uploads
from serving import read_for, read_together, serving

from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.records.table_files import read_table
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.store.batch_files import GROUP_TRIALS, ExperimentKey, write_batch
from pipeline.store.storage import trials_files

EXPERIMENTS, READERS, REQUESTS, MANY_READERS = 50, 20, 2000, 200
QUERIES = (
    "/api/v1/trials?limit=100",
    "/api/v1/trials?sort=-stiffness&limit=100",
    "/api/v1/trials?experiment=7&stiffness_min=2000&sort=damping",
    "/api/v1/trials?q=9f&limit=50",
    "/api/v1/experiments?device=falcon",
    "/trials?sort=-stiffness",
    "/trials?experiment=12",
    "/",
)
TRIALS_SHOWN = 50


def store(folder: Path, trials: int) -> None:
    course = run_sweep(load_device("falcon"), "1", ideal=True, coarsen=12)
    write_sweep(course, folder / "raw")
    ingest([folder / "raw"], folder / "processed")
    (file,) = trials_files(folder / "processed")
    table = read_table(file)
    chance = np.random.default_rng(0)
    for number in range(1, EXPERIMENTS + 1):
        rows = trials // EXPERIMENTS
        part = table.take(pa.array(np.arange(rows) % table.num_rows))
        name = [f"{number:04x}{row:012x}" for row in chance.permutation(rows)]
        values = {
            "trial_id": name,
            "experiment": [str(number)] * rows,
            "source_path": [f"/logs/{n}.csv" for n in name],
            "source_sha256": [n * 4 for n in name],
            "stiffness": chance.uniform(100, 20_000, rows).round(-1),
        }
        for column, new in values.items():
            index = part.schema.get_field_index(column)
            part = part.set_column(index, part.schema.field(column), pa.array(new))
        parts = (part.slice(first, GROUP_TRIALS) for first in range(0, rows, GROUP_TRIALS))
        write_batch(folder / "processed", ExperimentKey("falcon", str(number), "translation"), parts)
    file.unlink()


def lists(folder: Path, trials: int) -> dict[str, object]:
    """Times of list pages and of pages of trials, of the start, and of the first list."""
    store(folder, trials)
    with serving(folder, "--read-only") as server:
        result: dict[str, object] = {"trials": trials, "start_s": server.start_s}
        result["first_list_s"] = read_together(server.port, QUERIES[:1], 1, 1)[0] / 1e3
        alone = {query: float(np.median(read_together(server.port, (query,), 1, 20))) for query in QUERIES}
        before = server.processor_ms()
        times = read_together(server.port, QUERIES, READERS, REQUESTS)
        result |= {"alone_ms": alone, "lists_p50_ms": float(np.median(times))}
        result["processor_ms_a_request"] = (server.processor_ms() - before) / REQUESTS
        result["lists_peak_MiB"] = server.peak_mib()
        pages = tuple(f"/trials/{k % EXPERIMENTS + 1:04x}{k:012x}" for k in range(TRIALS_SHOWN))
        trial = read_together(server.port, pages, 1, 4 * TRIALS_SHOWN)
        result |= {"lists_p95_ms": float(np.quantile(times, 0.95)), "readers": READERS, "requests": REQUESTS}
        return result | {"trial_p95_ms": float(np.quantile(trial, 0.95)), "peak_MiB": server.peak_mib()}


def readers(folder: Path, seconds: float) -> dict[str, object]:
    """Readers that ask without a pause; needs the folder of `lists`."""
    with serving(folder, "--read-only") as server:
        answered, failed = read_for(server.port, QUERIES, MANY_READERS, seconds)
        told = {"readers": MANY_READERS, "seconds": seconds, "answered": answered, "failed": failed}
        return told | {"peak_MiB": server.peak_mib()}


PARTS = ("lists", "readers", "uploads", "jobs", "paint", "kills")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--trials", type=int, default=100_000)
    parser.add_argument("--logs", type=int, default=2200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--kills", type=int, default=50)
    asked = parser.parse_args()
    chosen = set(asked.parts.split(","))
    if unknown := chosen - set(PARTS):
        parser.error(f"no part {sorted(unknown)[0]!r}; there are {', '.join(PARTS)}")
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}", flush=True)
    with tempfile.TemporaryDirectory() as name:
        large, lab, killed = (Path(name) / part for part in ("large", "lab", "killed"))
        run = {
            "lists": partial(lists, large, asked.trials),
            "readers": partial(readers, large, asked.seconds),
            "uploads": partial(uploads, lab, asked.logs),
            "jobs": partial(jobs, lab),
            "paint": partial(paint, lab),
            "kills": partial(kills, killed, asked.kills),
        }
        needs = {"readers": ("lists",), "jobs": ("uploads",), "paint": ("uploads",)}
        for part in PARTS:
            if part in chosen or any(part in needs.get(other, ()) for other in chosen):
                print(json.dumps({part: run[part]()}, indent=1), flush=True)


if __name__ == "__main__":
    main()

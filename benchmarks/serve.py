"""List pages of 100,000 trials: time of a request with 20 readers at once, of the first one, and memory of the server.

The trials are copies of one log under names of their own, in 50 experiments; nothing is computed of them.

    python benchmarks/serve.py [--trials 100000]
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.records.table_files import read_table, write_table
from pipeline.simulation.course import run_course, write_course
from pipeline.store.storage import trials_files, trials_folder

EXPERIMENTS, READERS, REQUESTS = 50, 20, 2000
QUERIES = (
    "/api/v1/trials?limit=100",
    "/api/v1/trials?sort=-stiffness&limit=100",
    "/api/v1/trials?experiment=7&stiffness_min=2000&sort=damping",
    "/api/v1/trials?q=9f&limit=50",
    "/api/v1/experiments?device=falcon",
    "/trials?sort=-stiffness",
    "/trials?experiment=12",
)


def store(folder: Path, trials: int) -> None:
    course = run_course(load_device("falcon"), "1", ideal=True, coarsen=12)
    write_course(course, folder / "raw")
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
        target = trials_folder(folder / "processed", "falcon", str(number)) / "000001-copies.parquet"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_table(target, part)
    file.unlink()


def get(port: int, path: str) -> float:
    began = time.perf_counter()
    connection = HTTPConnection("127.0.0.1", port, timeout=120)
    connection.request("GET", path)
    response = connection.getresponse()
    content = response.read()
    connection.close()
    if response.status != 200:
        raise SystemExit(f"{path}: {response.status} {content[:300]!r}")
    return time.perf_counter() - began


def processor_ms(process: int) -> float:
    """Processor time of a process [ms]; Linux alone tells it."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * 1e3 / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100_000)
    trials = parser.parse_args().trials
    with tempfile.TemporaryDirectory() as name, socket.socket() as free:
        folder = Path(name)
        store(folder, trials)
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        command = [sys.executable, "-m", "pipeline", "serve", "--read-only", "--port", str(port)]
        began = time.perf_counter()
        with subprocess.Popen(
            [*command, "--processed", folder / "processed", "--reports", folder / "reports"], stderr=subprocess.DEVNULL
        ) as server:
            while True:
                try:
                    get(port, "/api/v1/health")
                    break
                except OSError:
                    time.sleep(0.02)
            start = time.perf_counter() - began
            result = {"trials": trials, "start_s": start, "first_list_s": get(port, QUERIES[0])}
            alone = {query: float(np.median([get(port, query) for _ in range(20)])) * 1e3 for query in QUERIES}
            before = processor_ms(server.pid)
            with ThreadPoolExecutor(READERS) as pool:
                times = list(pool.map(lambda i: get(port, QUERIES[i % len(QUERIES)]), range(REQUESTS)))
            result |= {"alone_ms": alone, "p50_ms": 1e3 * float(np.median(times))}
            result |= {"p95_ms": 1e3 * float(np.quantile(times, 0.95)), "requests": REQUESTS, "readers": READERS}
            result["processor_ms_a_request"] = (processor_ms(server.pid) - before) / REQUESTS
            status = Path(f"/proc/{server.pid}/status")
            if status.is_file():
                peak = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
                result["peak_MiB"] = int(peak.split()[1]) / 1024
            server.terminate()
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()

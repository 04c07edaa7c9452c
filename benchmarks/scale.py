"""Stages of many experiments: this machine's pool beside Dask with one worker and with two, in a folder and in S3.

    python benchmarks/scale.py [--experiments 200] [--logs 300] [--no-s3]

Each experiment is a copy of one simulated course of the LWR under its own name, ingested from its logs. Printed are
wall time, processor time of all processes, and the largest memory of a worker. On a machine that does other work, too,
wall times say little, and a worker of Dask keeps itself up all that time (its rate is measured while it is idle). Two
more columns say what a free machine would need, from processor times without that upkeep: of all processes, and of
the longest path, which is the command and the busiest worker. Last come the requests of a job, the bytes of a log, and
what 10,000 experiments of 2,000 logs come to (docs/storage.md). S3 is the server of moto.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import psutil

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from clusters import S3, Cluster, dask, moto

from pipeline.comparison.executors import Executor, executor_of
from pipeline.comparison.scene.scene import needed_stages, open_scene
from pipeline.comparison.stage_pool import compute_stages, do, job_of
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.store.objects import Objects, opened, stored_by
from pipeline.store.storage import read_trials

DEVICE, COURSE = "lwr", "delay-2"
EXPERIMENTS, LOGS = 200, 300
SPEEDUP, OVERHEAD, MEMORY_MIB = 1.7, 0.15, 600
"""Limits: two workers over one at least, Dask over the local pool at most, and memory of a worker."""

IDLE_S = 5.0
"""How long idle workers are looked at [s]."""

LARGE_EXPERIMENTS, LARGE_LOGS = 10_000, 2000


@dataclass
class Cost:
    """What a run took: wall time, processor time of the command, and of each worker or pool process [s]."""

    wall: float
    command: float
    workers: tuple[float, ...]
    memory_mib: float

    upkeep: float = 0.0
    """Processor time of an idle worker in each second of wall time."""

    @property
    def processor(self) -> float:
        """Processor time of all processes [s]."""
        return self.command + sum(self.workers)

    @property
    def jobs(self) -> tuple[float, ...]:
        """Processor time of each worker without its upkeep [s]."""
        return tuple(spent - self.upkeep * self.wall for spent in self.workers)

    @property
    def path(self) -> float:
        """What a free machine would need of wall time: the command, and the busiest worker with its upkeep [s]."""
        return self.command + max(self.jobs) * (1 + self.upkeep)

    @property
    def total(self) -> float:
        """What a free machine would need of processor time [s]."""
        return self.command + sum(self.jobs) + len(self.jobs) * self.upkeep * self.path


def write_logs(folder: Path, experiments: int, logs: int) -> Path:
    """Write the logs of all experiments; one after the other has other bytes in its header alone."""
    write_sweep(run_sweep(load_device(DEVICE), COURSE, seed=1), folder / "once")
    files = sorted((folder / "once").rglob("*.csv"))
    if len(files) < logs:
        raise SystemExit(f"a course has {len(files)} logs; expected --logs of that at most, found {logs}")
    chosen = [files[number * len(files) // logs] for number in range(logs)]
    texts = {file.name: file.read_text(encoding="utf-8") for file in chosen}
    for number in range(experiments):
        place = folder / "raw" / f"{number:05d}"
        place.mkdir(parents=True)
        for name, text in texts.items():
            header = text.replace(f"# experiment: {COURSE}\n", f"# experiment: {number:05d}\n", 1)
            (place / name).write_text(header, encoding="utf-8")
    return folder / "raw"


def times(processes: Sequence[int]) -> tuple[float, ...]:
    """Return the processor time of processes so far [s]."""
    found = [psutil.Process(pid).cpu_times() for pid in processes]
    return tuple(one.user + one.system for one in found)


def peak_mib(process: int) -> float:
    """Return the largest memory that a process had [MiB]."""
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def measured(processed: str | Path, executor: Executor, cluster: Cluster | None) -> Cost:
    """Compute all stages of a store by an executor."""
    workers = [] if cluster is None else [worker.pid for worker in cluster.workers]
    upkeep = idle_rate(workers)
    before, children = times(workers), resource.getrusage(resource.RUSAGE_CHILDREN)
    began, own = time.perf_counter(), time.process_time()
    with opened(processed, DEVICE) as folder:
        data = open_scene(DEVICE, folder, None, None)
        needed = needed_stages(data)
        executor(data.experiments, needed)
        assert all(one.is_stored(stage) for one in data.experiments for stage in needed) or cluster is None
    wall, command = time.perf_counter() - began, time.process_time() - own
    after, ended = times(workers), resource.getrusage(resource.RUSAGE_CHILDREN)
    if cluster is None:
        pool = ended.ru_utime + ended.ru_stime - children.ru_utime - children.ru_stime
        # of processes that ended only the sum and the largest are known; the pool shares its work evenly
        return Cost(wall, command, (pool / 2, pool / 2), ended.ru_maxrss / 1024)
    spent = tuple(late - early for early, late in zip(before, after, strict=True))
    return Cost(wall, command, spent, max(map(peak_mib, workers)), upkeep)


def idle_rate(workers: Sequence[int]) -> float:
    """Return the processor time that idle workers take in each second, on average."""
    if not workers:
        return 0.0
    before = times(workers)
    time.sleep(IDLE_S)
    return (sum(times(workers)) - sum(before)) / len(workers) / IDLE_S


@contextmanager
def trials_only(processed: Path) -> Iterator[Path]:
    """Take away the stages of a folder."""
    shutil.rmtree(processed / "stages", ignore_errors=True)
    yield processed


def show(name: str, cost: Cost) -> None:
    """Print a row."""
    each = " ".join(f"{one:.1f}" for one in cost.workers)
    numbers = (cost.wall, cost.processor, cost.total, cost.path, cost.memory_mib)
    print(f"{name:<22}" + "".join(f"{number:11.1f}" for number in numbers) + f"  {each}", flush=True)


def runs(folder: Path, processed: Path, s3: S3 | None, raw: Path) -> dict[str, Cost]:
    """Measure all executors."""
    found: dict[str, Cost] = {}
    head = ("wall s", "proc. s", "free: proc.", "free: wall", "worker MiB")
    print(f"{'':<22}" + "".join(f"{word:>11}" for word in head) + "  processor s of each worker", flush=True)
    with trials_only(processed) as place:
        show("local, two processes", found.setdefault("local", measured(place, compute_stages, None)))
    for workers in (1, 2):
        (folder / f"dask{workers}").mkdir()
        with dask(folder / f"dask{workers}", workers, None if s3 is None else s3.env) as cluster:
            executor = executor_of(cluster.address)
            with trials_only(processed) as place:
                show(
                    f"Dask, {workers} of them", found.setdefault(f"dask {workers}", measured(place, executor, cluster))
                )
            if s3 is not None and workers == 2:
                url = s3.url("scale")
                began = time.process_time()
                stored_by(url, lambda place: ingest([raw], place))
                print(f"ingest into S3: {time.process_time() - began:.1f} s of processor time")
                show("Dask, 2, in S3", found.setdefault("s3", measured(url, executor, cluster)))
    return found


def requests(url: str, raw: Path) -> dict[str, int]:
    """Return the requests that the job of one experiment makes, from its trials to its stages."""
    made: list[Objects] = []
    original = Objects.__init__

    def kept(self: Objects, place: str) -> None:
        original(self, place)
        made.append(self)

    stored_by(url, lambda place: ingest([raw], place))
    with opened(url, DEVICE) as folder:
        data = open_scene(DEVICE, folder, None, None)
        job = job_of(data.experiments[0], needed_stages(data))
        with patch.object(Objects, "__init__", kept):
            do(job, stored_suffices=True)
    return dict(made[0].requests)


def verdicts(found: dict[str, Cost]) -> None:
    """Print the numbers that have limits."""
    for kind, name in (("wall", "wall"), ("path", "free")):
        ratio = getattr(found["dask 1"], kind) / getattr(found["dask 2"], kind)
        print(f"two workers over one, {name} {ratio:.2f} (limit {SPEEDUP}): {'yes' if ratio >= SPEEDUP else 'NO'}")
    for kind, name in (("wall", "wall"), ("total", "free")):
        more = getattr(found["dask 2"], kind) / getattr(found["local"], kind) - 1
        print(f"Dask over the pool, {name}  {more:+.1%} (limit {OVERHEAD:.0%}): {'yes' if more <= OVERHEAD else 'NO'}")
    memory = max(cost.memory_mib for name, cost in found.items() if name != "local")
    print(
        f"memory of a worker         {memory:.0f} MiB (limit {MEMORY_MIB}): {'yes' if memory <= MEMORY_MIB else 'NO'}"
    )


def outlook(processed: Path, found: dict[str, Cost], trials: int, ingest_s: float, made: dict[str, int]) -> None:
    """Print what each log costs, and what many of them come to."""
    sizes = {
        tree: sum(file.stat().st_size for file in (processed / tree).rglob("*.parquet")) / trials
        for tree in ("samples", "trials", "stages")
    }
    stages_s = found["dask 2"].total / trials
    print(f"a log: ingest {1e3 * ingest_s / trials:.2f} ms, stages {1e3 * stages_s:.2f} ms of processor time")
    print("a log stored: " + ", ".join(f"{tree} {size:.0f} bytes" for tree, size in sizes.items()))
    print(f"requests of an experiment's job: {made}")
    logs = LARGE_EXPERIMENTS * LARGE_LOGS
    hours = logs * (ingest_s / trials + stages_s) / 3600
    stages_h = logs * stages_s / 3600
    size_tb, asked = logs * sum(sizes.values()) / 1e12, LARGE_EXPERIMENTS * sum(made.values())
    print(f"{LARGE_EXPERIMENTS} experiments of {LARGE_LOGS} logs: {hours:.0f} core hours ({stages_h:.0f} for stages);")
    print(f"  {size_tb:.2f} TB; {asked} requests of jobs")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", type=int, default=EXPERIMENTS)
    parser.add_argument("--logs", type=int, default=LOGS)
    parser.add_argument("--no-s3", action="store_true", help="leave out the object store")
    given = parser.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        s3 = None if given.no_s3 else stack.enter_context(moto())
        os.environ.update({} if s3 is None else s3.env)
        raw = write_logs(folder, given.experiments, given.logs)
        began = time.process_time()
        report = ingest([raw], folder / "processed")
        ingest_s = time.process_time() - began
        rows = sum(read_trials(folder / "processed", DEVICE).column("rows").to_pylist())
        print(
            f"{given.experiments} experiments of {given.logs} logs, {rows / report.ingested:.0f} rows a log;", end=" "
        )
        print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}", flush=True)
        found = runs(folder, folder / "processed", s3, raw)
        verdicts(found)
        made = {} if s3 is None else requests(s3.url("one"), raw / "00000")
        outlook(folder / "processed", found, report.ingested, ingest_s, made)


if __name__ == "__main__":
    main()

"""Processor time of all that passes logs row by row: fits, comparisons, the demo, and compiling.

    python benchmarks/rows.py [--only fit,demo] [--experiments 10] [--logs 20000] [--repeats 1]

Each row states processor seconds of all its processes (the least of the repeats), the ratio to a reference in the same
run, the peak memory of the largest process, a limit and an aim. References: for fits a least squares fit by numpy of
acceleration to velocity and command; for compiling the import of numba; else a bare loop over the same logs with
pyarrow. Logs are simulated. The time of the experiments is scaled to 500. Compiled loops come from the user's cache,
except in the row that compiles them. Nothing here fails on a slow machine.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from growth import lengthened, simulated, stored
from logs import BARE
from timing import PIPELINE, Spent, run

FIT = """
import json, sys, time
import numpy as np
from pipeline.device_data.devices import load_device
from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.recordings import Recording
from pipeline.simulation.sweep import run_sweep
device, experiment, coarsen, count = sys.argv[1:]
course = run_sweep(load_device(device), experiment, seed=1, coarsen=int(coarsen))
logs = [
    Recording(each.trial_id, each.time, each.command, each.position, each.sampling_period_s) for each in course.trials
]
if int(count):
    whole = [log for log in logs if len(log.time) == 400]
    logs = [whole[place] for place in np.linspace(0, len(whole) - 1, int(count) + 2).astype(int)[1:-1]]

def least_squares():
    of, to = [], []
    for log in logs:
        speed = np.gradient(log.position, log.period)
        of.append(np.column_stack((speed, log.command)))
        to.append(np.gradient(speed, log.period))
    return np.linalg.lstsq(np.concatenate(of), np.concatenate(to))

def processor(work):
    began = time.process_time()
    work()
    return time.process_time() - began

identified(logs[:2])
reference = min(processor(least_squares) for _ in range(20))
print(json.dumps({"seconds": processor(lambda: identified(logs)), "reference": reference, "logs": len(logs)}))
"""
"""Fits a device: followed by device, experiment, how coarse the course is, and how many logs of 400 rows (0: all)."""

STAGES = """
import sys, time
from pathlib import Path
from pipeline.comparison.scene.scene import needed_stages, open_scene
data = open_scene("falcon", Path(sys.argv[1]), None, None)
for experiment in data.experiments:
    for stage in sorted(needed_stages(data)):
        experiment.table(stage)
    print(time.process_time())
"""
"""Computes all stages of each experiment, and prints the processor time after each."""

COMPILE = """
import pipeline.comparison.stage_pool, pipeline.simulation.simulate
from pipeline.base.compiled import load_compiled
load_compiled()
"""

LOGS, MANY, EXPERIMENTS, SCALED_TO = 2220, 20_000, 10, 500


@dataclass(frozen=True)
class Row:
    """A row of the table: processor seconds, those of its reference, peak memory [MiB], limit and aim [s]."""

    name: str
    seconds: float
    reference: float
    mebibytes: float
    limit: float
    aim: float


@dataclass(frozen=True)
class Asked:
    """What was asked for on the command line."""

    folder: Path
    repeats: int
    experiments: int
    logs: int

    def place(self, name: str) -> Path:
        """Return a new folder."""
        (self.folder / name).mkdir()
        return self.folder / name

    def least(self, work: Callable[[], Spent]) -> Spent:
        """Return the run with the least processor time."""
        return min((work() for _ in range(self.repeats)), key=lambda spent: spent.processor)

    def bare(self, logs: Path) -> float:
        """Return the processor time of a bare loop over logs."""
        words = [sys.executable, "-c", BARE, str(logs), str(self.folder / "bare.parquet")]
        return self.least(lambda: run(words)).processor


def compiling(asked: Asked) -> Iterator[Row]:
    """Compile all loops in an empty folder."""

    def compile_once() -> Spent:
        with tempfile.TemporaryDirectory() as cache:
            os.environ["NUMBA_CACHE_DIR"] = cache
            try:
                return run([sys.executable, "-c", COMPILE])
            finally:
                del os.environ["NUMBA_CACHE_DIR"]

    reference = asked.least(lambda: run([sys.executable, "-c", "import numba"])).processor
    spent = asked.least(compile_once)
    yield Row("compile all loops once", spent.processor, reference, spent.mebibytes, 40.0, 20.0)


def fits(asked: Asked) -> Iterator[Row]:
    """Fit devices to logs in memory."""
    works = {
        "fit of 2 logs with jitter": (("falcon", "1", "4", "2"), 0.8, 0.3),
        "fit of falcon, experiment 1": (("falcon", "1", "2", "0"), 6.0, 3.0),
        "fit with friction": (("falcon-real", "1", "4", "0"), 12.0, 6.0),
    }
    for name, (words, *wanted) in works.items():
        spent = [run([sys.executable, "-c", FIT, *words]) for _ in range(asked.repeats)]
        results = [json.loads(process.output) for process in spent]
        seconds, reference = (min(result[kind] for result in results) for kind in ("seconds", "reference"))
        memory = min(process.mebibytes for process in spent)
        yield Row(f"{name} ({results[0]['logs']} logs)", seconds, reference, memory, *wanted)


def comparisons(asked: Asked) -> Iterator[Row]:
    """Compare an experiment for the first time, and with one log more; its theory is stored."""
    place = asked.place("comparisons")
    logs = simulated(place, LOGS)
    run(stored(place / "before", logs), place / "before")
    shutil.copytree(place / "before" / "processed" / "theory", place / "theory")
    reference = asked.bare(place / "before" / "raw")
    first, more = [], []
    for turn in range(asked.repeats):
        folder = place / f"{turn}"
        compare = stored(folder, logs)
        first.append(run(compare, folder))
        lengthened(logs[LOGS // 3], 399, folder / "raw" / "more.csv")
        run([*PIPELINE, "ingest", "raw"], folder)
        more.append(run(compare, folder))
    for name, runs, *wanted in ((f"compare {LOGS:,} logs", first, 14.0, 8.0), ("one log more", more, 6.0, 3.0)):
        least = min(runs, key=lambda process: process.processor)
        yield Row(name, least.processor, reference, least.mebibytes, *wanted)


def experiments(asked: Asked) -> Iterator[Row]:
    """Compute all stages of experiments of two logs each.

    The time is scaled to 500 experiments. The first one includes the time to import modules and to load machine code.
    """
    place = asked.place("experiments")
    logs = simulated(place, LOGS)
    (place / "raw").mkdir()
    for number in range(2 * asked.experiments):
        text = logs[number * len(logs) // (2 * asked.experiments)].read_text(encoding="utf-8")
        text = text.replace("# experiment: 1\n", f"# experiment: {number // 2:05d}\n", 1)
        (place / "raw" / f"{number}.csv").write_text(text, encoding="utf-8")
    run([*PIPELINE, "ingest", "raw"], place)

    def stages() -> Spent:
        shutil.rmtree(place / "processed" / "stages", ignore_errors=True)
        return run([sys.executable, "-c", STAGES, "processed"], place)

    spent = asked.least(stages)
    first, *_, last = map(float, spent.output.split())
    seconds = first + (last - first) * (SCALED_TO - 1) / (asked.experiments - 1)
    reference = asked.bare(place / "raw") * SCALED_TO / asked.experiments
    name = f"{SCALED_TO} experiments of two logs (by {asked.experiments})"
    yield Row(name, seconds, reference, spent.mebibytes, 150.0, 60.0)


def many_logs(asked: Asked) -> Iterator[Row]:
    """Compare very many logs for the first time."""
    place = asked.place("many")
    logs = simulated(place, asked.logs)
    reference, spent = 0.0, []
    for turn in range(asked.repeats):
        compare = stored(place / f"{turn}", logs)
        reference = reference or asked.bare(place / f"{turn}" / "raw")
        spent.append(run(compare, place / f"{turn}"))
    least = min(spent, key=lambda process: process.processor)
    yield Row(
        f"compare {asked.logs:,} logs (750 MiB, aim 500)", least.processor, reference, least.mebibytes, 45.0, 30.0
    )


def demo(asked: Asked) -> Iterator[Row]:
    """Run the demo."""

    def once() -> Spent:
        shutil.rmtree(asked.folder / "demo", ignore_errors=True)
        return run([*PIPELINE, "demo"], asked.place("demo"))

    spent, flat = asked.least(once), asked.place("flat")
    for number, log in enumerate((asked.folder / "demo" / "raw").rglob("*.csv")):
        (flat / f"{number}.csv").hardlink_to(log)
    yield Row("demo", spent.processor, asked.bare(flat), spent.mebibytes, 100.0, 60.0)


PARTS: dict[str, Callable[[Asked], Iterator[Row]]] = {
    "compile": compiling,
    "fit": fits,
    "compare": comparisons,
    "experiments": experiments,
    "many": many_logs,
    "demo": demo,
}


def main() -> None:
    """Print the table while it is measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(PARTS), help="separated by commas; all where not given")
    parser.add_argument("--experiments", type=int, default=EXPERIMENTS)
    parser.add_argument("--logs", type=int, default=MANY)
    parser.add_argument("--repeats", type=int, default=1)
    given = parser.parse_args()
    if unknown := set(given.only.split(",")) - set(PARTS):
        parser.error(f"no part {sorted(unknown)[0]!r}; there are {', '.join(PARTS)}")
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
    print(f"{'':<48} {'cpu s':>8} {'reference':>10} {'ratio':>9} {'MiB':>6} {'limit':>6} {'aim':>6}", flush=True)
    run([sys.executable, "-c", COMPILE])
    for name in given.only.split(","):
        with tempfile.TemporaryDirectory() as folder:
            for row in PARTS[name](Asked(Path(folder), given.repeats, given.experiments, given.logs)):
                ratio = row.seconds / row.reference
                numbers = f"{row.seconds:8.2f} {row.reference:10.4f} {ratio:9.1f} {row.mebibytes:6.0f}"
                over = "" if row.seconds <= row.limit else " over"
                print(f"{row.name:<48} {numbers} {row.limit:6g} {row.aim:6g}{over}", flush=True)


if __name__ == "__main__":
    main()

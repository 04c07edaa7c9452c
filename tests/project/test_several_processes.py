"""Ingests that are stopped or killed, that run into a full disk, and that work at the same time."""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from locks import is_free
from native_logs import FAULTS, log_text, short_log
from stored import check_whole, stored_rows

from pipeline.base import disk
from pipeline.base.errors import StoreError
from pipeline.intake import ingest as ingest_module
from pipeline.intake.ingest import ingest
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

READY = "ready"
INGEST = f"""
import sys
from pathlib import Path
from pipeline.intake import ingest as module
from pipeline.store import batch_files
module.PENDING_BYTES, batch_files.MOST_SMALL = int(sys.argv[3]), 3
print({READY!r}, flush=True)
report = module.ingest([Path(sys.argv[1])], Path(sys.argv[2]), jobs=2)
print(report.model_dump_json(exclude={{"plan"}}), flush=True)
"""


def write_logs(folder: Path, count: int, rows: int = 3) -> dict[str, float]:
    folder.mkdir()
    stiffness = {str(folder / f"{number:05d}.csv"): float(number) for number in range(count)}
    for path, value in stiffness.items():
        Path(path).write_text(short_log(value, str(int(value) % 3), rows))
    return stiffness


def start(logs: Path, processed: Path, pending: int = 20_000, **options) -> subprocess.Popen:
    """Start an ingest that makes a batch visible after so many bytes of samples; returns when it begins."""
    command = [sys.executable, "-c", INGEST, str(logs), str(processed), str(pending)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)
    assert process.stdout is not None
    assert process.stdout.readline().strip() == READY
    return process


def finish(process: subprocess.Popen) -> dict:
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return json.loads(out)


class Watcher:
    """A reader that looks at a store all the time, as a report or a notebook would."""

    def __init__(self, processed: Path) -> None:
        self.processed, self.looks, self.most = processed, 0, 0
        self.faults: list[str] = []
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.look)

    def __enter__(self) -> "Watcher":
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.thread.join()

    def look(self) -> None:
        while not self.ended.is_set():
            try:
                self.look_once()
            except Exception as error:
                self.faults.append(repr(error))
                return

    def look_once(self) -> None:
        for file in self.processed.rglob("*.parquet"):
            # merged meanwhile, so that it is gone
            try:
                pq.read_table(file).validate(full=True)
            except FileNotFoundError:
                continue
        trials = read_trials(self.processed)
        paths = trials.column("source_path").to_pylist()
        try:
            loaded = load_trials(self.processed, trials)
        except StoreError as error:
            if "their source changed" not in str(error):
                raise
            return  # a log got other content between both looks, which the reader is told
        self.looks += 1
        if len(set(paths)) != len(paths) or len(loaded) != len(paths):
            self.faults.append("a trial twice")
        if len(paths) < self.most:
            self.faults.append(f"{self.most} trials were there, then {len(paths)}")
        self.most = max(self.most, len(paths))


def kill_often(tmp_path: Path, count: int, kills: int, pending: int, rows: int) -> None:
    logs = write_logs(tmp_path / "logs", count, rows)
    process = start(tmp_path / "logs", tmp_path / "reference", pending)
    began = time.perf_counter()
    finish(process)
    whole_s = time.perf_counter() - began
    processed = tmp_path / "processed"
    moments = random.Random(1)
    former: dict[str, set[float]] = {}
    stored = 0
    with Watcher(processed) as watcher:
        for number in range(kills):
            process = start(tmp_path / "logs", processed, pending)
            # all that is left of an ingest gets shorter the more is stored; after that others are begun from nothing
            time.sleep(moments.uniform(0, whole_s * (1 - stored / count)))
            process.send_signal(signal.SIGKILL)
            process.communicate()
            assert is_free(processed)
            paths = check_whole(processed, logs, former)
            stored = len(paths - former.keys())
            if stored + len(former) >= 0.8 * count and number < kills - 1:
                # half of the logs change their content, and some of them their experiment
                for path in list(logs)[:: 2 if former else 3]:
                    former.setdefault(path, set()).add(logs[path])
                    logs[path] += count
                    Path(path).write_text(short_log(logs[path], str(int(logs[path]) % 3), rows))
                stored = count // 2
    assert watcher.faults == []
    assert watcher.looks > 3
    report = finish(start(tmp_path / "logs", processed, pending))
    assert report["found"] == report["ingested"] + report["skipped"] == count
    assert check_whole(processed, logs) == set(logs)
    assert set(stored_rows(processed).values()) == {1}
    assert stored_rows(processed).total() == count


@pytest.mark.slow
def test_sixty_kills_of_an_ingest_of_2000_logs(tmp_path):
    kill_often(tmp_path, count=2000, kills=60, pending=2_000_000, rows=400)


@pytest.mark.slow
def test_two_ingests_at_once_both_end_well(tmp_path):
    logs = write_logs(tmp_path / "logs", 300)
    processed = tmp_path / "processed"
    with Watcher(processed) as watcher:
        both = [start(tmp_path / "logs", processed) for _ in range(2)]
        reports = [finish(process) for process in both]
    assert watcher.faults == []
    assert [report["found"] for report in reports] == [300, 300]
    assert sum(report["ingested"] for report in reports) == 300
    assert check_whole(processed, logs) == set(logs)
    assert stored_rows(processed).total() == 300


def test_who_writes_is_named(tmp_path):
    processed = tmp_path / "processed"
    (tmp_path / "a.csv").write_text(short_log(1))
    said: list[str] = []
    with disk.writing(processed, 0):
        with pytest.raises(
            StoreError,
            match=rf"process {os.getpid()} on .* \(since 20.* is writing there; .* again when the other one has ended",
        ):
            ingest([tmp_path / "a.csv"], processed, wait_s=0.3, say=said.append)
        assert ingest([tmp_path / "a.csv"], processed, dry_run=True).ingested == 1
        assert read_trials(processed).num_rows == 0
    assert len(said) == 1
    assert "waiting up to 0.3 s" in said[0]
    assert ingest([tmp_path / "a.csv"], processed, wait_s=0).ingested == 1


def test_a_lock_of_a_killed_process_is_free(tmp_path):
    script = "import sys\nfrom pathlib import Path\nfrom pipeline.base.disk import writing\n"
    script += "with writing(Path(sys.argv[1])):\n    print('ready', flush=True)\n    sys.stdin.read()\n"
    command = [sys.executable, "-c", script, str(tmp_path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    with pytest.raises(StoreError, match=f"process {process.pid} on "), disk.writing(tmp_path, 0):
        pass
    process.kill()
    process.communicate()
    assert is_free(tmp_path)


@pytest.mark.slow
def test_a_file_that_may_not_grow_is_a_full_disk(tmp_path):
    logs = write_logs(tmp_path / "logs", 40, rows=400)
    processed = tmp_path / "processed"

    def small_files() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4_000, 4_000))

    process = start(tmp_path / "logs", processed, 10**9, preexec_fn=small_files)
    _, err = process.communicate()
    assert process.returncode != 0
    assert "cannot be written" in err
    assert "File too large" in err
    assert check_whole(processed, logs) == set()
    assert not list(processed.rglob("*.tmp"))
    assert finish(start(tmp_path / "logs", processed))["ingested"] == 40
    assert check_whole(processed, logs) == set(logs)


def test_a_source_that_grows_while_it_is_read_is_taken_when_it_is_finished(tmp_path):
    logs = write_logs(tmp_path / "logs", 20)
    growing = tmp_path / "logs" / "growing.csv"
    processed = tmp_path / "processed"
    growing.write_text(short_log(777.0, rows=2))
    ended = threading.Event()

    def record() -> None:
        with growing.open("a") as stream:
            for k in range(2, 100_000):
                stream.write(f"{k},{777.0 + k!r},{k}\n")
                stream.flush()
                if ended.is_set():
                    return

    recorder = threading.Thread(target=record)
    recorder.start()
    try:
        for _ in range(5):
            report = ingest([tmp_path / "logs"], processed, jobs=1)
            assert report.found == report.ingested + report.skipped + len(report.quarantined) == 21
            assert ingest([tmp_path / "logs"], processed, settle_s=60).waiting[-1] == str(growing)
    finally:
        ended.set()
        recorder.join()
    report = ingest([tmp_path / "logs"], processed, jobs=1)
    assert not report.quarantined
    logs[str(growing)] = 777.0
    assert check_whole(processed, logs) == set(logs)
    (row,) = (
        read_trials(processed, columns=["source_path", "rows"])
        .filter([path == str(growing) for path in read_trials(processed).column("source_path").to_pylist()])
        .to_pylist()
    )
    assert row["rows"] == len(growing.read_text().splitlines()) - 10


def test_an_interrupted_ingest_is_finished_by_the_next(tmp_path, logs, processed, monkeypatch):
    for number in range(6):
        (logs / f"{number}.csv").write_text(log_text(float(number + 1)))
    (logs / "0bad.csv").write_text(FAULTS["text cell"][0])
    monkeypatch.setattr(ingest_module, "PENDING_BYTES", 3 * 30 * 24)  # three logs

    def stop(done, found):
        if done == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ingest([logs], processed, jobs=1, progress=stop)
    stored = stored_rows(processed).total()
    assert 0 < stored < 6
    again = ingest([logs], processed, jobs=1)
    assert (again.ingested, again.skipped, len(again.quarantined)) == (6 - stored, stored, 1)


def test_ctrl_c_is_answered_on_stderr(tmp_path, logs):
    for number in range(3000):
        (logs / f"{number}.csv").write_text(log_text(float(number + 1), rows=200))
    process = subprocess.Popen(
        [sys.executable, "-m", "pipeline", "ingest", "logs", "--jobs", "1"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while not (tmp_path / "processed" / ".lock").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.5)  # until it reads logs
    os.kill(process.pid, signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode != 0
    assert "Traceback" not in told
    assert "Each file is complete or unchanged. Run the command again for the remaining work." in told

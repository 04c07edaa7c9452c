"""Parts of `serve.py` that write: uploads beside ``pipeline ingest``, memory while jobs run, first paint, kills."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from hashlib import sha256
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Any

import numpy as np
from logs import write_logs
from serving import Server, get, on_one_core, read_together, serving, until

from pipeline.device_data.devices import load_device
from pipeline.service.settings import Settings
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.store.storage import read_trials

ROWS = 620
OPENED = 5
NEW_LOGS = 40
"""Logs that are new before each kill; those that were not acknowledged before come first."""
AT_A_TIME = 5
LATEST_S = 3.0
"""Longest time from a start to the kill that follows."""


def uploads(folder: Path, logs: int) -> dict[str, object]:
    """Time of an upload by ``pipeline push``, to the end of its jobs' ingests, beside ``pipeline ingest``."""
    write_logs(folder / "raw", logs, ROWS)
    pipeline = [sys.executable, "-m", "pipeline"]
    began = time.perf_counter()
    command = [*pipeline, "ingest", str(folder / "raw"), "--processed", str(folder / "ingested")]
    subprocess.run(on_one_core(command), check=True, capture_output=True)
    ingest_s = time.perf_counter() - began
    with serving(folder) as server:
        began = time.perf_counter()
        subprocess.run([*pipeline, "push", str(folder / "raw"), "--to", server.url], check=True, capture_output=True)
        upload_s = time.perf_counter() - began
        _, content = get(server.port, "/api/v1/trials?limit=1")
    stored = json.loads(content)["total"]
    told = {"logs": logs, "stored": stored, "ingest_s": ingest_s, "upload_s": upload_s, "ratio": upload_s / ingest_s}
    return {**told, "limit_ratio": 2.0}


def jobs(folder: Path) -> dict[str, object]:
    """Memory of the server, and times of its pages, while the numbers and a report of a course are made."""
    course = run_sweep(load_device("falcon"), "1", ideal=True, coarsen=6)
    write_sweep(course, folder / "course")
    with serving(folder) as server:
        subprocess.run(
            [sys.executable, "-m", "pipeline", "push", str(folder / "course"), "--to", server.url],
            check=True,
            capture_output=True,
        )
        _ask(server, "POST", "/api/v1/comparisons", {"device": "falcon"})
        pages = ("/", "/trials", "/devices/falcon/experiments/1")
        times = []
        while not _idle(server.port):
            times.append(read_together(server.port, pages, 4, 12))
        shown = _ask(server, "GET", "/api/v1/trials?device=falcon&verdict=stable&limit=20")["items"]
        trials = tuple(f"/trials/{trial['id']}" for trial in shown)
        read_together(server.port, trials, 1, len(trials))
        drawn = until(lambda: _idle(server.port))
        trial = read_together(server.port, trials, 1, 100)
        told = {"pages_p95_ms": float(np.quantile(np.concatenate(times), 0.95)) if times else None}
        told |= {"drawn_trial_p95_ms": float(np.quantile(trial, 0.95)), "limit_trial_p95_ms": 150.0}
        return {**told, "all_ended": drawn, "peak_MiB": server.peak_mib(), "limit_MiB": 300.0}


def paint(folder: Path) -> dict[str, object]:
    """First contentful paint [s] of pages, the least of some openings."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return {"left_out": "no Playwright"}
    chromium = shutil.which("chromium")
    if chromium is None:
        return {"left_out": "no Chromium"}
    found: dict[str, object] = {"limit_s": 0.5}
    with serving(folder) as server, sync_playwright() as driver:
        until(lambda: _idle(server.port))
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        (device, *_) = _ask(server, "GET", "/api/v1/experiments")["items"]
        one = f"/devices/{device['device']}/experiments/{device['experiment']}"
        for path in ("/", "/trials", one):
            least = np.inf
            for _ in range(OPENED):
                page: Any = browser.new_page(viewport={"width": 1440, "height": 900})
                page.goto(server.url + path)
                page.wait_for_timeout(500)  # a page that is there at once is painted after its load
                timing = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? Infinity"
                least = min(least, float(page.evaluate(timing)) / 1e3)
                page.close()
            found[path] = least
        browser.close()
    return found


def kills(folder: Path, number: int) -> dict[str, object]:
    """Logs lost and doubled, and jobs that hang, after the server was killed during uploads and their jobs."""
    write_logs(folder / "raw", NEW_LOGS * number, ROWS)
    files = {file: sha256(file.read_bytes()).hexdigest() for file in sorted((folder / "raw").glob("*.csv"))}
    chance, kept = random.Random(0), set[str]()
    for round_ in range(1, number + 1):
        server = Server(folder)
        left = {file: name for file, name in list(files.items())[: NEW_LOGS * round_] if name not in kept}
        sender = threading.Thread(target=_send, args=(server, left, kept))
        sender.start()
        time.sleep(chance.uniform(0.0, LATEST_S))
        server.kill()
        sender.join()
    with serving(folder) as server:
        ended = until(lambda: _idle(server.port))
        states = Counter(job["state"] for job in _ask(server, "GET", "/api/v1/jobs?limit=1000")["items"])
    settings = Settings(folder / "processed", folder / "reports")
    rows = Counter(read_trials(settings.processed, columns=["source_sha256"]).column(0).to_pylist())
    told = {"kills": number, "acknowledged": len(kept), "stored": len(rows), "lost": len(kept - rows.keys())}
    hang = 0 if ended else states["queued"] + states["running"]
    return {**told, "doubled": sum(n > 1 for n in rows.values()), "hanging": hang, "states": dict(states)}


def _send(server: Server, files: dict[Path, str], kept: set[str]) -> None:
    """Upload some logs after the others until the server is gone; note the hashes of those that it acknowledged."""
    for place in range(0, len(files), AT_A_TIME):
        some = list(files)[place : place + AT_A_TIME]
        parts = [
            b'--b\r\nContent-Disposition: form-data; name="files"; filename="%b"\r\n\r\n%b\r\n'
            % (file.name.encode(), file.read_bytes())
            for file in some
        ]
        connection = HTTPConnection("127.0.0.1", server.port, timeout=30)
        with suppress(OSError, HTTPException):
            headers = {"Content-Type": "multipart/form-data; boundary=b"}
            connection.request("POST", "/api/v1/logs", b"".join([*parts, b"--b--\r\n"]), headers)
            response = connection.getresponse()
            response.read()
            if response.status == 202:
                kept.update(files[file] for file in some)
                continue
        return


def _idle(port: int) -> bool:
    """Return whether no job waits or runs."""
    counts = json.loads(get(port, "/api/v1/health")[1])["jobs"]
    return not counts.get("queued", 0) and not counts.get("running", 0)


def _ask(server: Server, method: str, path: str, document: object = None) -> Any:
    connection = HTTPConnection("127.0.0.1", server.port, timeout=120)
    body = None if document is None else json.dumps(document)
    connection.request(method, path, body, {"Content-Type": "application/json"} if body else {})
    content = connection.getresponse().read()
    connection.close()
    return json.loads(content)

"""Time and size of reports at thesis size, whole processes from stored samples: all, settling only, again, verify.

Prints a table beside the limits, and where Chromium and Playwright are there the time until the pages are drawn
(`browser.py`). Nothing here fails on a slow machine. Without a folder the thesis-size courses are simulated (minutes).

    python benchmarks/report.py [PROCESSED] [--device falcon] [--verify]
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from timing import PIPELINE, run

MB = 1e6

FULL_S = 40.0
AGAIN_S = 12.0
SHARE = 1 / 3
"""Limits: a report from samples and from stored stages [s], and the share of it that settling alone may take."""

SCENE = """\
device = "{device}"
criteria = ["settle"]
bands = [2]
figures = ["boundaries", "maps"]
tables = ["D.1", "D.3", "D.4", "D.6", "boundary", "experiments"]
overlays = ["theory"]
"""


def seconds(words: list[str], folder: Path) -> float:
    """Wall time of a command [s]."""
    return run([*PIPELINE, *words], folder).seconds


def copy_samples(processed: Path, target: Path) -> None:
    """Copy trials and samples alone, so that stages and theory are computed."""
    for name in ("trials", "samples"):
        shutil.copytree(processed / name, target / name)


def simulated(folder: Path, device: str) -> Path:
    """Simulate and ingest the full course of a device."""
    print(f"simulating {device} at thesis size ...", flush=True)
    seconds(["simulate", device, "--out", "raw", "--seed", "1"], folder)
    seconds(["ingest", "raw", "--processed", "stored"], folder)
    return folder / "stored"


def measure(device: str, stored: Path, folder: Path, *, verified: bool) -> Path:
    """Print the times of a device's reports; return the full one."""
    (folder / "scene.toml").write_text(SCENE.format(device=device), encoding="utf-8")
    copy_samples(stored, folder / "full")
    copy_samples(stored, folder / "settling")
    report = folder / f"{device}.html"
    full = ["compare", "--device", device, "--processed", "full", "--report", report.name]
    settling = ["compare", "--scene", "scene.toml", "--processed", "settling", "--report", "settling.html"]
    rows = [("full, from samples", seconds(full, folder), f"{FULL_S:g} s")]
    for path in (report, report.with_suffix(".json")):
        path.unlink()
    rows.append(("full, from stored stages", seconds(full, folder), f"{AGAIN_S:g} s"))
    rows.append(("full, nothing changed", seconds(full, folder), "1 s"))
    limit = f"{SHARE:.0%} of full: {SHARE * rows[0][1]:.1f} s"
    rows.append(("settling scene, from samples", seconds(settling, folder), limit))
    if verified:
        rows.append(("verify", seconds(["verify", report.name], folder), "–"))
    print(f"{device}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
    print(f"{'':32}{'time':>9}  limit")
    for what, time_s, limit in rows:
        print(f"{what:<32}{time_s:>7.1f} s  {limit}")
    sizes = {path.name: path.stat().st_size / MB for path in (report, folder / "settling.html")}
    print(", ".join(f"{name} {size:.2f} MB" for name, size in sizes.items()), flush=True)
    return report


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("processed", nargs="?", type=Path)
    arguments.add_argument("--device", action="append", help="falcon and lwr where not given")
    arguments.add_argument("--verify", action="store_true", help="verify the full reports, too")
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        reports = []
        for device in given.device or ["falcon", "lwr"]:
            folder = Path(temporary) / device
            folder.mkdir()
            stored = given.processed.resolve() if given.processed else simulated(folder, device)
            reports.append(measure(device, stored, folder, verified=given.verify))
        if shutil.which("chromium") and find_spec("playwright"):
            subprocess.run(
                [sys.executable, str(Path(__file__).with_name("browser.py")), *map(str, reports)], check=True
            )


if __name__ == "__main__":
    main()

"""Take `img/first-screen.png`, `service.png` and `explorer.png`, pictures of pages, in Chromium; run by ``make docs``.

They show the first part of `pipeline demo`. Needs Chromium (`apt-get install chromium`).
"""

from __future__ import annotations

import io
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from PIL import Image
from playwright.sync_api import sync_playwright

from pipeline.shell.demo import PARTS, run_demo

IMAGES = Path(__file__).parent / "img"
COLOURS = 128
"""Colours of a picture: pages have few, and it is a third as large."""

LONGEST_S = 600.0
"""Longest time until the service has compared the experiment [s]."""


def taken(browser: Any, address: str, name: str, size: tuple[int, int], ready: str, *, scrolls: bool = False) -> None:
    """Write the picture of a page as soon as it has an element; from that on if it ``scrolls``."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme="light")
    page.goto(address)
    shown = page.locator(ready).first
    shown.wait_for(timeout=1e3 * LONGEST_S)
    if scrolls:
        shown.evaluate("element => element.scrollIntoView({ behavior: 'instant' })")
    drawn = Image.open(io.BytesIO(page.screenshot()))
    few = drawn.convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(IMAGES / f"{name}.png", optimize=True)
    page.close()


def free_port() -> int:
    """Return a port of this machine that is not in use."""
    with closing(socket.socket()) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def main() -> None:
    """Simulate and compare an experiment, and take the pictures."""
    run = [sys.executable, "-m", "pipeline"]
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with tempfile.TemporaryDirectory() as name, sync_playwright() as driver:
        folder, port = Path(name), free_port()
        run_demo(folder, print, PARTS[:1])
        subprocess.run([*run, "explore", "--device", "falcon", "--out", str(folder / "explore.html")], check=True)
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        report, explorer = ((folder / page).as_uri() for page in ("reports/falcon-real.html", "explore.html"))
        taken(browser, report, "first-screen", (1440, 870), "#boundaries-answer svg")
        taken(browser, explorer, "explorer", (1400, 980), ".what-if .bar:nth-child(5)")
        words = ["serve", "--processed", str(folder / "processed" / "demo"), "--port", str(port)]
        address = f"http://127.0.0.1:{port}"
        with subprocess.Popen([*run, *words], cwd=folder) as service:
            try:
                until = time.monotonic() + LONGEST_S
                while time.monotonic() < until:
                    with suppress(OSError), urlopen(f"{address}/api/v1/health"):
                        break
                    time.sleep(0.2)
                place = f"{address}/devices/falcon-real/experiments/1"
                taken(browser, place, "service", (1000, 1000), "figure.panels svg", scrolls=True)
            finally:
                service.terminate()


if __name__ == "__main__":
    main()

"""Time until a report is drawn in headless Chromium, and what its bytes are spent on. Needs Chromium and Playwright.

Prints a table beside the limits. Nothing here fails on a slow machine.

    python benchmarks/browser.py reports/falcon.html [REPORT ...]
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

OPENED = 5
DRAWN_S = 1.5
TOTAL_MB = 2.0
WATCH = """
addEventListener("DOMContentLoaded", () => {
  const done = () => { if (document.querySelector("#trial-plot canvas")) { window.drawn ??= performance.now(); } };
  new MutationObserver(() => requestAnimationFrame(() => requestAnimationFrame(done)))
    .observe(document.getElementById("trial-plot") ?? document.body, { childList: true });
});
"""


def seconds(browser: Browser, path: Path) -> dict[str, float]:
    """Least time [s] of several openings from the begin of the navigation until figures and response are drawn."""
    found: dict[str, list[float]] = {"first paint": [], "figures": [], "response of a trial": []}
    for _ in range(OPENED):
        page: Any = browser.new_page(viewport={"width": 1440, "height": 900})
        page.add_init_script(WATCH)
        page.goto(path.resolve().as_uri())
        while not page.evaluate("window.drawn ?? 0"):
            page.wait_for_timeout(20)
        paint = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? 0")
        load = page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd")
        for name, value in zip(found, (paint, load, page.evaluate("window.drawn")), strict=True):
            found[name].append(value / 1e3)
        page.close()
    return {name: min(values) for name, values in found.items()}


def sizes(text: str) -> dict[str, float]:
    """Megabytes of the parts of a page."""

    def of(pattern: str) -> float:
        return sum(len(part.encode()) for part in re.findall(pattern, text, flags=re.DOTALL)) / 1e6

    parts = {"figures": of(r"<svg\b.*?</svg>"), "trials and scripts": of(r"<script\b.*?</script>")}
    return parts | {"all else": len(text.encode()) / 1e6 - sum(parts.values())}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("reports", nargs="+", type=Path)
    reports = arguments.parse_args().reports
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("no Chromium: apt-get install chromium")
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}; least of {OPENED} openings")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for path in reports:
            text = path.read_text(encoding="utf-8")
            print(f"\n{path.name}: {len(text.encode()) / 1e6:.2f} MB (limit {TOTAL_MB:g})")
            for name, size in sizes(text).items():
                print(f"  {name:<22}{size:>6.2f} MB")
            for name, time_s in seconds(browser, path).items():
                print(f"  {name:<22}{time_s:>6.2f} s  (limit {DRAWN_S:g})")
        browser.close()


if __name__ == "__main__":
    main()

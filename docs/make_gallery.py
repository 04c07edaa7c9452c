"""Make `gallery.md`: figures as `pipeline compare --figures DIR` writes them, of simulated devices (``make docs``)."""

from __future__ import annotations

import tempfile
from pathlib import Path

from pipeline.shell.cli import run

PAGE = Path(__file__).with_name("gallery.md")
IMAGES = Path(__file__).parent / "img" / "gallery"

COURSES = {"falcon-real": ("1", "4", "7"), "lwr": ("delay-2", "2", "7")}
"""Experiment, coarseness and seed of the simulated course of each device."""

SHOWN = {
    ("falcon-real", "boundaries-answer-0"): (
        "Where a device is stable, and which walls to use",
        "Measured limits with 95 % intervals lie above the theory of a loop without friction: the device has some. The "
        "first figure of each report.",
    ),
    ("falcon-real", "first-response-0"): (
        "One response",
        "A wall that rings: the period of the oscillation, and where the device should come to rest.",
    ),
    ("lwr", "boundaries-answer-0"): (
        "A light-weight robot behind two samples of delay",
        "Without friction, measured limits and theory agree.",
    ),
    ("falcon-real", "experiment-1-overshoot-0"): (
        "Overshoot over all walls, theory",
        "Lines of equal cost, the stability boundary, and the stiffest wall without overshoot.",
    ),
    ("falcon-real", "experiment-1-overshoot-1"): (
        "The same, measured",
        "From the logs alone, of a device with friction.",
    ),
}
"""Figures by device and name of their file, with heading and caption."""


def command(*words: str) -> None:
    """Run a command of the package, which must succeed."""
    try:
        run(words)
    except SystemExit as leaving:
        if leaving.code:
            raise


def main() -> None:
    """Simulate the courses, compare them, and keep the figures with a page that shows them."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    lines = ["# Gallery", ""]
    lines += [
        "Each figure is one that `pipeline compare --figures DIR` writes beside a report; the devices are simulated.",
        "",
    ]
    with tempfile.TemporaryDirectory() as name:
        for device, (experiment, coarsen, seed) in COURSES.items():
            raw, store = f"{name}/raw", f"{name}/processed"
            course = ("--experiment", experiment, "--coarsen", coarsen, "--seed", seed, "--out", raw)
            command("simulate", device, *course)
            command("ingest", raw, "--processed", store)
            places = ("--report", f"{name}/{device}.html", "--figures", f"{name}/{device}")
            command("compare", "--device", device, "--processed", store, *places)
        for (device, figure), (title, caption) in SHOWN.items():
            target = IMAGES / f"{device}-{figure}.svg"
            target.write_text((Path(name) / device / f"{figure}.svg").read_text(encoding="utf-8"), encoding="utf-8")
            lines += [f"## {title}", "", f"![{title}](img/gallery/{target.name})", "", caption, ""]
    PAGE.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

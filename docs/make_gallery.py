"""Make `gallery.md` (``make docs``): figures of reports of simulated devices, and those of the scripts in `gallery`.

    python docs/make_gallery.py [figure_3_06 ...]

With names of scripts, these alone are drawn again; the page is written in any case.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from pipeline.shell.cli import run

PAGE = Path(__file__).with_name("gallery.md")
IMAGES = Path(__file__).parent / "img" / "gallery"
SCRIPTS = sorted((Path(__file__).parent / "gallery").glob("figure_*.py"))
CHAPTERS = {"3": "Stability", "4": "Passivity", "5": "Control design"}
"""Chapters of the thesis with data figures of theory."""

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


def compared() -> None:
    """Simulate the courses, compare them, and keep the figures."""
    with tempfile.TemporaryDirectory() as name:
        for device, (experiment, coarsen, seed) in COURSES.items():
            raw, store = f"{name}/raw", f"{name}/processed"
            course = ("--experiment", experiment, "--coarsen", coarsen, "--seed", seed, "--out", raw)
            command("simulate", device, *course)
            command("ingest", raw, "--processed", store)
            places = ("--report", f"{name}/{device}.html", "--figures", f"{name}/{device}")
            command("compare", "--device", device, "--processed", store, *places)
        for device, figure in SHOWN:
            text = (Path(name) / device / f"{figure}.svg").read_text(encoding="utf-8")
            (IMAGES / f"{device}-{figure}.svg").write_text(text, encoding="utf-8")


def drawn(script: Path) -> None:
    """Run a script in the folder of the pictures, which are the same bytes each time."""
    look = {"MPLBACKEND": "agg", "MATPLOTLIBRC": str(script.with_name("matplotlibrc")), "SOURCE_DATE_EPOCH": "0"}
    subprocess.run([sys.executable, str(script)], cwd=IMAGES, env=os.environ | look, check=True)


def page() -> str:
    """Return the page: each figure with its caption, those of scripts with their source."""
    lines = [
        "# Gallery",
        "",
        "Pictures of reports, and the thesis's figures of theory as short scripts on [`import pipeline`](python.md):",
        "copy one, change the device, and run it. A mass of 1 kg and a sampling period of 1 s make stiffness",
        "and damping the normalised α and β.",
        "",
        "## In reports",
        "",
        "As `pipeline compare --figures DIR` writes them beside a report; the devices are simulated.",
        "",
    ]
    for (device, figure), (title, caption) in SHOWN.items():
        lines += [f"### {title}", "", f"![{title}](img/gallery/{device}-{figure}.svg)", "", caption, ""]
    for chapter, heading in CHAPTERS.items():
        lines += [f"## {heading}", ""]
        for script in SCRIPTS:
            _, of, figure = script.stem.split("_")
            if of == chapter:
                tree = ast.parse(script.read_text(encoding="utf-8"))
                title, _, caption = (ast.get_docstring(tree) or "").partition("\n\n")
                lines += [
                    f"### Figure {of}.{int(figure)}: {title}",
                    "",
                    f"![{title}](img/gallery/{script.stem}.svg)",
                    "",
                ]
                lines += [caption, "", f"```{{literalinclude}} gallery/{script.name}", ":language: python"]
                lines += [f":lines: {(tree.body[0].end_lineno or 0) + 2}-", "```", ""]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Draw all figures, or those of some scripts, and write the page."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    if len(sys.argv) == 1:
        compared()
    for script in SCRIPTS:
        if len(sys.argv) == 1 or script.stem in sys.argv[1:]:
            drawn(script)
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()

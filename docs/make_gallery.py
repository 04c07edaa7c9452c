"""Make the gallery in `theory.md` (``make docs``): figures of reports of simulated devices, and those of scripts.

    python docs/make_gallery.py [figure_3_06 ...]

With names of scripts, these alone are drawn again; the section is written in any case.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from pipeline.shell.cli import run

PAGE = Path(__file__).with_name("theory.md")
SECTION = "## Gallery"
IMAGES = Path(__file__).parent / "img" / "gallery"
SCRIPTS = sorted((Path(__file__).parent / "gallery").glob("figure_*.py"))
CHAPTERS = {"3": "Stability", "4": "Passivity", "5": "Control design"}
"""Chapters of the thesis with data figures of theory."""

COURSES = {"falcon-real": ("1", "4", "7"), "lwr": ("delay-2", "2", "7")}
"""Experiment, coarseness and seed of the simulated course of each device."""

SHOWN = {
    ("falcon-real", "boundaries-answer-0"): (
        "Where a device is stable, and which walls to use",
        "Measured limits lie above a theory without friction.",
    ),
    ("falcon-real", "first-response-0"): ("One response", "A wall that rings, and its rest."),
    ("lwr", "boundaries-answer-0"): (
        "A light-weight robot behind two samples of delay",
        "Without friction limits and theory agree.",
    ),
    ("falcon-real", "experiment-1-overshoot-0"): ("Overshoot over all walls", "By theory."),
    ("falcon-real", "experiment-1-overshoot-1"): ("The same, measured", "From logs alone."),
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


def gallery() -> str:
    """Return the section: figures of scripts with their source, which begins with the caption, and of reports."""
    lines = [
        SECTION,
        "",
        "The thesis's figures of theory as short scripts on [`import pipeline`](python.md): copy one, change",
        "the device, and run it. With a mass of 1 kg and a sampling period of 1 s, K and B are the normalised α and β.",
        "",
    ]
    for chapter, heading in CHAPTERS.items():
        lines += [f"### {heading}", ""]
        for script in SCRIPTS:
            _, of, figure = script.stem.split("_")
            if of == chapter:
                tree = ast.parse(script.read_text(encoding="utf-8"))
                title = (ast.get_docstring(tree) or "").partition("\n")[0]
                number = f"Figure {of}.{int(figure)}"
                lines += [f"#### {number}: {title}", "", f"![{number}](img/gallery/{script.stem}.svg)", ""]
                lines += [f"```{{literalinclude}} gallery/{script.name}", "```", ""]
    lines += [
        "### In reports",
        "",
        "As `pipeline compare --figures DIR` writes them; the devices are simulated.",
        "",
    ]
    for (device, figure), (title, caption) in SHOWN.items():
        lines += [f"#### {title}", "", f"![{title}](img/gallery/{device}-{figure}.svg)", "", caption, ""]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Draw all figures, or those of some scripts, and replace the section."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    if len(sys.argv) == 1:
        compared()
    for script in SCRIPTS:
        if len(sys.argv) == 1 or script.stem in sys.argv[1:]:
            drawn(script)
    before = PAGE.read_text(encoding="utf-8").partition(SECTION)[0]
    PAGE.write_text(before + gallery(), encoding="utf-8")


if __name__ == "__main__":
    main()

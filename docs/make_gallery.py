"""Make the gallery in `theory.md` (``make docs``): figures of scripts.

    python docs/make_gallery.py [figure_3_06 ...]

With names of scripts, these alone are drawn again; the section is written in any case.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).with_name("theory.md")
SECTION = "## Gallery"
IMAGES = Path(__file__).parent / "img" / "gallery"
SCRIPTS = sorted((Path(__file__).parent / "gallery").glob("figure_*.py"))
CHAPTERS = {"3": "Stability", "4": "Passivity", "5": "Control design"}
"""Chapters of the thesis with data figures of theory."""


def drawn(script: Path) -> None:
    """Run a script in the folder of the pictures, which are the same bytes each time."""
    look = {"MPLBACKEND": "agg", "MATPLOTLIBRC": str(script.with_name("matplotlibrc")), "SOURCE_DATE_EPOCH": "0"}
    subprocess.run([sys.executable, str(script)], cwd=IMAGES, env=os.environ | look, check=True)


def gallery() -> str:
    """Return the section: figures of scripts with their source, which begins with the caption."""
    lines = [
        SECTION,
        "",
        "Short scripts with [`import pipeline`](python.md) draw the figures of the thesis that show theory. Copy one,",
        "change the device, and run it. With a mass of 1 kg and a sampling period of 1 s, K and B equal the normalised",
        "α and β.",
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
                lines += [f"#### {number}: {title}", "", f"![{number.split()[1]}](img/gallery/{script.stem}.svg)", ""]
                lines += [f"```{{literalinclude}} gallery/{script.name}", "```", ""]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Draw all figures, or those of some scripts, and replace the section."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    for script in SCRIPTS:
        if len(sys.argv) == 1 or script.stem in sys.argv[1:]:
            drawn(script)
    before = PAGE.read_text(encoding="utf-8").partition(SECTION)[0]
    PAGE.write_text(before + gallery(), encoding="utf-8")


if __name__ == "__main__":
    main()

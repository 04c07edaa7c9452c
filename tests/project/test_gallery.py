"""The gallery: each script is short, needs the public surface alone, and stands with its picture on the page."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

GALLERY = ROOT / "docs" / "gallery"
SCRIPTS = sorted(GALLERY.glob("figure_*.py"))
THESIS = {*(f"3.{n}" for n in range(5, 12)), *(f"4.{n}" for n in range(1, 6)), *(f"5.{n}" for n in range(1, 17))}
QUICK = ("figure_3_08", "figure_4_03", "figure_5_11")
LONGEST = 30
"""Lines of code of a script, without its caption."""


def number(script: Path) -> str:
    _, chapter, figure = script.stem.split("_")
    return f"{chapter}.{int(figure)}"


def test_every_data_figure_of_the_theory_chapters_is_there_and_on_the_page() -> None:
    assert {number(script) for script in SCRIPTS} == THESIS
    page = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
    for script in SCRIPTS:
        title = (ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or "").partition("\n")[0]
        assert f"Figure {number(script)}: {title}" in page
        assert f"gallery/{script.name}" in page
        assert (ROOT / "docs" / "img" / "gallery" / f"{script.stem}.svg").is_file()


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_is_short_and_imports_public_names_alone(script: Path) -> None:
    text = script.read_text(encoding="utf-8")
    tree = ast.parse(text)
    code = text[text.index('"""', 3) + 3 :].splitlines()
    assert len([line for line in code if line.strip()]) <= LONGEST
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(tree))
    assert imported <= {"pipeline", "numpy", "pandas", "matplotlib.pyplot"}
    assert not re.search(r"pipeline\.[a-z_]+\.|\b_[a-z]\w*\(", text)


@pytest.mark.sampled
@pytest.mark.parametrize(
    "script", [pytest.param(s, marks=() if s.stem in QUICK else pytest.mark.slow, id=s.stem) for s in SCRIPTS]
)
def test_a_script_runs_anywhere_without_a_warning(script: Path, tmp_path: Path) -> None:
    environment = os.environ | {"MPLBACKEND": "agg", "OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, "-W", "error", str(script)]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / f"{script.stem}.svg").read_text(encoding="utf-8").rstrip().endswith("</svg>")

"""The page of the thesis's theory figures: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline import __version__
from pipeline.base.disk import write_text
from pipeline.rendering.report.page_template import fill_template
from pipeline.studies.drawing import draw
from pipeline.studies.figure import TheoryFigure

CHAPTERS = {"3": "Stability", "4": "Passivity", "5": "Control design"}
"""Chapters of the thesis with data figures of theory."""


def render(figures: Sequence[TheoryFigure]) -> str:
    """Return a self-contained HTML page of the figures, deterministic, by chapter in the order given."""
    chapters = [
        (number, title, [(figure, draw(figure)) for figure in figures if figure.number.split(".")[0] == number])
        for number, title in CHAPTERS.items()
    ]
    shown = [chapter for chapter in chapters if chapter[2]]
    return fill_template("theory.html.j2", chapters=shown, version=__version__)


def write(figures: Sequence[TheoryFigure], path: Path) -> None:
    """Render the page and write it so that a reader sees all of it or nothing."""
    write_text(path, render(figures))

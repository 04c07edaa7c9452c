"""LaTeX tables through a TeX engine: they compile, also with hostile names."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from report_data import report_data

from pipeline.rendering.table_export import export_tables

LATEX = shutil.which("pdflatex")
PAGE = r"""\documentclass[10pt,twocolumn]{article}
\usepackage[utf8]{inputenc}\usepackage[T1]{fontenc}\usepackage{booktabs,array,longtable,textcomp,amsmath,amssymb}
\usepackage[paperwidth=612pt,paperheight=792pt,textwidth=516pt,columnsep=12pt]{geometry}
%s
\begin{document}
%s
\end{document}
"""
"""A page with the columns of an IEEE journal: two of 252 pt."""


def compiled(tables: list[Path], folder: Path) -> str:
    """The log of a run over some tables, long ones on pages of one column."""
    folder.mkdir()
    body = []
    for table in tables:
        long = "longtable" in table.read_text(encoding="utf-8")
        body.append((r"\onecolumn" if long else r"\twocolumn") + rf"\input{{{table}}}\clearpage")
    (folder / "page.tex").write_text(PAGE % ("", "\n".join(body)), encoding="utf-8")
    run = [LATEX, "-interaction=nonstopmode", "-halt-on-error", "page.tex"]
    done = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=False, errors="replace")
    assert done.returncode == 0, done.stdout[-3000:]
    assert (folder / "page.pdf").stat().st_size > 10_000
    return done.stdout


@pytest.mark.slow
@pytest.mark.skipif(LATEX is None, reason="no TeX: apt-get install texlive-latex-extra")
@pytest.mark.parametrize("hostile", [False, True])
def test_tables_compile(tmp_path: Path, hostile: bool) -> None:
    export_tables(report_data(hostile=hostile).result, tmp_path / "tables")
    tables = sorted((tmp_path / "tables").glob("*.tex"))
    assert len(tables) > 5
    compiled(tables, tmp_path / "all")

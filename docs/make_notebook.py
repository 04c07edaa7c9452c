"""Run the cells of notebook.ipynb and store what they print and draw; run by ``make docs``."""

from __future__ import annotations

import ast
import base64
import io
import json
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

import matplotlib

NOTEBOOK = Path(__file__).parent / "notebook.ipynb"

DOTS_PER_INCH = 100
"""Resolution of figures, with which 6 inches fill the width of a page."""


def lines_of(text: str) -> list[str]:
    """Return a text in the form in which notebooks store it."""
    return text.splitlines(keepends=True)


def run_cell(source: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    """Run a cell, and return its outputs: the printed text, the value of its last expression, and its figures."""
    from matplotlib import pyplot as plt

    tree, value, printed = ast.parse(source), None, io.StringIO()
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    with redirect_stdout(printed):
        exec(compile(tree, NOTEBOOK.name, "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), NOTEBOOK.name, "eval"), names)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        outputs.append({"name": "stdout", "output_type": "stream", "text": lines_of(printed.getvalue())})
    figures = [plt.figure(number) for number in plt.get_fignums()]
    if value is not None and not figures:
        data = {"text/plain": lines_of(repr(value))}
        if html := getattr(value, "_repr_html_", lambda: None)():
            data = {"text/html": lines_of(html)} | data
        outputs.append({"data": data, "metadata": {}, "output_type": "execute_result"})
    for figure in figures:
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=DOTS_PER_INCH, bbox_inches="tight", metadata={"Software": None})
        shown = {"image/png": base64.b64encode(picture.getvalue()).decode(), "text/plain": [repr(figure)]}
        outputs.append({"data": shown, "metadata": {}, "output_type": "display_data"})
    plt.close("all")
    return outputs


def main() -> None:
    """Run all cells in an empty folder, and write the notebook."""
    matplotlib.use("agg")
    notebook, names, count = json.loads(NOTEBOOK.read_text(encoding="utf-8")), dict[str, Any](), 0
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        for cell in notebook["cells"]:
            if cell["cell_type"] != "code":
                continue
            count += 1
            cell["execution_count"], cell["outputs"] = count, run_cell("".join(cell["source"]), names)
            for number, output in enumerate(cell["outputs"]):
                if output["output_type"] == "execute_result":
                    cell["outputs"][number] = dict(sorted({**output, "execution_count": count}.items()))
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""The explorer as an HTML file that works offline, as a panel in another page, and as a module of computations."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from html import escape
from pathlib import Path

from pipeline.base.inline_page import json_text, policy
from pipeline.explorer.entries import Entry

FOLDER = Path(__file__).parent

_TITLE, _ENTRIES = "Explore a haptic loop", "explorer-entries"

_LEAD = (
    "Move a slider, or drag the wall in the plane. The theory is exact for the linear loop of device, delay, filter "
    "and wall. It is computed on this page. The address of the page contains your settings."
)


def module() -> str:
    """Return the JavaScript module (with ``export``) of the computation. The module does not access the page."""
    return (FOLDER / "loop.mjs").read_text(encoding="utf-8")


@cache
def script() -> str:
    """Return a script that contains the computation, and shows a panel in each element with ``data-explorer``.

    The value of this attribute is the id of the element that contains the entries as JSON (`entries`).
    """
    panel = re.sub(r"^import .*?;\n", "", (FOLDER / "page.mjs").read_text(encoding="utf-8"), flags=re.MULTILINE)
    body = re.sub(r"^export ", "", f"{module()}\n{panel}", flags=re.MULTILINE)
    start = (
        'for (const root of document.querySelectorAll("[data-explorer]")) '
        "explore(root, JSON.parse(document.getElementById(root.dataset.explorer).textContent));"
    )
    return f"(() => {{\n{_without_comments(body)}\n{start}\n}})();\n"


def style() -> str:
    """Return the style sheet of a panel. The panel has the colours of the surrounding page."""
    return (FOLDER / "explorer.css").read_text(encoding="utf-8")


def panel(entries: Sequence[Entry]) -> str:
    """Return the HTML element of a panel and the element with its entries.

    The page must contain `script` and `style`.
    """
    shown = f'<div data-explorer="{_ENTRIES}"><p>This panel needs JavaScript.</p></div>'
    return f'{shown}\n<script type="application/json" id="{_ENTRIES}">{json_text(list(entries))}</script>'


def page(entries: Sequence[Entry]) -> str:
    """Return a self-contained HTML file.

    Parameters
    ----------
    entries : sequence of dict
        Loops to which the page can be reset. The page initially shows the first loop.
    """
    inline = script()
    sheet = (FOLDER / "standalone.css").read_text(encoding="utf-8") + style()
    head = (
        f'<meta charset="utf-8">\n<meta http-equiv="Content-Security-Policy" content="{escape(policy((inline,)))}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_TITLE}</title>\n<style>\n{sheet}</style>"
    )
    body = f"<header><h1>{_TITLE}</h1><p>{_LEAD}</p></header>\n<main>\n{panel(entries)}\n</main>"
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{body}\n<script>{inline}</script>\n'
        "</body>\n</html>\n"
    )


def _without_comments(text: str) -> str:
    """Return a script without its comment lines and indentation, which makes the script a third smaller."""
    plain = re.sub(r"^\s*/\*\*(?:(?!\*/).)*\*/\s*$", "", text, flags=re.MULTILINE | re.DOTALL)
    lines = (line.strip() for line in plain.splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//"))

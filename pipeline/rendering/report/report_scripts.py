"""Scripts of the report page: what they are, and the policy that lets the browser run them and nothing else.

The page makes no request to any host. Its policy forbids all but inline styles, images inside the page, and the scripts
whose hashes it names, so that a name in a log that slipped through the escaping would still not run.
"""

from __future__ import annotations

import base64
import hashlib
import json
from typing import Any

from pipeline.rendering.report.page_template import TEMPLATES

PAGE_SCRIPTS = ("report/tables.js", "report/viewer.js", "report/figures.js")
TRIALS_SCRIPTS = ("report/plane.js", "report/response.js", "report/runs.js", "report/trials.js")
PLOT = "vendor/uPlot.iife.min.js"
PLOT_LICENCE = "vendor/uPlot.LICENSE"
PLOT_STYLE = "vendor/uPlot.min.css"


def scripts(with_trials: bool) -> tuple[str, ...]:
    """Return the inline scripts of a report in their order.

    Parameters
    ----------
    with_trials : bool
        Whether the page shows trials, which asks for the plot library and its licence.
    """
    tables = "".join(script_text(name) for name in PAGE_SCRIPTS)
    if not with_trials:
        return (tables,)
    licence = f"/*! uPlot\n{script_text(PLOT_LICENCE).strip()}\n*/\n"
    return tables, licence + script_text(PLOT), "".join(script_text(name) for name in TRIALS_SCRIPTS)


def plot_style() -> str:
    """Return the style sheet of the plot library."""
    return script_text(PLOT_STYLE)


def policy(inline: tuple[str, ...]) -> str:
    """Return the Content-Security-Policy of a page with these inline scripts.

    Styles may be inline: figures and the plot library set positions and colours by style attributes.
    """
    allowed = " ".join(f"'sha256-{_hash(text)}'" for text in inline) or "'none'"
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def json_text(content: Any) -> str:
    """Return JSON that may stand inside a ``<script>`` element: it holds no ``<``, ``>`` or ``&``.

    Raises
    ------
    ValueError
        If a number is not finite, which JSON does not know.
    """
    text = json.dumps(content, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def script_text(name: str) -> str:
    """Return the text of a script or style sheet of the templates."""
    return (TEMPLATES / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()

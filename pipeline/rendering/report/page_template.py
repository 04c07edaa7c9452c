"""Render pages from templates. Text from logs is escaped, and a misspelt name in a template is an error.

A report's page makes no request to any host. Its policy allows only inline styles, images inside the page, and scripts
with the listed hashes, so that code in a log would not run even if the escaping failed.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.compiled import cache_folder
from pipeline.base.disk import read_result, write_result
from pipeline.base.inline_page import json_text as json_text
from pipeline.base.inline_page import policy as policy
from pipeline.base.wording import counted, listed
from pipeline.explorer import page as explorer
from pipeline.rendering import labels

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).parents[1] / "templates"
"""Folder of templates, style sheets, scripts and the vendored plot library."""

PAGE_SCRIPTS = ("report/tables.js", "report/viewer.js", "report/figures.js")
TRIALS_SCRIPTS = ("report/plane.js", "report/response.js", "report/runs.js", "report/trials.js")
PLOT, PLOT_LICENCE, PLOT_STYLE = "vendor/uPlot.iife.min.js", "vendor/uPlot.LICENSE", "vendor/uPlot.min.css"

FILTERS = {
    "stiffness": labels.stiffness_text,
    "damping": labels.damping_text,
    "digits": labels.significant,
    "at_least": labels.at_least,
    "at_most": labels.at_most,
    "capitalised": lambda text: text[:1].upper() + text[1:],
    "size": labels.size_text,
    "cost": lambda low, criterion, high=None: labels.cost_range_text(criterion, low, low if high is None else high),
    "rounded": labels.estimate_texts,
    "answer": labels.answer_texts,
    "percent": labels.percent_text,
    "criterion": labels.criterion_name,
    "counted": counted,
    "listed": listed,
}
"""Functions by which templates format quantities."""


def fill_template(name: str, **content: object) -> str:
    """Return a template of `TEMPLATES` with its names replaced by their content, as text of the page.

    Parameters
    ----------
    name : str
        File name of the template.
    **content : object
        Values of the names in the template. In pages (``.html.j2``), text is escaped unless the template marks it as
        safe.

    Raises
    ------
    jinja2.UndefinedError
        If the template uses a name without a value. This is a defect of the code, never of the data.
    """
    return _environment().get_template(name).render(**content)


@cache
def _environment() -> Environment:
    """Return the environment of all templates. Compiled templates are stored in the user's cache folder."""
    from jinja2 import BytecodeCache, Environment, FileSystemLoader, StrictUndefined  # 0.1 s, not for other commands
    from jinja2.bccache import Bucket

    class Stored(BytecodeCache):
        """Compiled templates as files. Compiling them takes over a second."""

        def load_bytecode(self, bucket: Bucket) -> None:
            """Read a template if it is stored and undamaged."""
            with suppress(OSError, RuntimeError):
                if (code := read_result(cache_folder(), f"template-{bucket.key}", ".bin")) is not None:
                    bucket.bytecode_from_string(code)

        def dump_bytecode(self, bucket: Bucket) -> None:
            """Store a template if the folder can be written."""
            with suppress(OSError, RuntimeError):
                write_result(cache_folder(), f"template-{bucket.key}", ".bin", bucket.bytecode_to_string())

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        bytecode_cache=Stored(),
    )
    environment.filters |= FILTERS
    return environment


def scripts(with_trials: bool, with_explorer: bool = False) -> tuple[str, ...]:
    """Return the inline scripts of a report in their order. The scripts of the trials come with the plot library."""
    found = ["".join(script_text(name) for name in PAGE_SCRIPTS)]
    if with_trials:
        licence = f"/*! uPlot\n{script_text(PLOT_LICENCE).strip()}\n*/\n"
        found += [licence + script_text(PLOT), "".join(script_text(name) for name in TRIALS_SCRIPTS)]
    return tuple(found + [explorer.script()] * with_explorer)


def script_text(name: str) -> str:
    """Return the text of a script or style sheet of the templates."""
    return (TEMPLATES / name).read_text(encoding="utf-8")

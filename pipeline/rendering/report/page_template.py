"""Pages from templates: what a log says is escaped, and a name that a template misspells is an error."""

from __future__ import annotations

from pathlib import Path

from pipeline.rendering import labels

TEMPLATES = Path(__file__).parents[1] / "templates"
"""Folder of templates, style sheets, scripts and the vendored plot library."""

FILTERS = {
    "stiffness": labels.stiffness_text,
    "damping": labels.damping_text,
    "digits": labels.significant,
    "capitalised": lambda text: text[:1].upper() + text[1:],
    "size": labels.size_text,
    "cost": lambda cost, criterion: labels.cost_range_text(criterion, cost, cost),
    "rounded": labels.estimate_texts,
}
"""How templates write quantities."""


def fill_template(name: str, **content: object) -> str:
    """Return a template of `TEMPLATES` with its names replaced by their content, as text of the page.

    Parameters
    ----------
    name : str
        File name of the template.
    **content : object
        What its names stand for. In pages (``.html.j2``) text is escaped unless the template calls it safe.

    Raises
    ------
    jinja2.UndefinedError
        If the template uses a name that is not given: a defect, never a matter of the data.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # 0.1 s, not needed by other commands

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= FILTERS
    return environment.get_template(name).render(**content)

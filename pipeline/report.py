"""One self-contained HTML file from finished numbers: no network, no script, deterministic.

The page holds every table cell under a name (see `report_tables`) and a digest over all of them; `cells`
reads them back, which is what `pipeline verify` compares.
"""

from __future__ import annotations

from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from pipeline import report_estimates, report_tables, tables
from pipeline.accuracy import AccuracyReport, duration, error_text, own_rungs
from pipeline.errors import PipelineError
from pipeline.provenance import digest
from pipeline.results import ReportData

TEMPLATES = Path(__file__).parent / "templates"
DIGEST_NAME = "pipeline-cells"
_DIGEST_SLOT = "digest-of-cells"


@dataclass(frozen=True)
class Drawing:
    """A figure on the page: panels as ``<svg>`` elements, and the words around them."""

    identifier: str
    title: str
    caption: str
    panels: tuple[str, ...]
    key: str


def render(data: ReportData) -> str:
    """Return the report as one HTML document; sections without data are left out.

    Raises
    ------
    PipelineError
        If two cells got the same name, as from an experiment that occurs twice.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # 0.1 s, not needed by other commands

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    result = data.result
    page = environment.get_template("report.html.j2").render(
        result=result,
        slot=_DIGEST_SLOT,
        digest_name=DIGEST_NAME,
        footnote=report_tables.footnote,
        energy=any(c.startswith("energy") for c in result.criteria),
        settling=any(c.startswith("settle") for c in result.criteria),
        **_drawings(data),
        **_tables(data),
    )
    found = _Cells(page)
    if found.doubles:
        raise PipelineError(
            f"report of {result.device}: table cells with equal names {found.doubles[:3]}; expected one row "
            "for each table, criterion and condition. Give each experiment and criterion once."
        )
    # The slot stands in the head, before anything a log could have written.
    return page.replace(_DIGEST_SLOT, digest(found.cells), 1)


def write(data: ReportData, path: Path) -> None:
    """Render a report and write it so that a reader sees all of it or nothing."""
    tables.write_text(path, render(data))


def cells(page: str) -> dict[str, str]:
    """Return the text of every table cell of a report by name, as a reader sees it, notes' marks included.

    Parameters
    ----------
    page : str
        HTML made by `render`; other HTML has no named cells.
    """
    return _Cells(page).cells


def stored_digest(page: str) -> str | None:
    """Return the digest over all cells that `render` stored in the page; None where there is none.

    An untouched report has ``stored_digest(page) == provenance.digest(cells(page))``.
    """
    return _Cells(page).digest


def _tables(data: ReportData) -> dict[str, Any]:
    result = data.result
    optima = report_tables.optimum_tables(result)
    provenance = sorted(result.provenance.items())
    stages = ("stage", "what", "why")
    return {
        "experiments": report_estimates.experiment_table(result) if result.experiments else None,
        "outcomes": report_estimates.outcome_table(result),
        "model": report_estimates.model_table(result),
        "windows": report_estimates.window_table(result),
        "definitions": report_estimates.definition_table(result),
        "methods": report_estimates.method_table(result),
        "optima": optima,
        "measured_optima": report_tables.measured_optimum_table(result),
        "delay_tables": report_tables.delay_tables(result),
        "boundary": report_tables.boundary_table(result),
        "missing": report_tables.missing_table(result),
        "accuracy": _accuracy_table(data.accuracy),
        "stages": report_tables.word_table("stages", "Plan of stages", stages, data.stages),
        "provenance": report_tables.word_table("provenance", "Origin", ("entry", "value"), provenance),
    }


def _accuracy_table(accuracy: AccuracyReport | None) -> report_tables.Table | None:
    """Error and run time of our own methods, one row a quantity."""
    if accuracy is None:
        return None
    rows = [(r.quantity, r.setting, error_text(r.error), duration(r.seconds)) for r in own_rungs(accuracy)]
    caption = f"Largest error and run time of the methods behind the theory, measured {accuracy.measured}"
    return report_tables.word_table("accuracy", caption, ("quantity", "method", "largest error", "run time"), rows)


def _drawings(data: ReportData) -> dict[str, Any]:
    if not (data.boundaries or data.costs or data.delays):
        return {"boundary_figures": (), "cost_figures": (), "delay_figures": ()}
    from pipeline import figures  # matplotlib takes 0.6 s, which a report without figures need not wait for

    motion = data.result.motion
    line_key = (
        "Solid: measured; dashed: theory; dotted: linear condition. "
        "Open markers: the tested range ended before an unstable trial."
    )
    map_key = (
        "Outer curve: stability boundary. Green: lines of equal cost, {lines}. Plus: optimum. "
        "Below: least cost for each stiffness (line){dots}."
    )
    maps = []
    for figure in data.costs:
        overshoot = figure.criterion == "overshoot"
        lines = "every 10 percentage points, the heavy one at 0.1 % around the region without"
        key = map_key.format(
            lines=lines if overshoot else "two for each doubling, starting at the optimum",
            dots=" and all trials (dots)" if any(m.trial_cost.size for m in figure.maps) else "",
        )
        calm = " Dots in the map: trials without overshoot." if overshoot and len(figure.maps) > 1 else ""
        panels = figures.cost_maps(figure, motion)
        maps.append(Drawing(figure.identifier, _title(figure.title), figure.caption, panels, key + calm))
    return {
        "boundary_figures": [
            Drawing(f.identifier, _title(f.title), f.caption, figures.boundaries(f, motion), line_key)
            for f in data.boundaries
        ],
        "cost_figures": maps,
        "delay_figures": [
            Drawing(f.identifier, _title(f.title), f.caption, figures.delays(f), "") for f in data.delays
        ],
    }


def _title(text: str) -> str:
    """Return a title with its first letter raised and without the full stop that the page adds."""
    return (text[:1].upper() + text[1:]).rstrip(".")


class _Cells(HTMLParser):
    """Collects named cells, names that occur twice, and the stored digest."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.cells: dict[str, str] = {}
        self.doubles: list[str] = []
        self.digest: str | None = None
        self._name: str | None = None
        self._parts: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if tag == "meta" and found.get("name") == DIGEST_NAME:
            self.digest = found.get("content")
        if tag in ("td", "th") and found.get("data-cell"):
            self._name, self._parts = found["data-cell"], []

    def handle_data(self, data: str) -> None:
        if self._name is not None:
            self._parts.append(data)

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th") and self._name is not None:
            if self._name in self.cells:
                self.doubles.append(self._name)
            self.cells[self._name] = " ".join(" ".join(self._parts).split())
            self._name = None

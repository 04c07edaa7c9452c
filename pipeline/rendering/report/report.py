"""Write computed results as one self-contained HTML file.

The file is deterministic, works offline, and is readable without its scripts.

Every table cell of the page has a name; `pipeline verify` compares cells and a digest of the page.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from pipeline.base.disk import write_text
from pipeline.base.errors import PipelineError
from pipeline.base.provenance import digest
from pipeline.base.wording import duration, error_text, unbroken
from pipeline.explorer import page as explorer
from pipeline.explorer.entries import measured_entries
from pipeline.records.accuracy import AccuracyReport, own_rungs
from pipeline.records.criteria import criterion_of
from pipeline.records.models import FigureKind, Motion
from pipeline.records.results import Answer, ComparisonResult
from pipeline.rendering.figures.drawing import Drawn, Figure, draw
from pipeline.rendering.labels import UNITS, Units
from pipeline.rendering.report import page_template, report_parts
from pipeline.rendering.report.page_template import fill_template
from pipeline.rendering.table import Table, marked, word_table
from pipeline.rendering.tables.report_tables import tables_of
from pipeline.rendering.tables.trial_links import NO_TRIALS, TrialPage

SEVERAL = ("optima", "delay_tables")
"""Names that denote any number of tables."""

ALWAYS = ("overview", "missing", "excluded", "notes", "loops", "causes", "accuracy", "stages", "provenance")
"""Tables that are needed to judge the others. No scene leaves them out."""

OF_COSTS = ("optima", "delay_tables", "delay_form", "measured_optima", "use")
"""Tables with measured costs."""

ABOUT_MEASURED = "costs about the measured final position"

_DIGEST_SLOT, _PARTS_SLOT = "digest-of-cells", "digests-of-parts"


@dataclass(frozen=True)
class ReportData:
    """Everything that one HTML report shows.

    Parameters
    ----------
    result : ComparisonResult
    figures : tuple of Figure
    stages : tuple of (str, str, str)
        Stage, action (run, reuse, leave out), and reason.
    accuracy : AccuracyReport, optional
        Error and run time of the theory's methods, if `pipeline accuracy` was run with this code on this machine.
    tables : tuple of str, optional
        Names of the tables to show, or None for all tables. The tables in `ALWAYS` are shown in any case.
    trials : TrialPage, optional
        All trials for the interactive part.
    request : dict
        Request of the report, which is stored in the head of the page. `verify` recomputes the report from it.
    """

    result: ComparisonResult
    figures: tuple[Figure, ...] = ()
    stages: tuple[tuple[str, str, str], ...] = ()
    accuracy: AccuracyReport | None = None
    tables: tuple[str, ...] | None = None
    trials: TrialPage | None = None
    request: dict[str, object] = field(default_factory=dict)


def render(data: ReportData) -> str:
    """Return the report as one HTML document. Sections without data are left out.

    Raises
    ------
    PipelineError
        If two cells have the same name, for example because an experiment occurs twice.
    """
    from markupsafe import escape

    result, trials = data.result, data.trials
    entries = measured_entries(result)
    inline = page_template.scripts(with_trials=trials is not None, with_explorer=bool(entries))
    drawn = [draw(figure) for figure in data.figures]
    figures: dict[str, list[Drawn]] = {
        kind: [d for d in drawn if d.figure.kind == kind] for kind in get_args(FigureKind)
    }
    numbers = {each.figure.identifier: each.shown for each in drawn}
    page = fill_template(
        "report.html.j2",
        result=result,
        slot=_DIGEST_SLOT,
        parts_slot=_PARTS_SLOT,
        metas=report_parts,
        request=json.dumps(data.request, sort_keys=True),
        scripts=inline,
        policy=page_template.policy(inline),
        trials=trials,
        trials_json=page_template.json_text(trials.content) if trials else "",
        explorer=explorer.panel(entries) if entries else "",
        explorer_style=explorer.style() if entries else "",
        plot_style=page_template.script_text(page_template.PLOT_STYLE) if trials else "",
        families=list(dict.fromkeys(criterion_of(name).family for name in result.criteria)),
        figures=figures,
        figure_json=page_template.json_text({"figures": pack(numbers)}) if numbers else "",
        **answer_content(result),
        **_tables(data),
    )
    page = unbroken(page)
    found = report_parts.take_apart(page)
    if found.doubles:
        raise PipelineError(
            f"report of {result.device}: table cells with equal names {found.doubles[:3]}; expected one row "
            "for each table, criterion and condition. Give each experiment and criterion once."
        )
    # The slot is in the head, before any text from a log.
    page = page.replace(_DIGEST_SLOT, digest(found.cells), 1)
    digests = report_parts.digests_of(page, found).model_dump_json()
    return page.replace(_PARTS_SLOT, str(escape(digests)), 1)


def write(data: ReportData, path: Path) -> None:
    """Render a report and write it atomically."""
    write_text(path, render(data))


def pack(content: Any) -> str:
    """Return a JSON value as deflated text in base64, which a browser can unpack (``DecompressionStream``)."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return base64.b64encode(zlib.compress(text.encode(), 7)).decode()


def answer_content(result: ComparisonResult) -> dict[str, Units | float | None]:
    """Return the units and the sampling period [s], which the templates of the answer need in addition to the
    result."""
    return {"units": UNITS[result.motion], "period": result.featured.sampling_period_s if result.featured else None}


def answer_lines(answer: Answer | None, motion: Motion, period: float | None) -> tuple[str, ...]:
    """Return the five answers as lines of text. The result is empty if there is no answer.

    Parameters
    ----------
    answer : Answer or None
    motion : Motion
    period : float or None
        Sampling period of the experiment that the answer concerns [s].
    """
    if answer is None:
        return ()
    text = fill_template("answer.txt.j2", answer=answer, motion=motion, units=UNITS[motion], period=period)
    return tuple(" ".join(line.split()) for line in text.splitlines() if line.strip())


def printed_tables(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> dict[str, list[Table]]:
    """Return all printed tables of a comparison, by the names of `tables_of`.

    Simulated and measured tables are marked.
    """
    about = ABOUT_MEASURED if result.measuring.final == "measured" else ""
    return {
        name: [marked(table, simulated=result.simulated, more=about * (name in OF_COSTS)) for table in tables]
        for name, tables in tables_of(result, trials).items()
    }


def _tables(data: ReportData) -> dict[str, Table | list[Table] | None]:
    """Return the tables for the templates.

    Each name denotes a table or None, or a list if the name denotes any number of tables.
    """
    result = data.result
    found = printed_tables(result, data.trials or NO_TRIALS)
    rest = {
        "accuracy": _accuracy_table(data.accuracy),
        "stages": word_table("stages", "Plan of stages", ("stage", "what", "why"), data.stages),
        "provenance": word_table("provenance", "Origin", ("entry", "value"), sorted(result.provenance.items())),
    }
    found |= {name: [table] if table else [] for name, table in rest.items()}
    asked = {name: [t for t in tables if _is_asked(name, t.name, data.tables)] for name, tables in found.items()}
    asked["delay_form"] = found["delay_form"] if asked["delay_tables"] else []  # the same costs in another layout
    return {name: tables if name in SEVERAL else next(iter(tables), None) for name, tables in asked.items()}


def _is_asked(name: str, table: str, names: Sequence[str] | None) -> bool:
    own = {table} if name in SEVERAL else {table, name}
    return names is None or bool(own & {*names, *ALWAYS})


def _accuracy_table(accuracy: AccuracyReport | None) -> Table | None:
    """Return error and run time of this package's methods, one row per quantity."""
    if accuracy is None:
        return None
    rows = [(r.quantity, r.setting, error_text(r.error), duration(r.seconds)) for r in own_rungs(accuracy)]
    caption = f"Largest error and run time of the methods behind the theory, measured {accuracy.measured}"
    return word_table("accuracy", caption, ("quantity", "method", "largest error", "run time"), rows)

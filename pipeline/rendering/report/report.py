"""One self-contained HTML file from finished numbers: no network, readable without its scripts, deterministic.

The page holds every table cell under a name (see `report_tables`) and a digest over all of them; `cells`
reads them back, which is what `pipeline verify` compares.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.base.disk import write_text
from pipeline.base.errors import PipelineError
from pipeline.base.wording import duration, error_text, unbroken
from pipeline.records.accuracy import AccuracyReport, own_rungs
from pipeline.records.criteria import criterion_of
from pipeline.records.results import ComparisonResult, ReportData
from pipeline.records.trial_codec import NO_TRIALS, TrialPage, pack
from pipeline.rendering.report import (
    report_answer,
    report_estimates,
    report_figures,
    report_parts,
    report_scores,
    report_scripts,
    report_tables,
    report_trend,
    report_truth,
)
from pipeline.rendering.report.page_template import fill_template
from pipeline.rendering.table import Table, footnote, marked, word_table

TABLES: dict[str, Callable[[ComparisonResult, TrialPage], Table | list[Table] | None]] = {
    "scores": report_scores.score_table,
    "estimate_scores": report_scores.estimate_score_table,
    "experiments": report_estimates.experiment_table,
    "optima": report_tables.optimum_tables,
    "delay_tables": report_tables.delay_tables,
    "measured_optima": report_tables.measured_optimum_table,
    "boundary": report_tables.boundary_table,
    "methods": report_estimates.method_table,
    "loops": report_estimates.loop_table,
    "causes": report_estimates.cause_table,
    "model": report_estimates.model_table,
    "outcomes": report_estimates.outcome_table,
    "truth": report_truth.truth_table,
    "use": report_answer.use_table,
    "missing": report_tables.missing_table,
    "excluded": report_tables.excluded_table,
    "notes": report_tables.notes_table,
    "header": report_tables.header_table,
    "trend": report_trend.trend_table,
    "score_costs": report_scores.cost_score_table,
    "score_rules": report_scores.rule_score_table,
}
"""Tables of a comparison by the names that the templates use."""

PRINTED = tuple(name for name in TABLES if name not in ("score_costs", "score_rules"))
"""Those that Markdown and LaTeX hold, in this order."""

SEVERAL = ("optima", "delay_tables")
"""Names that stand for any number of tables."""

ALWAYS = ("missing", "excluded", "notes", "loops", "causes", "accuracy", "stages", "provenance")
"""Tables that a reader needs to trust the others: no scene leaves them out."""

PARTS = {"score_costs": "scores", "score_rules": "scores"}
"""Tables that a scene asks for by the name of another one."""

_DIGEST_SLOT = "digest-of-cells"
_PARTS_SLOT = "digests-of-parts"


def render(data: ReportData) -> str:
    """Return the report as one HTML document; sections without data are left out.

    Raises
    ------
    PipelineError
        If two cells got the same name, as from an experiment that occurs twice.
    """
    from markupsafe import escape

    result = data.result
    trials = data.trials
    inline = report_scripts.scripts(with_trials=trials is not None)
    figures = report_figures.drawings(data)
    numbers = {drawing.identifier: drawing.shown for drawn in figures.values() for drawing in drawn}
    page = fill_template(
        "report.html.j2",
        result=result,
        slot=_DIGEST_SLOT,
        parts_slot=_PARTS_SLOT,
        metas=report_parts,
        request=json.dumps(data.request, sort_keys=True),
        scripts=inline,
        policy=report_scripts.policy(inline),
        trials=trials,
        trials_json=report_scripts.json_text(trials.content) if trials else "",
        plot_style=report_scripts.plot_style() if trials else "",
        footnote=footnote,
        families=list(dict.fromkeys(criterion_of(name).family for name in result.criteria)),
        figures=figures,
        figure_json=report_scripts.json_text({"figures": pack(numbers)}) if numbers else "",
        **report_answer.answer_content(result),
        **_tables(data),
    )
    page = unbroken(page)
    found = report_parts.take_apart(page)
    if found.doubles:
        raise PipelineError(
            f"report of {result.device}: table cells with equal names {found.doubles[:3]}; expected one row "
            "for each table, criterion and condition. Give each experiment and criterion once."
        )
    # The slot stands in the head, before anything a log could have written.
    page = page.replace(_DIGEST_SLOT, report_parts.cells_digest(found), 1)
    digests = report_parts.digests_of(page, found).model_dump_json()
    return page.replace(_PARTS_SLOT, str(escape(digests)), 1)


def write(data: ReportData, path: Path) -> None:
    """Render a report and write it so that a reader sees all of it or nothing."""
    write_text(path, render(data))


def tables_of(name: str, result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> list[Table]:
    """Return the tables of `TABLES` by a name; none where there is nothing to say."""
    found = TABLES[name](result, trials)
    tables = found if isinstance(found, list) else [found] if found else []
    return [marked(table, simulated=result.simulated) for table in tables]


def _tables(data: ReportData) -> dict[str, Any]:
    """Return what the templates get: a table or None, or a list for a name that stands for several."""
    found = {name: tables_of(name, data.result, data.trials or NO_TRIALS) for name in TABLES}
    rest = {
        "accuracy": _accuracy_table(data.accuracy),
        "stages": word_table("stages", "Plan of stages", ("stage", "what", "why"), data.stages),
        "provenance": word_table("provenance", "Origin", ("entry", "value"), sorted(data.result.provenance.items())),
    }
    found |= {name: [table] if table else [] for name, table in rest.items()}
    asked = {name: [table for table in tables if _is_asked(name, table, data.tables)] for name, tables in found.items()}
    return {name: tables if name in SEVERAL else next(iter(tables), None) for name, tables in asked.items()}


def _is_asked(name: str, table: Table, names: tuple[str, ...] | None) -> bool:
    own = {table.name} if name in SEVERAL else {table.name, PARTS.get(name, name)}
    return names is None or bool(own & {*names, *ALWAYS})


def _accuracy_table(accuracy: AccuracyReport | None) -> Table | None:
    """Error and run time of our own methods, one row a quantity."""
    if accuracy is None:
        return None
    rows = [(r.quantity, r.setting, error_text(r.error), duration(r.seconds)) for r in own_rungs(accuracy)]
    caption = f"Largest error and run time of the methods behind the theory, measured {accuracy.measured}"
    return word_table("accuracy", caption, ("quantity", "method", "largest error", "run time"), rows)

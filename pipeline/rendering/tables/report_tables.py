"""All tables of a report by the names used in templates and scenes."""

from __future__ import annotations

from pipeline.records.results import ComparisonResult
from pipeline.rendering.frames import frames
from pipeline.rendering.labels import UNITS, quantity_name, unit_text
from pipeline.rendering.table import Column, Table, records, table_of
from pipeline.rendering.tables.boundary_tables import boundary_table, regions_table, scores_table, shapes_table
from pipeline.rendering.tables.cost_tables import measured_optima_table, rules_table, use_table
from pipeline.rendering.tables.estimate_tables import experiments_table, loops_table, methods_table, truth_table
from pipeline.rendering.tables.formats import interval_column, range_end_note
from pipeline.rendering.tables.log_tables import device_tables, header_table, manual_tables, outcomes_table
from pipeline.rendering.tables.optima_tables import delay_form_table, optima_tables
from pipeline.rendering.tables.overview_table import overview_table
from pipeline.rendering.tables.trial_links import NO_TRIALS, TrialPage, trial_of_row


def tables_of(result: ComparisonResult, trials: TrialPage = NO_TRIALS) -> dict[str, list[Table]]:
    """Return the tables of a report by the names used in templates and scenes. A list is empty if there are no data."""
    f = {name: records(frame) for name, frame in frames(result).items()}
    units = UNITS[result.motion]
    place = trial_of_row(trials)
    made: dict[str, Table | None] = {
        "overview": overview_table(result),
        "scores": scores_table(result, units.stiffness, units.damping),
        "experiments": experiments_table(result),
        "measured_optima": measured_optima_table(f["optima"], result, units, place),
        "boundary": boundary_table(f["boundary"], units, trials),
        "methods": methods_table(f["estimates"], result),
        "loops": loops_table(result),
        "shapes": shapes_table(result),
        "regions": regions_table(result),
        **device_tables(f),
        "rules": rules_table(result),
        "outcomes": outcomes_table(result),
        "truth": truth_table(result),
        "use": use_table(result, place),
        **manual_tables(f),
        "header": header_table(result),
        "trend": table_of(
            "trend",
            "Limits and estimates with 95 % intervals over the experiments, with header lines that differ",
            (Column("line", "header lines"), interval_column("value", ends=("low", "high"), notes=range_end_note)),
            f["trend"],
            lambda row: f"{row['quantity']}/{row['experiment']}",
            lambda row: f"{quantity_name(row['quantity'])} [{unit_text(row['unit'])}]",
        ),
    }
    made["delay_form"] = delay_form_table(f["tables"])
    tables = {name: [table] if table else [] for name, table in made.items()}
    return tables | optima_tables(f["tables"], result, units, place)

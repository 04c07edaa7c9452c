"""Tables of stability limits, of their shape, and of their agreement with theory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.base.wording import first_clause, listed
from pipeline.records.findings import MATTERS
from pipeline.records.results import ComparisonResult, ExperimentNumbers, Scores, StraightBound
from pipeline.rendering.frames import flat
from pipeline.rendering.labels import (
    CHANGES,
    UNITS,
    damping_text,
    percent_text,
    share_text,
    significant,
    size_text,
    stiffness_text,
)
from pipeline.rendering.table import Column, Row, Table, table_of
from pipeline.rendering.tables.formats import (
    RANGE_ENDED,
    digits,
    experiment_block,
    experiment_row,
    interval_column,
    interval_ends,
    ratio_text,
    show_damping,
    show_percent,
    show_percent_of_share,
    show_share,
    show_stiffness,
)
from pipeline.rendering.tables.trial_links import TrialPage

STABLE_ABOVE = "A single stable trial lies above this limit, because verdicts scatter near a limit."

UNDECIDED_BELOW = "A trial below this limit is undecided. Inspect it, or repeat it."


REGION = "over the tested dampings, the measured region is"
"""Beginning of a sentence on the size of a region. Areas beyond the tested dampings are not compared."""


def boundary_table(rows: Sequence[Row], units: Any, trials: TrialPage) -> Table | None:
    """Return the measured limits at each damping."""

    def place(row: Row, name: str) -> str:
        return trials.limits.get((row["experiment"], row["damping"], row[name] or 0.0), "")

    def below(row: Row) -> list[str | None]:
        return [UNDECIDED_BELOW if row["undecided"] else None]

    def ended(row: Row) -> list[str | None]:
        return [RANGE_ENDED if row["censored"] else None]

    def scatters(row: Row) -> list[str | None]:
        return [STABLE_ABOVE if row["stable"] and row["stiffness"] and row["stiffness"] < row["stable"] else None]

    def limit(_: Any, row: Row) -> str:
        if row["stiffness"] is not None:
            return stiffness_text(row["stiffness"])
        return f"≥ {stiffness_text(row['low'])}" if row["low"] else f"≤ {stiffness_text(row['high'])}"

    def interval(row: Row) -> str:
        if None in (row["stiffness"], row["low"], row["high"]):
            return ""
        low, high = stiffness_text(row["low"]), stiffness_text(row["high"])
        return "" if low == high else f"{low} to {high}"

    caption = f"Largest stable and smallest unstable stiffness [{units.stiffness}] at each damping, and the limit by "
    caption += "the growth rates of the trials around it"
    if any(row["stiffness_large_motion"] is not None for row in rows):
        caption += "; with friction, both are valid only for this step: under a harder push, walls become unstable at "
        caption += "the linear limit"
    columns = (
        Column("damping", "damping", units.damping, show=show_damping),
        Column(
            "stable", show=show_stiffness, why="no stable trial", notes=below, link=lambda row: place(row, "stable")
        ),
        Column(
            "unstable",
            show=show_stiffness,
            why="no unstable trial",
            notes=ended,
            link=lambda row: place(row, "unstable"),
        ),
        Column(
            "limit",
            "limit, 95 %",
            show=limit,
            aside=interval,
            notes=scatters,
            why="the growth rates do not determine it",
        ),
        Column("stiffness_large_motion", "harder push", show=show_stiffness, why="no limit", optional=True),
        Column("truth", show=show_stiffness, why="no truth", optional=True),
    )
    shown = [row | {"limit": row["stiffness"] or row["low"] or row["high"] or None} for row in map(dict, rows)]

    def name(row: Row) -> str:
        # random dampings may be equal when printed
        return f"{row['experiment']}/{row['damping']:.15g}"

    return table_of("boundary", caption, columns, shown, name, experiment_block)


def _largest_stable(name: str, label: str) -> Column:
    """Return the column with the deviation of the largest stiffness or damping of a stable trial from theory."""
    return Column(
        f"{name}_deviation_percent",
        label,
        "%",
        show=lambda value, row: ("≥ " if row[f"{name}_lower_bound"] else "") + percent_text(value),
        aside=lambda row: ratio_text(row, f"{name}_measured", f"{name}_theory"),
    )


def scores_table(result: ComparisonResult, stiffness: str, damping: str) -> Table | None:
    """Return the scores of theory for each experiment, and those with the measured damping if it is another one."""
    rows = []
    for e in result.experiments:
        unjudged = e.answer.predicts.reason if e.answer and e.answer.predicts.code == "unknown" else ""
        for scores in e.scores:
            loop = scores.parameters.loop.apparent()
            reason = (
                f"not judged: {first_clause(unjudged)}"
                if unjudged
                else "; ".join(dict.fromkeys(scores.missing.values()))
            )
            row: Row = {"experiment": e.experiment, "reason": reason}
            row |= {"basis": scores.basis, "theory_damping": loop.damping}
            for name in ("region", "distance", "verdicts", "stiffness", "damping"):
                found = getattr(scores, name)
                if name in _OF_LIMITS and unjudged:
                    continue
                row |= {f"{name}_{key}": value for key, value in flat(found).items()} if found else {}
            rows.append(row)
    bases = {scores.basis for e in result.experiments for scores in e.scores} - {"measured damping"}

    def at_largest(row: Row) -> str:
        return f"at B = {damping_text(row['distance_largest_damping'])}" if "distance_largest" in row else ""

    columns = (
        Column("experiment"),
        Column("theory_damping", "theory's b", damping, show=digits(3), aside=lambda row: _OF_BASIS[row["basis"]]),
        Column("region_overlap", "overlap of the regions", "%", show=show_share, ends=interval_ends("region_overlap")),
        Column(
            "region_covered",
            "stable part of theory's region",
            "%",
            show=show_share,
            ends=interval_ends("region_covered"),
        ),
        interval_column("region_area_ratio", "area, measured : theory"),
        _largest_stable("stiffness", "stiffest stable trial, K"),
        _largest_stable("damping", "largest stable B"),
        Column("distance_median", "distance of limits, median", "%", show=show_percent_of_share),
        Column("distance_largest", "largest", "%", show=show_percent_of_share, aside=at_largest),
        Column("distance_rms", "rms", stiffness, show=digits(3)),
        Column(
            "verdicts_agreement",
            "equal verdicts",
            "%",
            show=show_share,
            aside=lambda row: ratio_text(row, "verdicts_only_theory_stable", "verdicts_only_log_stable"),
        ),
    )
    basis = " and ".join(f"theory by the {basis}" for basis in sorted(bases))
    table = table_of("scores", f"Measured against theory ({basis})", columns, rows, _score_row)
    if table is not None:
        table.mark(*measured_damping_notes(result))
    return table


_OF_LIMITS = ("region", "distance", "stiffness")
"""Scores that are left out where the first screen does not judge the boundary. Few limits agree by chance."""

_OF_BASIS = {"device file": "stated", "estimates": "by the logs", "measured damping": "by the logs"}
"""Source of theory's damping, by the basis of scores."""


def _score_row(row: Row) -> str:
    """Return the name of a row of scores. The scores with the measured damping are a second row of an experiment."""
    return f"{row['experiment']}{'/measured-damping' if row['basis'] == 'measured damping' else ''}"


def measured_damping_notes(result: ComparisonResult) -> list[str]:
    """Describe the effect of the measured damping on the scores, in one sentence for each experiment with another
    damping.

    The last sentence names the experiments in which this damping explains nothing. The list is empty without a device
    file.
    """
    notes, same = [], []
    for e in result.experiments if result.known_device else ():
        damping = e.estimates.get("damping")
        if len(e.scores) == 1 and damping is not None and None not in (damping.low, damping.high):
            same.append(e.experiment)
        if len(e.scores) < 2:
            continue
        stated, damped = e.scores
        changes = [
            f"{name} {show(before)} to {show(after)} %"
            for name, before, after, show in (
                ("overlap of the regions", *_both(stated, damped, "region", "overlap"), share_text),
                ("stiffest stable trial", *_both(stated, damped, "stiffness", "deviation_percent"), percent_text),
                ("largest stable B", *_both(stated, damped, "damping", "deviation_percent"), percent_text),
            )
            if before is not None and after is not None
        ]
        if changes:
            notes.append(
                f"Experiment {e.experiment}: the damping of the logs in place of the stated one changes the scores: "
                f"{', '.join(changes)}."
            )
    if same:
        where = experiments_text(same, len(result.experiments))
        notes.append(f"{where}: the damping of the logs agrees with the stated one, so it explains no deviation.")
    return notes


def _both(first: Scores, second: Scores, part: str, name: str) -> tuple[float | None, float | None]:
    """Return a number of two scores. It is None if the score is missing."""
    one, other = (getattr(getattr(scores, part), name, None) for scores in (first, second))
    return one, other


def shapes_table(result: ComparisonResult) -> Table | None:
    """Return the implied delay and the fitted line of each measured boundary."""
    units, rows = UNITS[result.motion], []
    for e in result.experiments:
        delays, line = e.implied_delay, e.straight_bound
        if delays is None or (delays.origin.value is None and delays.whole.value is None and line is None):
            continue
        row: Row = {"experiment": e.experiment, "reason": delays.whole.reason}
        for name, each in (("logs", e.delay), ("origin", delays.origin), ("whole", delays.whole)):
            row |= {name: each.value, f"{name}_low": each.low, f"{name}_high": each.high}
        if line is not None:
            row |= {"slope": line.slope, "slope_low": line.slope_low, "slope_high": line.slope_high}
            sign = "+" if line.slope >= 0 else "\N{MINUS SIGN}"
            row["line"] = f"K = {stiffness_text(line.stiffness)} {sign} {significant(abs(line.slope), 3)} B"
            row["dampings"] = f"{line.damping_first:g} to {line.damping_last:g}"
            row |= {"curvature": line.curvature, "curvature_theory": line.curvature_theory, "shape": shape_words(line)}
            row |= {"curvature_low": line.curvature_low, "curvature_high": line.curvature_high}
            row["compared"] = _compared(line)
        rows.append(row)
    stiffest = "limits at or above the damping of the largest limit"
    few = f"fewer than four {stiffest}"
    curved = f"theory has a stable wall at fewer than four of the {stiffest}"
    columns = [Column("experiment")]
    for name, label in (("logs", "by the logs"), ("origin", "near the origin"), ("whole", "by all limits")):
        columns.append(interval_column(name, label, "samples", group="delay d"))
    columns += [
        Column("line", "line", group=stiffest, why=few),
        interval_column("slope", "slope", f"{units.stiffness} per {units.damping}", group=stiffest, why=few),
        Column("dampings", "dampings", units.damping, stiffest, why=few),
        interval_column("curvature", "curvature", f"{units.stiffness} per ({units.damping})²", group=stiffest, why=few),
        Column("curvature_theory", "of theory", group=stiffest, show=digits(3), why=curved),
        Column("shape", "shape", group=stiffest, why=few, aside=lambda row: row.get("compared", "")),
    ]
    table = table_of(
        "shapes",
        "Delay and line that the measured boundary implies, with 95 % intervals",
        columns,
        rows,
        experiment_row,
    )
    if table is not None:
        table.mark(
            "Pure delay with which an ideal loop of this mass and damping has these limits. A lag or a velocity filter "
            "makes it longer than the delay of the logs. Friction makes it shorter, as does jitter near the origin."
        )
    return table


def shape_words(line: StraightBound) -> str | None:
    """Describe in words whether a measured boundary is straight, and whether the curvature of theory is excluded.

    The result is None if the curvature is unknown.
    """
    if line.is_straight is None:
        return None
    found = "straight" if line.is_straight else "curved"
    if line.excludes_theory is None:
        return f"{found}; no curvature of theory to compare"
    if line.excludes_theory:
        return f"{found}; theory's curvature is excluded"
    return "straight or curved as theory: not decided" if line.is_straight else "curved as theory"


def _compared(line: StraightBound) -> str:
    """Return the damping up to which the curvatures are compared, if theory has no stable wall beyond it. Otherwise
    empty."""
    if line.curvature_last is None or line.curvature_last >= line.damping_last:
        return ""
    return f"up to B = {line.curvature_last:g}: beyond it, theory has no stable wall"


def regions_table(result: ComparisonResult) -> Table | None:
    """Return the table of the effects of the numbers of the logs on the difference of measured and theoretical
    region."""
    known = [e for e in result.experiments if e.scores and e.scores[0].region and e.scores[0].basis == "device file"]
    rows = []
    for e in known:
        region = e.scores[0].region
        assert region is not None, "experiments without a region are left out"
        low, high = (100 * (end - 1) for end in (region.area_ratio_low, region.area_ratio_high))
        row: Row = {"experiment": e.experiment, "measured": 100 * (region.area_ratio - 1)}
        row |= {"measured_low": low, "measured_high": high, "reason": _no_causes(e)}
        if e.region_causes is not None:
            row |= {change.code: change.percent for change in e.region_causes.changes}
            row["together"] = e.region_causes.together_percent
        rows.append(row)
    of_logs = "theory's region with the number or part of the logs"
    agrees = "agrees with the device file"
    columns = (
        Column("experiment"),
        Column("measured", "measured region, 95 %", "%", show=show_percent, ends=interval_ends("measured")),
        *(
            Column(code, label, "%", of_logs, show_percent, why=agrees, optional=True)
            for code, label in CHANGES.items()
        ),
        Column("together", "all of them", "%", of_logs, show_percent, why="needs an adequate loop"),
    )
    table = table_of("regions", "Area of the stable region: difference from theory", columns, rows, experiment_row)
    if table is not None:
        table.mark(*(sentence for e in known if (sentence := region_sentence(e))), _equal_regions(known))
    return table


def region_sentence(result: ExperimentNumbers) -> str:
    """Return why the measured region of an experiment is smaller or larger than that of theory.

    The text is empty if the interval of the measured area includes that of theory, or if they differ by at most 2 %.
    """
    region = result.scores[0].region
    if region is None or _is_as_large(result):
        return ""
    percent = 100 * (region.area_ratio - 1)
    size = f"{'smaller' if percent < 0 else 'larger'} than theory's"
    where = f"Experiment {result.experiment}: {REGION}"
    whole = f"{where} {size_text(percent)} {size}"
    if reason := _no_causes(result):
        return f"{whole}. The cause is unknown: {reason}."
    causes = result.region_causes
    assert causes is not None, "there is no reason without causes only if there are causes"
    same = [change for change in causes.changes if change.percent * percent > 0]
    main = max(same, key=lambda change: abs(change.percent), default=None)
    if main is None or abs(main.percent) < 100 * MATTERS:
        return f"{whole}. No number or part of the logs explains it."
    together = f"All numbers and parts of the logs together change it by {percent_text(causes.together_percent)} %"
    low, high = 100 * (region.area_ratio_low - 1), 100 * (region.area_ratio_high - 1)
    explained = ", which explains it" if low <= causes.together_percent <= high else "; the rest is unexplained"
    cause = f"According to the logs, the main cause is: {CHANGES[main.code]} ({percent_text(main.percent)} %)"
    return f"{whole}. {cause}. {together}{explained}."


def _is_as_large(result: ExperimentNumbers) -> bool:
    region = result.scores[0].region
    if region is None:
        return False
    return region.area_ratio_low <= 1 <= region.area_ratio_high or abs(region.area_ratio - 1) <= MATTERS


def _no_causes(result: ExperimentNumbers) -> str:
    """Return why the causes of the size of a region are unknown, or ""."""
    if result.region_causes is not None:
        return ""
    return "no device was identified" if result.loop is None else first_clause(result.loop.reason)


def _equal_regions(results: Sequence[ExperimentNumbers]) -> str | None:
    """Name the experiments whose measured region is as large as that of theory. The result is None if there is none."""
    same = [e.experiment for e in results if _is_as_large(e)]
    if not same:
        return None
    where = experiments_text(same, len(results))
    return f"{where}: {REGION} as large as theory's, within its interval or 2 %."


def experiments_text(names: Sequence[str], count: int) -> str:
    """Return names of experiments as the subject of a sentence, or their number if they are all.

    >>> experiments_text(["1", "2"], 3), experiments_text(["a", "b", "c"], 3)
    ('Experiments 1 and 2', 'All 3 experiments')
    """
    if len(names) == count > 2:
        return f"All {count} experiments"
    return f"Experiment{'s' if len(names) > 1 else ''} {listed(names)}"

"""The report: what a reader finds on the page, read back from the HTML."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from html_pages import Outline
from report_data import HOSTILE, bare, report_data
from trial_pages import trial_page

from pipeline.base.errors import PipelineError
from pipeline.base.provenance import digest
from pipeline.records.models import ComparisonRow
from pipeline.rendering.report import report
from pipeline.rendering.report.report import ReportData
from pipeline.rendering.report.report_parts import CELLS_META, take_apart


@pytest.fixture(scope="module")
def numbers() -> str:
    return report.render(report_data(full=False))


@pytest.fixture(scope="module")
def page() -> str:
    return report.render(report_data())


def test_page_is_well_formed_with_language_headings_in_order_and_described_tables(page: str) -> None:
    outline = Outline(page)
    tags = [tag for tag, _ in outline.tags]
    assert dict(outline.tags)["html"]["lang"] == "en"
    levels = [int(tag[1]) for tag in tags if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(b - a <= 1 for a, b in pairwise(levels))
    assert tags.count("table") == tags.count("caption") > 5
    assert all("scope" in attributes for tag, attributes in outline.tags if tag == "th")
    assert all(a.get("role") == "img" for tag, a in outline.tags if tag == "svg")


def test_page_needs_nothing_but_itself(page: str) -> None:
    for tag, attributes in Outline(page).tags:
        assert tag not in ("link", "iframe", "object", "embed", "form", "base")
        for name in ("src", "href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith("#")
    assert not re.search(r"https?:|@import|url\((?!#)", page)  # a page with trials names the origin of its plot library


def test_identifiers_are_unique(page: str) -> None:
    identifiers = [a["id"] for _, a in Outline(page).tags if "id" in a]
    assert len(identifiers) == len(set(identifiers))


def test_a_report_is_the_same_each_time(page: str) -> None:
    start = time.process_time()
    again = report.render(report_data())
    assert time.process_time() - start < 10  # 5 s on one free core; twice that leaves room for a busy one
    assert again == page
    assert len(page.encode()) < 2_000_000
    assert page.count("<figcaption") == 3


def test_cells_hold_the_numbers_as_printed(numbers: str) -> None:
    found = take_apart(numbers).cells
    assert found["D.1/settle_2pct/theory_discrete/stiffness"] == "4469"
    assert found["D.1/settle_2pct/theory_discrete/damping"] == "73.05"
    assert found["D.1/settle_2pct/experiment_1/deviation_percent"] == "\N{MINUS SIGN}14.7"
    assert found["D.2/energy_step_w2/theory_discrete/cost"] == "871.32"
    assert found["D.6/settle_2pct/experiment/d=2/cost"] == "16.50"
    assert found["D.6/settle_2pct/experiment/d=2/published_cost"] == "14.85"
    assert found["D.6/energy_step_w2/experiment/d=5/cost"].startswith("–")
    assert found["experiments/1/mass"].startswith("0.580")
    assert "0.563 to 0.603" in found["experiments/1/mass"]


def test_overshoot_is_printed_in_percent() -> None:
    data = report_data(full=False)
    row = ComparisonRow(table="D.1", criterion="overshoot", condition="experiment_1", delay_samples=None,
                        stiffness=1.0, damping=2.0, cost=0.125)  # fmt: skip
    page = report.render(ReportData(data.result.model_copy(update={"tables": (row,)})))
    assert take_apart(page).cells["D.1/overshoot/experiment_1/cost"] == "12.50"
    assert "overshoot [%]" in page


def test_missing_value_gives_its_reason(numbers: str) -> None:
    assert take_apart(numbers).cells["D.6/energy_step_w2/experiment/d=5/cost"] == "– a"
    assert re.search(r"<sup>a</sup>no stable trial with this cost", numbers)
    assert "no logs with K = 0 and B &lt;= 0 in this experiment" in numbers.replace("\N{NO-BREAK SPACE}", " ")


def test_censored_and_erratum_are_footnotes(numbers: str) -> None:
    assert take_apart(numbers).cells["D.1/settle_2pct/experiment_2/condition"] == "experiment 2 b"
    assert re.search(r"<sup>b</sup>At the edge of the tested range", numbers)
    assert re.search(r"<sup>a</sup>the printed value is a known erratum", numbers)


def test_digest_shows_any_changed_cell(numbers: str) -> None:
    assert take_apart(numbers).metas.get(CELLS_META) == digest(take_apart(numbers).cells)
    changed = numbers.replace(">4469<", ">4470<", 1)
    assert changed != numbers
    assert take_apart(changed).metas.get(CELLS_META) != digest(take_apart(changed).cells)


def test_hostile_names_are_harmless() -> None:
    page = report.render(report_data(full=False, hostile=True))
    tags = [[tag for tag, _ in Outline(p).tags] for p in (page, report.render(report_data(full=False)))]
    assert tags[0].count("script") == tags[1].count("script") == 3  # tables, the explorer and its data
    assert take_apart(page).cells[f"experiments/{HOSTILE}/experiment"] == HOSTILE


def test_sections_without_data_are_left_out() -> None:
    page = report.render(bare(report_data(full=False)))
    headings = re.findall(r"<h2>(.*?)</h2>", page)
    assert headings == ["Appendix: definitions, accuracy, origin"]
    assert re.findall(r"<h3>(.*?)</h3>", page) == ["Definitions"]
    assert "<table" not in page
    assert ">simulated" not in page
    assert "logs are simulated" not in page
    links = set(re.findall(r'href="#([^"]+)"', page))
    assert links == {"main", "contents", "sec-definitions"}


def test_every_link_leads_to_a_part_of_the_page(page: str) -> None:
    identifiers = {a["id"] for _, a in Outline(page).tags if "id" in a}
    links = {link[1:] for link in Outline(page).links}
    assert len(links) > 6
    assert links <= identifiers


def test_questions_stand_in_the_order_in_which_a_reader_asks_them() -> None:
    page = report.render(replace(report_data(), trials=trial_page()))
    assert re.findall(r"<h2>(.*?)</h2>", page) == [
        "Stability boundary",
        "Costs",
        "Explore the trials",
        "Estimates",
        "Appendix: definitions, accuracy, origin",
    ]


def test_numbers_of_a_trial_refer_to_it_and_others_do_not(numbers: str) -> None:
    assert "data-trial" not in numbers
    data = report_data(full=False)
    best = data.result.experiments[0].optimum["settle_2pct"].model_copy(update={"trial_id": "trial 3"})
    first = data.result.experiments[0].model_copy(update={"optimum": {"settle_2pct": best}})
    result = data.result.model_copy(update={"experiments": (first,)})
    point = first.boundary[4]
    trials = replace(trial_page(), limits={("1", point.damping, point.stable): "0-7"})
    page = report.render(replace(data, result=result, trials=trials))
    refer, row = {}, ""
    for _, a in Outline(page).tags:
        row = a.get("data-row") or row
        if a.get("data-trial"):
            refer[f"{row}/{a['data-cell']}"] = a["data-trial"]
    limit = f"boundary/1/{point.damping:g}/stable"
    assert refer == {limit: "0-7", **{f"optima/1/settle_2pct/{c}": "0-3" for c in ("stiffness", "damping", "cost")}}


def test_each_missing_value_is_marked_with_a_reason_below_its_table(numbers: str) -> None:
    parts = re.findall(r'<table class="cells[^"]*">.*?</table>\s*</div>(.*?)</div>', numbers, flags=re.DOTALL)
    tables = re.findall(r'<table class="cells[^"]*">.*?</table>', numbers, flags=re.DOTALL)
    marked = 0
    for table, below in zip(tables, parts, strict=True):
        reasons = re.findall(r"<li>–<sup>(\d+)</sup> <span>([^<]+)</span></li>", below)
        marks = set(re.findall(r'<abbr data-why="(\d+)">–', table))
        assert marks == {number for number, _ in reasons}
        assert all(text.strip() for _, text in reasons)
        marked += len(marks)
    assert marked > 3
    # a missing value without such a mark has a note of its table
    assert not re.findall(r">–</t[dh]>", numbers)


def test_simulated_logs_are_announced_before_any_number(numbers: str) -> None:
    assert numbers.index("All logs are simulated") < numbers.index("</header>")


def test_rotation_has_rotational_units() -> None:
    page = report.render(report_data(full=False, motion="rotation"))
    assert "stiffness K [Nm/rad]" in page
    assert "[N/m]" not in page


def test_equal_rows_are_refused_with_their_name() -> None:
    data = report_data(full=False)
    double = data.result.model_copy(update={"tables": (*data.result.tables, data.result.tables[0])})
    with pytest.raises(PipelineError, match=r"D\.1/settle_2pct/theory_discrete/condition"):
        report.render(replace(data, result=double))


def test_write_leaves_one_complete_file(tmp_path: Path, numbers: str) -> None:
    report.write(report_data(full=False), tmp_path / "reports" / "r.html")
    assert [p.name for p in (tmp_path / "reports").iterdir()] == ["r.html"]
    assert (tmp_path / "reports" / "r.html").read_text(encoding="utf-8") == numbers


def optimum_rows(measured_delay: float) -> tuple[ComparisonRow, ...]:
    """A table of optima whose experiment has another delay than theory supposes."""
    return tuple(
        ComparisonRow(table="D.1", criterion=c, condition=condition, delay_samples=delay, stiffness=k, damping=70.0,
                      cost=cost)
        for c, cost in (("settle_2pct", 24.0), ("energy_step_w0", 13.8))
        for condition, delay, k in (("theory_discrete", 4.0, 4470.0), ("experiment_1", measured_delay, 5200.0))
    )  # fmt: skip


def test_optima_stay_a_table_of_optima_where_the_estimated_delay_is_not_that_of_theory() -> None:
    data = report_data(full=False)
    result = data.result.model_copy(update={"tables": optimum_rows(3.0)})
    found = take_apart(report.render(replace(data, result=result))).cells
    assert found["D.1/settle_2pct/experiment_1/stiffness"] == "5200"
    assert found["D.1/energy_step_w0/theory_discrete/stiffness"] == "4470"
    assert not any("/d=" in name for name in found)


def test_two_experiments_of_one_delay_both_stand_in_the_table_over_delay() -> None:
    rows = [
        ComparisonRow(table="delay", criterion="settle_2pct", condition=condition, delay_samples=delay, stiffness=None,
                      damping=None, cost=cost, experiment=experiment)
        for name, delay, theory, measured in (("a", 3.0, 20.0, 22.0), ("b", 5.0, 30.0, 33.0), ("c", 5.0, 29.0, 31.0),
                                              ("d", None, None, 40.0))
        for condition, cost, experiment in (("theory_discrete", theory, None), ("experiment", measured, name))
        if cost is not None
    ]  # fmt: skip
    data = report_data(full=False)
    page = report.render(replace(data, result=data.result.model_copy(update={"tables": tuple(rows)})))
    found = take_apart(page).cells
    read = {name: text for name, text in found.items() if name.startswith("delay/") and name.endswith("/cost")}
    at = "delay/settle_2pct"
    assert read == {
        f"{at}/theory_discrete/d=3/cost": "20", f"{at}/experiment/d=3/cost": "22",
        f"{at}/theory_discrete/d=5/b/cost": "30", f"{at}/experiment/d=5/b/cost": "33",
        f"{at}/theory_discrete/d=5/c/cost": "29", f"{at}/experiment/d=5/c/cost": "31", f"{at}/experiment/d/cost": "40",
    }  # fmt: skip


def test_published_values_have_the_digits_that_were_published() -> None:
    row = ComparisonRow(table="D.2", criterion="energy_step_w2", condition="theory_discrete", delay_samples=4.0,
                        stiffness=5645.0, damping=90.79, cost=1329.8412, published_stiffness=5645.0,
                        published_damping=90.8, published_cost=1329.84)  # fmt: skip
    data = report_data(full=False)
    found = take_apart(report.render(replace(data, result=data.result.model_copy(update={"tables": (row,)})))).cells
    at = "D.2/energy_step_w2/theory_discrete"
    assert [found[f"{at}/{name}"] for name in ("cost", "published_damping", "published_cost")] == [
        "1329.8",
        "90.8",
        "1329.84",
    ]

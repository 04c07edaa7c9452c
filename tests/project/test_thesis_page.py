"""docs/thesis.md: every line of output is what its commands print, and every key is one of a comparison's document."""

import json
import re
import shlex

import numpy as np
import pytest
from places import ROOT

from pipeline.device_data.published import find, published_deviation
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.findings import Optimum
from pipeline.records.models import ComparisonRow
from pipeline.records.results import Answer, ExperimentResult, Prediction, Scores
from pipeline.shell.cli import run
from pipeline.shell.demo import run_demo
from pipeline.theory.curves import best_damping
from pipeline.theory.optimum import optimal_point, scaling_factor

PAGE = (ROOT / "docs" / "thesis.md").read_text(encoding="utf-8")
PAIRS = re.findall(r"```sh\n(.*?)```\n+```text\n(.*?)```", PAGE, re.DOTALL)
RECORDS = {
    "answer": Answer,
    "answer.predicts": Prediction,
    "optimum": Optimum,
    "scores": Scores,
    "tables": ComparisonRow,
}


def words(text):
    return " ".join(text.replace("\N{MINUS SIGN}", "-").split())


@pytest.mark.parametrize(("commands", "output"), PAIRS, ids=[pair[0].splitlines()[0] for pair in PAIRS])
def test_a_command_prints_what_the_page_shows(capsys, commands, output):
    for command in commands.splitlines():
        with pytest.raises(SystemExit) as leaving:
            run(*[shlex.split(command)[1:]])
        assert not leaving.value.code
    printed = words(capsys.readouterr().out)
    for line in output.splitlines():
        assert words(line) in printed, line


def test_the_page_has_a_command_for_each_chapter():
    chapters = re.split(r"\n## ", PAGE)[1:-1]
    assert [chapter[:9] for chapter in chapters] == ["Chapter 3", "Chapter 4", "Chapter 5", "Chapter 6"]
    assert all("```sh" in chapter for chapter in chapters)


def test_the_keys_that_the_table_names_are_those_of_the_document():
    # behind the head
    table = PAGE.split("### The same in the demo")[0]
    rows = [line.split("|")[3] for line in table.splitlines() if line.startswith("| ")][1:]
    assert len(rows) == 14
    for cell in rows:
        for name in re.findall(r"`([a-z_.0-9]+)`", cell):
            head, _, tail = name.rpartition(".")
            if head in RECORDS:
                assert tail in RECORDS[head].model_fields or (head, tail) == ("optimum", "overshoot"), name
            else:
                first = name.split(".")[0]
                known = {*ExperimentResult.model_fields, "tables", "scene"}
                known |= set(ComparisonRow.model_fields) | set(Prediction.model_fields)
                assert first in known, name


def test_the_sections_that_the_table_names_are_those_of_a_report(falcon_outcome):
    page = falcon_outcome.report.read_text(encoding="utf-8")
    for name in ("Does theory predict it?", "within 5 %", "limit over K", "largest stable B", "How sure?"):
        assert name in PAGE
        assert name in page.replace("&nbsp;", " ").replace("\N{NO-BREAK SPACE}", " "), name


def jump(criterion, low, high):
    """Stiffness at which the best damping jumps most."""
    while high - low > 1e-6:
        alpha = np.linspace(low, high, 9)
        best = best_damping(NormalisedLoop.ideal(0.0, 0.0, 0.0), criterion, alpha).best
        i = int(np.argmax(np.abs(np.diff(best))))
        low, high = alpha[i], alpha[i + 1]
    return low


@pytest.mark.slow
def test_errata_of_theory_are_as_computed():
    table = PAGE.split("## Errata")[1]
    assert f"α = {jump('settle_2pct', 0.300, 0.308):.5f}" in table
    assert f"α = {jump('overshoot', 0.300, 0.308):.5f}" in table
    loop = NormalisedLoop.ideal(0.0, 0.0, 0.0)
    for w in range(3):
        points = [optimal_point(loop, f"energy_step_w{w}{end}") for end in ("_discrete", "")]
        assert f"{100 * (points[0].alpha / points[1].alpha - 1):.2f} %" in table
    changes = [
        100 * abs(scaling_factor(name, 10.0) / scaling_factor(name, 8.0) - 1)
        for name in ("pole_radius", "energy_step_w0", "energy_step_w1", "energy_step_w2")
    ]
    assert f"up to {changes[0]:.3f} % (poles), {max(changes[1:]):.3f} % (energies)" in table


def test_errata_of_experiments_are_those_of_the_printed_tables():
    table = PAGE.split("## Errata")[1]
    assert f"{find('D.1', 'overshoot', 'experiment_2').stiffness:,.0f} N/m for experiment 2" in table
    off = published_deviation(find("D.2", "energy_step_w2", "experiment_1"))
    assert f"{-off:.1f} % below (D.2" in table
    theory, measured = (find("D.4", "overshoot", name) for name in ("theory_discrete", "experiment"))
    wrong = [100 * (getattr(theory, name) / getattr(measured, name) - 1) for name in ("damping", "stiffness")]
    assert wrong == [pytest.approx(129.6, abs=0.1), pytest.approx(121.5, abs=0.1)]
    assert f"−{-published_deviation(find('D.6', 'settle_2pct', 'experiment', 6)):.1f} % (32 for 35" in table


@pytest.fixture(scope="module")
def demo_documents(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    run_demo(folder)
    names = ("falcon", "falcon-real", "lwr")
    return {name: json.loads((folder / "reports" / f"{name}.json").read_text()) for name in names}


@pytest.mark.slow
def test_the_conclusions_have_the_numbers_of_the_demo(demo_documents):
    """Each number of the last column, as a reader of the reports' documents finds it."""
    table = PAGE.split("### The same in the demo")[1].split("## Errata")[0]
    rows = [line.split("|")[1:5] for line in table.splitlines() if line.startswith("| ")]
    cells = {row[0].strip(): row[3].strip().replace("−", "-").replace("\N{MINUS SIGN}", "-") for row in rows[1:]}
    assert len(cells) == 14
    of = {name: {e["experiment"]: e for e in each["experiments"]} for name, each in demo_documents.items()}
    first, hand, real = of["falcon"]["1"], of["falcon"]["6"], of["falcon-real"]["1"]
    tables = {
        (name, row["table"], row["criterion"], row["condition"], row["delay_samples"]): row
        for name, each in demo_documents.items()
        for row in each["tables"]
    }
    settling = tables["falcon", "D.1", "settle_2pct", "experiment_1", 4.0]
    over_delay = [tables["lwr", "D.6", "energy_step_w0", "experiment", d]["deviation_percent"] for d in (2.0, 4.0)]
    predicts, reach = first["answer"]["predicts"], first["answer"]["reachable"]
    delay = next(each["value"] for each in real["answer"]["estimates"] if each["name"] == "delay_samples")
    near = [hand["optimum"][f"energy_step_w{w}"]["near"] for w in (0, 2)]
    line, implied = real["straight_bound"], real["implied_delay"]
    scatter = [e["optimum"]["energy_step_w2"]["scatter_percent"] for e in (first, hand)]
    damping = next(s["damping"]["deviation_percent"] for s in hand["scores"])
    expected = {
        "optimal costs, not the boundary's shape": f"costs {predicts['optimal_costs']} "
        f"({predicts['costs_percent']:.1f} %), "
        f"boundary {predicts['boundary']}: {predicts['above']} of {predicts['bounded']} limits",
        "not the optimum's place": f"{settling['stiffness_deviation_percent']:.0f} %, "
        f"{settling['damping_deviation_percent']:.0f} %",
        "settling follows from the delay": f"{reach['best']:.1f} samples, tested walls reach {reach['reached']:.0f}",
        "smallest delay near the origin": f"{implied['origin']['value']:.2f} near the origin, "
        f"{implied['whole']['value']:.2f} as a whole, logs {delay:.2f}",
        "straight upper part": f"K ≤ {line['stiffness']:,.0f} - {-line['slope']:.0f} B "
        f"(slope {line['slope_low']:.0f} to {line['slope_high']:.0f})",
        "with a hand close to the border": f"≥ {hand['optimum']['energy_step_w0']['margin']:.1f}",
        "larger w, sharper optimum": f"K {near[0]['stiffness_low']:,.0f} to {near[0]['stiffness_high']:,.0f}; "
        f"{near[1]['stiffness_low']:,.0f} alone",
        "noisier with a hand": f"{scatter[0]:.0f} %, {scatter[1]:.0f} %",
        "a region without overshoot": f"{real['optimum']['overshoot']['stiffness']:,.0f} N/m",
        "smaller range of damping": f"{damping:.0f} %",
        "costs converge over delay": f"+{over_delay[0]:.1f} %, +{over_delay[1]:.1f} %",
        "apparent inertia": f"{first['loop']['mass']['value']:.3f} kg, {first['masses'][1]['percent']:.1f} % from",
        "settling needs no inertia": "left out",
        "optima are not passive": "no",
    }
    assert cells.keys() == expected.keys()
    for name, text in expected.items():
        assert text in cells[name], (name, text, cells[name])
    assert near[1]["stiffness_low"] == near[1]["stiffness_high"]
    assert not any(best["passive"] for e in of["lwr"].values() for best in e["optimum"].values())

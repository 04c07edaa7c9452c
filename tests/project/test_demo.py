import json
from pathlib import Path

import pytest
from places import ROOT

from pipeline.base.errors import PipelineError
from pipeline.rendering.report.report_parts import CELLS_META, take_apart
from pipeline.shell import demo
from pipeline.store.storage import read_trials

pytestmark = pytest.mark.slow

SMALL = (demo.Part("lwr", ("delay-8",), coarsen=3),)


def stamps(folder: Path) -> dict[str, int]:
    return {str(p): p.stat().st_mtime_ns for p in folder.rglob("*.parquet")}


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    said = []
    return folder, demo.run_demo(folder, report_progress=said.append, parts=SMALL), said


def test_demo_goes_from_logs_to_a_complete_report(first):
    folder, outcome, said = first
    logs = list((folder / "raw" / "demo" / "lwr" / "delay-8").glob("*.csv"))
    assert len(logs) > 20
    assert read_trials(folder / "processed" / "demo").num_rows == len(logs)
    assert outcome[0] == [folder / "reports" / "lwr.html"]
    page = outcome[0][0].read_text(encoding="utf-8")
    assert take_apart(page).metas.get(CELLS_META) is not None
    assert take_apart(page).cells
    assert 'href="./lwr.html"' in (folder / "reports" / "index.html").read_text(encoding="utf-8")
    assert str(folder / "reports" / "index.html") in " ".join(outcome[1])
    assert [s for s in said if s.startswith("simulate")] == ["simulate: lwr, experiment delay-8"]


def test_key_result_holds_the_largest_stable_stiffness_of_the_course(first):
    folder, outcome, _ = first
    truth = json.loads((folder / "raw/demo/lwr/delay-8/truth.json").read_text())
    # the ideal LWR has no jitter, so its poles say what is stable
    stable = max(log["stiffness"] for log in truth["logs"].values() if log["spectral_radius"] < 1)
    text = " ".join(outcome[1])
    assert str(folder / "reports" / "lwr.html") in text
    document = json.loads((folder / "reports/lwr.json").read_text())
    (experiment,) = document["experiments"]
    stiffest = max(experiment["boundary"], key=lambda point: point["stable"] or 0.0)
    assert stiffest["stable"] == stable
    (told,) = (each for each in document["answer"]["estimates"] if each["name"] == "stiffness_max")
    assert told["low"] <= told["value"] <= told["high"]
    assert stable <= told["high"]
    assert told["low"] <= stiffest["unstable"]
    assert "largest stable K " in text


def test_clean_keeps_what_was_ingested_and_reported():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    removed = makefile.split("\nclean:\n")[1].splitlines()[0].split()
    assert {"raw/demo", "processed/demo"} <= set(removed)
    assert not {"raw", "processed", "reports"} & set(removed)


def test_second_demo_stores_nothing_anew(first):
    folder, outcome, _ = first
    before = stamps(folder / "processed")
    assert before
    again = demo.run_demo(folder, parts=SMALL)
    assert stamps(folder / "processed") == before
    assert again[1][1:] == outcome[1][1:]


def test_demo_leaves_foreign_files_alone_and_says_so(first):
    folder, _, _ = first
    foreign = folder / "raw" / "demo" / "mine.csv"
    foreign.write_text("not,a,log\n")
    try:
        with pytest.raises(PipelineError, match=r"mine\.csv"):
            demo.run_demo(folder, parts=SMALL)
        assert foreign.read_text() == "not,a,log\n"
    finally:
        foreign.unlink()

"""docs/python.md: its ten tasks run one after the other, in an empty folder, and give what the page says."""

import re

import matplotlib
import numpy as np
import pytest
from places import ROOT

import pipeline

pytestmark = pytest.mark.slow

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def done(tmp_path_factory, one_process):
    """Names that the examples leave behind, and their folder."""
    folder = tmp_path_factory.mktemp("notebook")
    names: dict = {}
    with pytest.MonkeyPatch.context() as patch, matplotlib.rc_context():
        patch.chdir(folder)
        matplotlib.use("agg")
        for block in BLOCKS:
            exec(compile(block, "docs/python.md", "exec"), names)
    names["plt"].close("all")
    return names, folder


def test_ten_tasks_are_shown():
    assert re.findall(r"^## (\d+) ", PAGE, re.MULTILINE) == [str(number) for number in range(1, 11)]
    assert len(BLOCKS) == 13


def test_every_public_name_is_on_the_page():
    missing = [name for name in pipeline.__all__ if name not in re.findall(r"\bpipeline\.(\w+)", PAGE)]
    assert missing == ["Comparison", "Design"], "what compare, load and design return"


def test_simulated_logs_are_ingested_and_read_as_they_are(done):
    names, folder = done
    assert names["report"].found == names["report"].ingested == len(names["simulated"]) > 20
    by_walls = {(f.attrs["stiffness"], f.attrs["damping"], f.attrs["trial"]): f for f in names["simulated"]}
    files = {path.stem: path for path in (folder / "logs").rglob("*.csv")}
    assert len(by_walls) == len(files)
    for (_, _, trial), frame in list(by_walls.items())[::5]:
        read = pipeline.read_log(files[trial])
        assert read.equals(frame)
        assert {key: frame.attrs[key] for key in read.attrs.keys() & frame.attrs.keys()} == {
            key: read.attrs[key] for key in read.attrs.keys() & frame.attrs.keys()
        }
    stored = pipeline.samples(folder / "processed", names["stiffest"]["trial_id"])
    source = pipeline.read_log(names["stiffest"]["source_path"])
    assert stored.equals(source)
    assert stored.attrs["stiffness"] == source.attrs["stiffness"] == names["trials"]["stiffness"].max()


def test_tables_are_those_of_the_stages(done):
    names, _ = done
    boundary, trials, costs = names["boundary"], names["trials"], names["costs"]
    assert (boundary["stable"].dropna() < boundary.loc[boundary["stable"].notna(), "unstable"].fillna(np.inf)).all()
    assert boundary["trials"].sum() <= len(trials) == costs["trial_id"].nunique()
    best = names["optima"].loc["energy_step_w0"]
    row = costs[(costs["criterion"] == "energy_step_w0") & (costs["trial_id"] == best["trial_id"])].iloc[0]
    assert row["cost"] == best["cost"]
    stable = costs[(costs["criterion"] == "energy_step_w0") & (costs["verdict"] == "stable")]
    assert stable["cost"].min() == best["cost"]
    assert names["overshoot"].min(axis=None) >= 0
    assert set(names["overshoot"].columns) <= set(trials["stiffness"])
    mass = names["estimates"].loc["mass"]
    assert (mass["unit"], mass["low"] < mass["value"] < mass["high"]) == ("kg m^2", True)


def test_report_is_written_and_loaded(done):
    names, folder = done
    assert (folder / "reports" / "lwr.html").stat().st_size > 100_000
    comparison, earlier = names["comparison"], names["earlier"]
    for table in ("tables", "estimates", "boundary", "optima", "scores"):
        assert getattr(earlier, table).equals(getattr(comparison, table))
        assert len(getattr(comparison, table)) > 0
    region = comparison.scores.query("score == 'region' and quantity == 'overlap'")
    assert ((region["low"] <= region["value"]) & (region["value"] <= region["high"])).all()
    assert region["basis"].tolist() == ["device file"]
    page = comparison._repr_html_()
    assert comparison.summary[0].split()[0] in page
    with pytest.raises(pipeline.PipelineError, match="loaded from a document"):
        earlier.write(folder / "again.html")
    assert not (folder / "again.html").exists()


def test_theory_is_in_si(done):
    names, folder = done
    assert names["walls"]["stable"].tolist() == [True, True, False]
    assert names["grid"].shape == (31, 31)
    assert names["cost_map"]["stiffness"].max() == pytest.approx(names["limit"].attrs["stiffness_max"], rel=1e-12)
    assert (folder / "map.png").stat().st_size > 1000

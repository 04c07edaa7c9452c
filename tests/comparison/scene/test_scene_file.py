"""Scene files: mistakes by line and key, drafts that can be read, and reports with nothing but what was asked for."""

from __future__ import annotations

import json
import re
import shutil
import tomllib

import pytest
from labs import compare
from places import ROOT
from typer.testing import CliRunner

from pipeline.base.errors import DeviceError, SceneError
from pipeline.comparison.scene.scene import LEAVE_OUT, open_scene
from pipeline.comparison.scene.scene_file import draft_scene, read_scene
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.models import SceneFile, Shown
from pipeline.rendering.report.report_parts import take_apart
from pipeline.shell.cli import app
from pipeline.theory import predictions

pytestmark = pytest.mark.usefixtures("one_process")

WRONG = """\
# a comment
device = "falcon"
criteria = ["settle", "overshot"]
bands = [2,
         3]

figure = ["maps"]
overlays = ["theory", "estimate"]
delays = [-1]
tables = "D.1"
"""


@pytest.fixture
def scene(tmp_path):
    def write(text: str):
        path = tmp_path / "scene.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_every_mistake_is_told_with_file_line_and_key(scene):
    path = scene(WRONG)
    with pytest.raises(SceneError) as caught:
        read_scene(path)
    lines = str(caught.value).splitlines()
    assert [line.removeprefix(f"{path}:").split(":")[0] for line in lines] == ["3", "4", "7", "8", "9", "10"]
    keys = [re.search(r"key '([^']*)'", line)[1] for line in lines]
    assert keys == ["criteria.1", "bands.1", "figure", "overlays.1", "delays.0", "tables"]
    assert "Did you mean 'overshoot'?" in lines[0]
    assert "found 3" in lines[1]
    assert "did you mean 'figures'?" in lines[2]
    assert "Did you mean 'estimates'?" in lines[3]
    assert "greater than or equal to 0, found -1" in lines[4]


def test_a_missing_device_and_a_wrong_syntax_are_told(scene, tmp_path):
    with pytest.raises(SceneError, match=r"scene\.toml:1: key 'device': missing"):
        read_scene(scene('criteria = ["overshoot"]\n'))
    with pytest.raises(SceneError, match=r"is not TOML: Invalid value \(at end of document\)"):
        read_scene(scene('device = "a"\ncriteria = [\n'))
    with pytest.raises(SceneError, match="--save-scene"):
        read_scene(tmp_path / "none.toml")


def test_bands_spell_out_settle_and_leave_the_other_criteria():
    assert SceneFile(device="a").chosen_criteria == (
        *("settle_1pct", "settle_2pct", "settle_5pct", "overshoot"),
        *("energy_step_w0", "energy_step_w1", "energy_step_w2"),
    )
    asked = SceneFile(device="a", criteria=("overshoot", "settle", "settle_2pct"), bands=(2, 1))
    assert asked.chosen_criteria == ("overshoot", "settle_2pct", "settle_1pct")


def test_a_draft_can_be_read_and_asks_for_all_that_is_stored(lwr, scene):
    text = draft_scene("lwr", lwr.processed)
    asked = read_scene(scene(text))
    whole = open_scene("lwr", lwr.processed, None, None).scene
    assert (asked.device, asked.experiments) == ("lwr", whole.experiments)
    assert set(asked.chosen_criteria) == set(whole.criteria)
    assert {"D.4", "D.5", "D.6"} <= set(asked.tables)
    assert set(tomllib.loads(text)) == set(SceneFile.model_fields) - {"delays"}
    with pytest.raises(DeviceError):
        draft_scene("phantom", lwr.processed)


HOSTILE = 'a"\\\n[x]\x00 = é'


def test_a_draft_holds_hostile_names(monkeypatch, falcon, scene):
    data = open_scene("falcon", falcon.processed, None, None)
    object.__setattr__(data.experiments[0], "experiment", HOSTILE)
    monkeypatch.setattr("pipeline.comparison.scene.scene_file.open_scene", lambda *_: data)
    asked = read_scene(scene(draft_scene(HOSTILE, falcon.processed)))
    assert (asked.device, asked.experiments) == (HOSTILE, (HOSTILE,))


def test_shipped_schema_tells_the_same_mistakes():

    schema = json.loads((ROOT / "schemas" / "scene_file.json").read_text(encoding="utf-8"))
    assert set(schema["properties"]) == set(SceneFile.model_fields)
    assert schema["required"] == ["device"]
    assert schema["additionalProperties"] is False


# --- only what is asked for -------------------------------------------------------------------------------------------

SETTLING = Shown(figures=("boundaries", "maps"), tables=("D.1", "boundary"), overlays=("theory",))


def figures_of(page: str) -> list[str]:
    return re.findall(r'<figure id="([^"]+)"', page)


@pytest.fixture(scope="module")
def settling(falcon, tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "settling.html"
    outcome = compare("falcon", falcon.processed, criteria=["settle_2pct"], report=path, shown=SETTLING)
    return outcome, path.read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_settling_scene_has_its_figures_and_tables_and_no_empty_section(settling):
    outcome, page = settling
    tables = {name.split("/")[0] for name in take_apart(page).cells}
    assert {"D.1", "boundary"} <= tables <= {"D.1", "boundary", "missing", "stages", "provenance", "accuracy"}
    assert {row.criterion for row in outcome.result.tables} == {"settle_2pct"}
    assert figures_of(page) == ["boundaries-answer", "boundaries-sensitivity", "D-1-settle_2pct"]
    for section in re.findall(r"<section\b[^>]*>(.*?)(?=<section\b|</main>)", page, re.DOTALL):
        content = re.sub(r"<h\d[^>]*>.*?</h\d>|</section>", "", section, flags=re.DOTALL)
        if "<section" not in section and "<h2>" in section and "<h3>" not in section:
            assert re.sub(r"<[^>]*>|\s", "", content) or "<section" in page, section[:200]
    links = set(re.findall(r'href="#([^"]+)"', page))
    assert links <= set(re.findall(r'\bid="([^"]+)"', page)), "no link leads to a part that was left out"


@pytest.mark.slow
def test_what_the_scene_leaves_out_is_not_computed(falcon, tmp_path, monkeypatch):
    """Stages, optima and figures that nothing asks for would fail here."""

    def refuse(*_, **__):
        raise AssertionError("was computed")

    real_stage = ExperimentStages._computed

    def compute(self, stage):
        assert stage not in ("outcome", "mass", "damping", "energy", "overshoot")
        return real_stage(self, stage)

    monkeypatch.setattr(ExperimentStages, "_computed", compute)
    asked = []
    real = predictions.optimal_point
    monkeypatch.setattr(predictions, "optimal_point", lambda loop, c: asked.append(c) or real(loop, c))
    monkeypatch.setattr("pipeline.comparison.compare.trial_page", refuse)
    shutil.copytree(falcon.processed, tmp_path / "p", ignore=shutil.ignore_patterns("stages", "theory"))
    only = Shown(figures=("boundaries",), tables=("boundary",), overlays=())
    compare("falcon", tmp_path / "p", criteria=["settle_2pct"], report=tmp_path / "r.html", shown=only)
    assert asked == [], "no table and no map asks for an optimum"
    drawn = figures_of((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert drawn == ["boundaries-answer", "boundaries-sensitivity"]


def test_dry_run_tells_of_figures_and_tables(falcon, tmp_path):
    outcome = compare("falcon", falcon.processed, report=tmp_path / "r.html", dry_run=True, shown=SETTLING)
    plan = {stage: (action, reason) for stage, action, reason in outcome.stages}
    assert plan["figure: trials to inspect"] == (LEAVE_OUT, "the scene does not request it")
    assert plan["figure: cost maps"][0] == "run"
    assert plan["table: D.1"][0] == "run"
    assert plan["table: D.2"] == (LEAVE_OUT, "the scene does not request it")


def test_delays_of_the_scene_replace_those_of_the_device_file(falcon, tmp_path):
    only = Shown(figures=("boundaries",), tables=(), overlays=("theory",), delays=(2.5, 7))
    path = tmp_path / "r.html"
    compare("falcon", falcon.processed, criteria=["overshoot"], report=path, shown=only)
    page = path.read_text(encoding="utf-8")
    assert set(re.findall(r">theory of experiment [\w-]+, d = ([\d.]+)</text>", page)) == {"2.5", "7"}


def test_a_scene_is_saved_and_used(falcon, tmp_path):
    runner = CliRunner()
    path = tmp_path / "f.toml"
    processed = ["--processed", str(falcon.processed)]
    result = runner.invoke(app, ["compare", "--device", "falcon", "--save-scene", str(path), *processed])
    assert result.exit_code == 0, result.output
    assert runner.invoke(app, ["compare", "--device", "falcon", "--save-scene", str(path), *processed]).exit_code != 0
    only = tmp_path / "only.toml"
    only.write_text('device = "falcon"\ncriteria = ["overshoot"]\nfigures = []\ntables = ["D.1"]\noverlays = []\n')
    result = runner.invoke(
        app, ["compare", "--scene", str(only), *processed, "--report", str(tmp_path / "o.html"), "--json"]
    )
    assert result.exit_code == 0, result.output
    assert f"--scene {only}" in json.loads(result.stdout)["provenance"]["command"]
    assert figures_of((tmp_path / "o.html").read_text(encoding="utf-8")) == []
    assert read_scene(path).experiments == ("1",)
    result = runner.invoke(app, ["compare", "--scene", str(path), *processed, "--dry-run", "--criteria", "overshoot"])
    assert result.exit_code == 0, result.output
    assert "1: settling" in result.stdout
    assert "no settling time is requested" in result.stdout

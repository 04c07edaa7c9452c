"""The documentation as a site: it builds without a warning, is searched without a network, and does what it says."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from places import ROOT

import pipeline
from pipeline.shell.cli import run

pytestmark = pytest.mark.slow

DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("myst_nb", reason="no Sphinx: pip install -e '.[dev]'")
    folder: Path = tmp_path_factory.mktemp("site")
    words = ("-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(folder / "site"))
    done = subprocess.run([sys.executable, *words, "-d", str(folder / "tree")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.mark.slow
def test_it_builds_without_a_warning_and_asks_for_nothing(site: Path) -> None:
    pages = {path.stem for path in site.glob("*.html")}
    assert {path.stem for path in DOCS.glob("*.md")} <= pages
    for page in site.glob("*.html"):
        fetched = re.findall(
            r'<(?:script|link|img)[^>]+(?:src|href)="(https?:[^"]+)"', page.read_text(encoding="utf-8")
        )
        assert fetched == [], page.name


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    page = (site / "python.html").read_text(encoding="utf-8")
    assert [name for name in pipeline.__all__ if f'id="pipeline.{name}"' not in page] == []


@pytest.mark.browser
@pytest.mark.slow
def test_it_is_searched_without_a_server(site: Path, browser: Any) -> None:
    page = browser.new_page()
    page.goto(f"{(site / 'search.html').as_uri()}?q=quarantine")
    page.wait_for_selector('#search-results a[href*="storage.html"]', timeout=30_000)
    page.close()


def blocks(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_the_tutorial_goes_from_logs_to_a_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    printed = {}
    # the ten-minute path before it has a test of its own
    text = (DOCS / "tutorial.md").read_text(encoding="utf-8").partition("## 1 A box of logs")[2]
    commands = re.findall(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    for words in map(shlex.split, "".join(commands).splitlines()):
        assert words[0] == "pipeline"
        with pytest.raises(SystemExit) as leaving:
            run(words[1:])
        assert not leaving.value.code, words
        printed[words[1]] = capsys.readouterr().out
    named = [Path(name) for name in re.findall(r"\{(paper/[^}]+)\}", text)]
    assert len(named) == 2
    assert all(path.is_file() for path in named)
    assert "Does theory predict it? Boundary: with friction, yes." in printed["compare"]
    assert "Coulomb friction" in printed["compare"]
    truth = json.loads(Path("box/falcon-real/1/truth.json").read_text(encoding="utf-8"))
    assert "0.9" in json.dumps(truth)


@pytest.mark.slow
def test_the_notebook_prints_what_it_is_stored_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = json.loads((DOCS / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    stored = ""
    with matplotlib.rc_context():
        matplotlib.use("agg")
        for cell in cells:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), "docs/notebook.ipynb", "exec"), names)
                streams = [out for out in cell["outputs"] if out.get("name") == "stdout"]
                stored += "".join("".join(out["text"]) for out in streams)
        names["plt"].close("all")
    assert capsys.readouterr().out == stored != ""


@pytest.mark.slow
def test_a_matlab_script_gives_the_costs_of_one_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    octave = shutil.which("octave") or shutil.which("octave-cli")
    if octave is None:
        pytest.skip("no Octave: apt-get install octave")
    monkeypatch.chdir(tmp_path)
    logs = pipeline.simulate("lwr", "delay-2", seed=3, coarsen=6, duration_s=0.4, out="logs")
    pipeline.ingest("logs")
    found: dict[str, Any] = {}
    (block,) = (block for block in blocks("python.md", "python") if "by_wall" in block)
    exec(f"import pipeline\n{block}", found)
    costs = found["by_wall"]
    estimates = pipeline.estimates("processed", "lwr", "delay-2").set_index("quantity")["value"]
    held = 0
    for log in logs:
        K, B = log.attrs["stiffness"], log.attrs["damping"]
        expected = {name: costs.get((K, B, name), np.nan) for name in ("settle_2pct", "energy_step_w1", "overshoot")}
        if not np.isfinite(list(expected.values())).all() or expected["settle_2pct"] > 200:
            continue
        rows = np.column_stack([log["time_s"], log["command"], log["position"]])
        np.savetxt("one.csv", rows, delimiter=",", fmt="%.12g")
        given = (K, log.attrs["step"], estimates["mass"], estimates["delay_samples"])
        words = [octave, "--no-gui", str(DOCS / "migrate.m"), "one.csv", *map(str, given)]
        by_hand = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
        # noise decides by which sample a response is inside that touches the band, and x_0 is no single reading here
        assert by_hand["settle_2pct"] == pytest.approx(expected["settle_2pct"], abs=1)
        assert by_hand["energy_step_w1"] == pytest.approx(expected["energy_step_w1"], rel=0.05)
        held += 1
        if held == 5:
            break
    assert held == 5

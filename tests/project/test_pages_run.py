"""Pages whose examples run: storage, the README's section on clusters, and the gallery with its scripts."""

import ast
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from clusters import free_port
from native_logs import log_text
from places import ROOT

from pipeline.intake.ingest import ingest
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

PAGE = (ROOT / "docs" / "storage.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda text: text.split()[1].split(".")[0])
def test_examples_read_what_is_stored(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(4):
        Path(f"{number}.csv").write_text(log_text(100.0 * number, experiment="1" if number < 3 else "2"))
        # four batches, so that a folder has several files
        ingest([Path(f"{number}.csv")], Path("processed"), jobs=1)
    names: dict = {}
    exec(compile(block, "docs/storage.md", "exec"), names)
    trials = read_trials(Path("processed"), "bench", "1")
    loaded = load_trials(Path("processed"), trials)
    peaks = {trial.trial_id: float(trial.position.max()) for trial in loaded}
    table = names.get("table")
    if "unit" in names:
        assert names["unit"] == "m"
        assert dict(zip(names["trials"].column("trial_id").to_pylist(), names["peak"], strict=True)) == peaks
    elif "pl" in names:
        assert dict(table.select("trial_id", "peak").iter_rows()) == peaks
    else:
        assert dict(zip(table["trial_id"], table["peak"], strict=True)) == peaks
        assert sorted(table["stiffness"]) == [0.0, 100.0, 200.0]
        assert "pd" not in names or len(names["samples"]) == loaded.rows.sum()


def test_each_way_is_shown():
    for word in ("pandas", "polars", "duckdb", "pyarrow"):
        assert any(word in block for block in BLOCKS)


HEADING = "## More data than fits on one machine"
SHORTER = {
    "pipeline simulate lwr ": "pipeline simulate lwr --coarsen 12 --experiment delay-2 --experiment delay-3 ",
    "pipeline compare --device lwr ": "pipeline compare --device lwr --criteria settle_2pct --json ",
}


def script(ports):
    section = (ROOT / "README.md").read_text(encoding="utf-8").split(HEADING)[1].split("\n## ")[0]
    lines = re.findall(r"^ {4}(.*)$", section, flags=re.MULTILINE)
    assert lines[0].startswith("pip install"), "all else comes from packages"
    text = "\n".join(line.split("#")[0] for line in lines[1:])
    for old, new in (SHORTER | ports).items():
        assert old in text, old
        text = text.replace(old, new)
    return text


@pytest.mark.slow
def test_the_session_of_the_readme_is_what_the_commands_print(tmp_path):
    """Lines are compared up to three dots."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    session = re.search(r"^```text\n(\$.*?)^```$", readme, re.MULTILINE | re.DOTALL)
    assert session
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "500"}
    for part in re.split(r"^\$ ", session[1], flags=re.MULTILINE)[1:]:
        command, *expected = part.splitlines()
        assert command.startswith("pipeline ")
        call = [sys.executable, "-m", *command.split()]
        done = subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        printed = done.stdout.splitlines()
        for line, there in zip(expected, printed, strict=False):
            assert line == there or (line.endswith("...") and there.startswith(line.removesuffix("...").rstrip()))
        assert len(printed) >= len(expected)


@pytest.mark.slow
def test_the_commands_of_the_readme_work(tmp_path):
    store, leader = str(free_port()), str(free_port())
    ports = {"5000": store, "8786": leader, "dask scheduler ": f"dask scheduler --port {leader} --no-dashboard "}
    folder = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}", "OPENBLAS_NUM_THREADS": "1"}
    with open(tmp_path / "out", "wb") as out, open(tmp_path / "log", "wb") as log:
        command = ["bash", "-e", "-c", script(ports)]
        process = subprocess.Popen(
            command, cwd=tmp_path, env=environment, stdout=out, stderr=log, start_new_session=True
        )
        try:
            assert process.wait(600) == 0, (tmp_path / "log").read_text()
        finally:
            os.killpg(process.pid, signal.SIGKILL)
    assert '"command": "pipeline compare --device lwr ' in (tmp_path / "out").read_text()
    assert "--processed s3://lab/processed" in (tmp_path / "out").read_text()
    assert (tmp_path / "reports" / "lwr.html").stat().st_size > 100_000
    assert not (tmp_path / "processed").exists()


GALLERY = ROOT / "docs" / "gallery"
SCRIPTS = sorted(GALLERY.glob("figure_*.py"))
THESIS = {*(f"3.{n}" for n in range(5, 12)), *(f"4.{n}" for n in range(1, 6)), *(f"5.{n}" for n in range(1, 17))}
QUICK = ("figure_3_08", "figure_4_03", "figure_5_11")
LONGEST = 30
"""Lines of code of a script, without its caption."""


def number(script: Path) -> str:
    _, chapter, figure = script.stem.split("_")
    return f"{chapter}.{int(figure)}"


def test_every_data_figure_of_the_theory_chapters_is_there_and_on_the_page() -> None:
    assert {number(script) for script in SCRIPTS} == THESIS
    page = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
    for script in SCRIPTS:
        title = (ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or "").partition("\n")[0]
        assert f"Figure {number(script)}: {title}" in page
        assert f"gallery/{script.name}" in page
        assert (ROOT / "docs" / "img" / "gallery" / f"{script.stem}.svg").is_file()


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_is_short_and_imports_public_names_alone(script: Path) -> None:
    text = script.read_text(encoding="utf-8")
    tree = ast.parse(text)
    code = text[text.index('"""', 3) + 3 :].splitlines()
    assert len([line for line in code if line.strip()]) <= LONGEST
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(tree))
    assert imported <= {"pipeline", "numpy", "pandas", "matplotlib.pyplot"}
    assert not re.search(r"pipeline\.[a-z_]+\.|\b_[a-z]\w*\(", text)


@pytest.mark.sampled
@pytest.mark.parametrize(
    "script", [pytest.param(s, marks=() if s.stem in QUICK else pytest.mark.slow, id=s.stem) for s in SCRIPTS]
)
def test_a_script_runs_anywhere_without_a_warning(script: Path, tmp_path: Path) -> None:
    environment = os.environ | {"MPLBACKEND": "agg", "OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, "-W", "error", str(script)]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / f"{script.stem}.svg").read_text(encoding="utf-8").rstrip().endswith("</svg>")

"""A wheel in an environment of its own, outside the project: command line, data files, Python surface."""

import os
import re
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
from places import ROOT

BUILD = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--disable-pip-version-check"]
OFFLINE = ("No matching distribution", "Could not find a version", "Connection", "Temporary failure", "Max retries")
"""What pip says where it reaches no registry: the build needs hatchling from there."""


def pythons() -> dict[str, str]:
    """Every Python from 3.11 on that this machine has, by version: on the path, or kept by pyenv."""
    roots = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"), "versions").glob("3.*/bin/python")
    named = [*roots, *filter(None, (shutil.which(f"python3.{minor}") for minor in range(11, 20))), sys.executable]
    found = {}
    for python in map(str, named):
        code = "import sys; print('%d.%d' % sys.version_info[:2])"
        version = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False).stdout.strip()
        if re.fullmatch(r"3\.\d+", version) and int(version[2:]) >= 11:
            found[version] = python
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    built = subprocess.run([*BUILD, "--wheel-dir", folder, ROOT], capture_output=True, text=True, check=False)
    if built.returncode and any(words in built.stderr for words in OFFLINE):
        pytest.skip("hatchling cannot be had: no package registry is reached")
    assert built.returncode == 0, built.stderr
    (found,) = folder.glob("*.whl")
    return found


@pytest.mark.slow
def test_wheel_holds_what_is_needed_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith("METADATA"))
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "pipeline").rglob("*.py")}
    schemas = {f"pipeline/_{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "schemas").rglob("*.toml")}
    assert len(schemas) > 5
    assert sorted((modules | schemas | {"pipeline/py.typed"}) - names) == []
    assert {name.split("/")[0].split("-")[0] for name in names} == {"pipeline", "haptic_pipeline"}
    assert "Requires-Dist: pandas" in metadata


@pytest.mark.slow
def test_wheel_works_outside_the_project(wheel, tmp_path):
    """What it depends on is taken from here, by a path file after its own packages; the project is not on the path."""
    venv.create(tmp_path / "env", with_pip=False)
    scripts = tmp_path / "env" / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / ("python.exe" if os.name == "nt" else "python")
    where = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    site = subprocess.run([python, "-c", where], capture_output=True, text=True, check=True).stdout.strip()
    target = ["--prefix", str(tmp_path / "env"), "--no-deps", "--no-index", "--quiet", "--disable-pip-version-check"]
    subprocess.run([sys.executable, "-m", "pip", "install", *target, "--ignore-installed", wheel], check=True)
    # a path file inside a path file's folder is not read, so that the editable project is not found
    here = subprocess.run([sys.executable, "-c", where], capture_output=True, text=True, check=True).stdout.strip()
    Path(site, "dependencies.pth").write_text(here, encoding="utf-8")

    def run(*words: object) -> str:
        return subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path).stdout

    assert Path(run(python, "-c", "import pipeline; print(pipeline.__file__)").strip()).is_relative_to(site)
    assert run(scripts / "pipeline", "--version").startswith("pipeline ")
    assert run(scripts / "pipeline", "simulate", "lwr", "--experiment", "delay-2", "--coarsen", "16", "--out", "logs")
    run(scripts / "pipeline", "ingest", "logs")
    script = (
        "import pipeline\n"
        "print(pipeline.devices()['device'].tolist(), pipeline.trials()['profile'].unique().tolist())\n"
        "print(len(pipeline.boundary('processed', 'lwr')) > 0, pipeline.Loop(1.0, 1.0, 0.001, 1).boundary().shape[1])\n"
    )
    assert run(python, "-c", script).split("\n")[:2] == ["['lwr'] ['native']", "True 2"]
    # a bundle holds where nothing else is: no logs, no stored tables, no file of the project
    run(scripts / "pipeline", "compare", "--device", "lwr", "--criteria", "settle_2pct", "--report", "lwr.html")
    run(scripts / "pipeline", "bundle", "lwr.html", "--out", tmp_path / "alone" / "lwr.zip")
    for name in ("logs", "processed"):
        shutil.rmtree(tmp_path / name)
    told = subprocess.run(
        [scripts / "pipeline", "verify", "lwr.zip"], capture_output=True, text=True, check=True, cwd=tmp_path / "alone"
    ).stdout
    assert told.startswith("lwr.zip: all equal (")
    assert [path.name for path in (tmp_path / "alone").iterdir()] == ["lwr.zip"]


@pytest.mark.slow
@pytest.mark.parametrize("version", pythons())
def test_wheel_passes_demo_and_python_tasks_on_every_python(wheel, tmp_path, version):
    subprocess.run([pythons()[version], "-m", "venv", tmp_path / "env"], check=True)
    scripts = tmp_path / "env" / ("Scripts" if os.name == "nt" else "bin")
    pip = [scripts / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    done = subprocess.run([*pip, "-c", ROOT / "constraints.txt", wheel], capture_output=True, text=True, check=False)
    if done.returncode and any(words in done.stderr for words in OFFLINE):
        pytest.skip(f"packages for Python {version} cannot be had: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}

    def run(*words: object) -> str:
        return subprocess.run(
            words, capture_output=True, text=True, check=True, cwd=tmp_path, env=clean | {"MPLBACKEND": "agg"}
        ).stdout

    run(scripts / "pipeline", "demo")
    assert {path.name for path in (tmp_path / "reports").glob("*.html")} >= {"falcon.html", "lwr.html"}
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    tasks = "".join(re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL))
    (tmp_path / "tasks.py").write_text(tasks, encoding="utf-8")
    (tmp_path / "notebook").mkdir()
    run(scripts / "python", "-c", "import os, runpy; os.chdir('notebook'); runpy.run_path('../tasks.py')")

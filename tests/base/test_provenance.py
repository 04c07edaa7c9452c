"""A result is stale after an edit of any module that it can depend on, and of no other."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pyarrow as pa
import pytest

from pipeline.base import provenance
from pipeline.base.provenance import PACKAGE_FOLDER, code_digest, reachable, schema_folder
from pipeline.comparison import compare
from pipeline.comparison.compare import report_code
from pipeline.intake import ingest
from pipeline.measured.cost import cost_intervals, tail
from pipeline.measured.device import friction, onset
from pipeline.measured.experiment import boundary_band, known_delay
from pipeline.measured.fit import fit_jitter
from pipeline.measured.signal import events
from pipeline.measured.stages.stages import STAGES, ExperimentStages, required
from pipeline.readers.formats import hdf5
from pipeline.records import findings, models
from pipeline.rendering import labels
from pipeline.shell.cli import app
from pipeline.store import samples
from pipeline.theory.cost import refinement, slowmodes
from pipeline.theory.optimum import optimum

NAMES = {
    ".".join(path.relative_to(PACKAGE_FOLDER.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE_FOLDER.rglob("*.py")
}


@cache
def imports(module: str) -> set[str]:
    """Modules of the package that run when a module is imported or its functions are called, by its syntax tree."""

    def visit(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                continue
            if isinstance(child, ast.Import):
                found.update(alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                assert not child.level, "relative imports are not used"
                whole = {f"{child.module}.{alias.name}" for alias in child.names}
                found.update(whole & set(NAMES) or {child.module})
            visit(child)

    parts = module.split(".")
    found = {".".join(parts[:end]) for end in range(1, len(parts))}
    text = NAMES[module].read_text(encoding="utf-8")
    visit(ast.parse(text))
    for package in NAMES:
        if f'import_module(f"{package}.{{' in text:
            found |= {name for name in NAMES if f"{name}.".startswith(f"{package}.")}
    return found & set(NAMES)


@cache
def closure(*modules: str) -> set[str]:
    found, new = set(), set(modules)
    while new:
        found |= new
        new = set().union(*map(imports, new)) - found
    return found


def stage_modules(stage: str) -> set[str]:
    """Modules that the result of a stage can depend on: those of its functions, of its needs, and what calls them."""
    made = STAGES[stage]
    own = closure(type(made).__module__, *made.modules)
    return own.union(*(stage_modules(need) for need in made.needs))


def keys() -> dict[str, str]:
    """What each stored result is known by, for an experiment of two trials."""
    trials = pa.table({name: ["a", "b"] for name in ("trial_id", "source_sha256", "profile_sha256")})
    experiment = ExperimentStages(Path("nowhere"), "device", "1", trials)
    return {
        **{stage: experiment.key(stage) for stage in STAGES},
        "theory": code_digest(optimum.__name__),
        "report": report_code(),
        "ingest": code_digest(ingest.__name__),
    }


DEPENDS = {
    **{stage: stage_modules(stage) for stage in STAGES},
    "theory": closure(optimum.__name__),
    "report": closure(compare.__name__),
    "ingest": closure(ingest.__name__),
}


@pytest.fixture(scope="module")
def before():
    return keys()


@pytest.mark.parametrize("name", sorted(set().union(*DEPENDS.values())))
def test_an_edit_makes_stale_exactly_what_can_depend_on_it(name, before, edit):
    edit(import_module(name))
    now = keys()
    assert {what for what in now if now[what] != before[what]} == {what for what in DEPENDS if name in DEPENDS[what]}


@pytest.mark.parametrize("module", [app.__module__, "pipeline.shell.commands.cli_theory"])
def test_an_edit_of_what_nothing_depends_on_makes_nothing_stale(module, before, edit):
    edit(import_module(module))
    assert keys() == before


EDITS: list[tuple[ModuleType, set[str]]] = [
    (slowmodes, {"theory", "report"}),
    (labels, {"report"}),
    (models, {"report", "ingest"}),
    (refinement, {"theory", "report"}),
    (hdf5, {"ingest"}),
    (tail, {"energy", "report"}),
    (friction, {"damping", "mass", "settling", "energy", "report"}),
    (events, {"outcome", "report"}),
    (boundary_band, {"boundary", "report"}),
    (fit_jitter, {"model", "ladder", "damping", "mass", "settling", "energy", "report"}),
    (onset, {"delay", "damping", "mass", "settling", "energy", "windows", "report"}),
    (known_delay, {"damping", "mass", "settling", "energy", "windows", "report"}),
    (cost_intervals, {"overshoot", "settling", "energy", "rise", "report"}),
    (samples, {*STAGES, "report"}),
]


@pytest.mark.parametrize(("module", "stale"), EDITS, ids=[module.__name__ for module, _ in EDITS])
def test_known_edits(module, stale, before, edit):
    edit(module)
    now = keys()
    assert {what for what in now if now[what] != before[what]} == stale


@pytest.mark.parametrize("folder", sorted({name.split(".")[1] for name in NAMES if "." in name}))
def test_imports_are_those_of_the_syntax_tree(folder):
    names = [name for name in NAMES if name.split(".")[1:2] == [folder]]
    assert {name: provenance._imported(name) - {name} for name in names} == {n: imports(n) - {n} for n in names}


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_depends_on_no_page_no_theory_and_no_reader(stage):
    folders = {name.split(".")[1] for name in stage_modules(stage) if "." in name}
    # a device is fitted by the loop's own motion
    assert folders == {"base", "measured", "records", "store"} | ({"loop"} if "ladder" in required([stage]) else set())
    assert models.__name__ not in stage_modules(stage), f"what stages need of the records is in {findings.__name__}"


def test_a_process_loads_nothing_that_the_source_does_not_show():
    code = f"import sys, {compare.__name__}; print(*(name for name in sys.modules if name.startswith('pipeline')))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert len(loaded) > 100
    assert set(loaded) <= reachable(compare.__name__) | {name for name in loaded if name not in NAMES}


def test_what_is_no_module_of_the_package_is_named():
    for name in ("json", "pipeline.nowhere", "pipelines.base", ""):
        with pytest.raises(ModuleNotFoundError, match=repr(name)):
            code_digest(name)


def test_files_count_beside_the_code(tmp_path):
    page = tmp_path / "page.css"
    page.write_text("a")
    one = code_digest(optimum.__name__, files=(page,))
    assert one != code_digest(optimum.__name__)
    code_digest.cache_clear()
    page.write_text("b")
    assert code_digest(optimum.__name__, files=(page,)) != one


SOURCES = {
    "__init__": "",
    "a.__init__": "",
    "a.deep.__init__": "from pipeline.a.deep.inner import f\n",
    "a.deep.inner": "from pipeline import __version__\n",
    "a.deep.beside": "import os, pipeline.one as o\n",
    "bare.low": "",
    "bare.lower.low": "",
    "one": "",
    "two": "",
    "three": "",
    "types_only": "",
    "kinds.x": "from pipeline.two import y\n",
    "kinds.sub.y": "",
    "top": """\
from __future__ import annotations
from os import path
from typing import TYPE_CHECKING

from pipeline.a import (  # a, comment
    deep as d,
    name,
)

if TYPE_CHECKING:
    from pipeline.types_only import T

    from pipeline.types_only import U

from pipeline.bare.lower import low  # import three


def lazy(name):
    from pipeline.bare import low

    import_module(f"pipeline.kinds.{name}")
    return "from pipeline import three"
""",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    for name, source in SOURCES.items():
        file = tmp_path / "pipeline" / f"{name.replace('.', '/')}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(source)
    kept = [provenance._file, provenance._source, provenance._imported, provenance._inside, provenance.code_digest]
    for function in kept:
        function.cache_clear()
    monkeypatch.setattr(provenance, "_ROOT", str(tmp_path))
    yield
    for function in kept:
        function.cache_clear()


@pytest.mark.usefixtures("package")
def test_imports_are_found_in_every_form():
    def of(name):
        return {found.removeprefix("pipeline").removeprefix(".") for found in reachable(f"pipeline.{name}")}

    assert of("one") == {"", "one"}
    assert of("a.deep.inner") == {"", "a", "a.deep", "a.deep.inner"}
    assert of("a.deep.beside") == {"", "a", "a.deep", "a.deep.inner", "a.deep.beside", "one"}
    kinds = {"kinds.x", "two", "kinds.sub.y"}
    bare = {"bare.low", "bare.lower.low"}
    assert of("top") == {"", "top", "a", "a.deep", "a.deep.inner"} | kinds | bare


@pytest.mark.slow
def test_an_installed_copy_computes_again_what_an_edit_can_have_changed(lwr, tmp_path):
    """The copy reuses what the checkout stored; after an edit the stages run that depend on it, and no other."""
    site, processed = tmp_path / "site", tmp_path / "processed"
    shutil.copytree(PACKAGE_FOLDER, site / PACKAGE_FOLDER.name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(schema_folder(), site / PACKAGE_FOLDER.name / "_schemas", dirs_exist_ok=True)
    for stage in STAGES:
        lwr.stages("delay-2").table(stage)
    shutil.copytree(lwr.processed, processed)

    def pipeline(*options):
        command = [sys.executable, "-m", "pipeline", "compare", "--device", "lwr", "--experiment", "delay-2", "--json"]
        command += ["--processed", str(processed), "--report", str(tmp_path / "report.html"), *options]
        command += ["--criteria", "overshoot,energy_step_w0"]
        environment = os.environ | {"PYTHONPATH": str(site)}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    def planned():
        plan = {row["stage"]: row["action"] for row in pipeline("--dry-run")}
        assert {"delay-2: mass", "delay-2: energy"} <= set(plan)
        return {stage.removeprefix("delay-2: ") for stage, action in plan.items() if action == "run"}

    def stored():
        return {path: path.stat().st_mtime_ns for path in (processed / "stages").rglob("*.parquet")}

    def append(module):
        path = site / Path(module.__file__).relative_to(PACKAGE_FOLDER.parent)
        path.write_text(path.read_text(encoding="utf-8") + "# edited\n", encoding="utf-8")

    assert not planned() & set(STAGES)
    pipeline()
    assert planned() == set()
    append(friction)
    dependent = {"damping", "mass", "energy"}
    assert planned() & set(STAGES) == dependent
    before = stored()
    pipeline()
    assert {path.stem for path, time in stored().items() if time != before[path]} == dependent
    assert planned() == set()
    append(slowmodes)
    plan = planned()
    assert "report" in plan
    assert not plan & set(STAGES)

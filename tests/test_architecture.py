"""Imports inside the package point one way; function-level imports count like any other."""

import ast
from collections import Counter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pipeline"
LONGEST_MODULE = 400

MAY_IMPORT: dict[str, set[str]] = {
    "base": {"base"},
    "records": {"base", "records"},
    "profiles": {"base", "records", "profiles"},
    "readers": {"base", "records", "profiles", "readers"},
    "store": {"base", "records", "profiles", "readers", "store"},
    "measured": {"base", "records", "store", "measured"},
    "theory": {"base", "records", "theory"},
    "simulation": {"base", "records", "store", "simulation"},
    "rendering": {"base", "records", "rendering"},
    "comparison": {"base", "records", "profiles", "store", "measured", "theory", "rendering", "comparison"},
    # they hold estimators against simulated truth, whose exact costs and limits are those of theory
    "studies": {"base", "records", "store", "measured", "theory", "simulation", "rendering", "studies"},
}
"""Folders that the modules of a folder may import from, as in docs/architecture.md."""

MAY_IMPORT["shell"] = {*MAY_IMPORT, "shell"}

EXCEPTIONS = {
    ("simulation.simulate", "theory.plant"): "the simulated device moves by the same exact flow",
    ("simulation.course", "measured.verdict"): "a lab stops raising K when the log looks unstable",
}


def imports_of(source: str, modules: set[str], package: str = "") -> set[str]:
    """Modules of the package that a source text imports; ``package`` is where relative imports start."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                assert node.level == 1, "relative imports beyond the own folder are not used"
                base = ".".join(part for part in ("pipeline", package, base) if part)
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
            names = [str(arg.value) for arg in node.args if isinstance(arg, ast.Constant)]
        else:
            continue
        for name in names:
            inner = "__init__" if name == "pipeline" else name.removeprefix("pipeline.")
            if name.split(".")[0] == "pipeline" and inner in modules:
                found.add(inner)
    return found


def module_files() -> dict[str, Path]:
    files = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(parts)
        files[name.removesuffix(".__init__") if len(parts) > 1 else name] = path
    return files


FILES = module_files()
IMPORTS = {
    name: imports_of(path.read_text(encoding="utf-8"), set(FILES), name.split(".")[0]) - {name}
    for name, path in FILES.items()
}
TOP = {"__init__": "base", "__main__": "shell"}
"""Modules that stand in no folder, with the one whose rules hold for them."""

FOLDER_OF = {name: TOP.get(name, name.split(".")[0]) for name in FILES}


def modules_in(folder: str) -> set[str]:
    return {name for name, place in FOLDER_OF.items() if place == folder}


def reach(start: str) -> set[str]:
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        for name in IMPORTS.get(waiting.pop(), set()) - seen:
            seen.add(name)
            waiting.append(name)
    return seen


def test_every_folder_has_rules() -> None:
    assert set(FOLDER_OF.values()) == set(MAY_IMPORT), "name the folder in MAY_IMPORT and in docs/architecture.md"


def test_a_name_tells_which_module_is_meant() -> None:
    """But for the readers, which are named with their folder, and folders in folders: code is hashed by these names."""
    flat = [path for path in PACKAGE.glob("*/*.py") if path.parent.name != "readers" and path.stem != "__init__"]
    counts = Counter(path.stem for path in flat)
    assert [name for name, count in counts.items() if count > 1] == []


def test_architecture_page_names_every_module() -> None:
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    modules = {name for name in FILES if name not in MAY_IMPORT and name != "__init__"}
    apart = {name for name in modules if name.startswith(("readers.", "studies."))}
    shown = {name: name.replace(".", "/") if name in apart else name.rpartition(".")[2] for name in modules}
    assert sorted(name for name, text in shown.items() if f"`{text}`" not in page) == []


@pytest.mark.parametrize("name", sorted(FILES))
def test_imports_point_to_lower_folders(name: str) -> None:
    allowed = MAY_IMPORT[FOLDER_OF[name]]
    upward = {other for other in IMPORTS[name] if FOLDER_OF[other] not in allowed and (name, other) not in EXCEPTIONS}
    assert upward == set(), f"{name} may import from {sorted(allowed)} only"


def test_exceptions_are_used() -> None:
    assert [pair for pair in EXCEPTIONS if pair[1] not in IMPORTS[pair[0]]] == []


def test_no_module_reaches_itself() -> None:
    assert [name for name in FILES if name in reach(name)] == []


def test_measured_and_theory_never_meet() -> None:
    measured, theory = modules_in("measured"), modules_in("theory")
    assert len(measured) > 5
    assert len(theory) > 5
    assert {(m, t) for m in measured for t in reach(m) & theory} == set()
    assert {(t, m) for t in theory for m in reach(t) & measured} == set()


def test_measured_quantities_are_functions_of_arrays() -> None:
    store = modules_in("store") | modules_in("readers")
    quantities = modules_in("measured") - {"measured.stages", "measured.stage_tables"}
    readers = {name for name in quantities if reach(name) & (store | {"records.table_files"})}
    assert readers == set(), "only `stage_tables` reads and writes files"


def test_nothing_imports_the_command_line() -> None:
    shell = {name for name in modules_in("shell") if name == "__main__" or name.startswith("shell.cli")}
    assert {name for name in FILES if name not in shell and IMPORTS[name] & shell} == set()


def test_no_module_is_long() -> None:
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in FILES.items()}
    assert {name: count for name, count in lines.items() if count > LONGEST_MODULE} == {}


def test_imports_are_found_wherever_they_stand() -> None:
    modules = {"__init__", "readers", "readers.native", "theory", "theory.loop", "theory.plant", "measured.stages"}
    source = (
        "import os, pipeline.measured.stages\n"
        "from pipeline import __version__\n"
        "from pipeline.theory import loop\n"
        "def f():\n"
        "    from pipeline.theory.plant import flow\n"
        "    if True:\n"
        "        import pipeline.readers.native as n\n"
        "    importlib.import_module('pipeline.measured.stages')\n"
    )
    assert imports_of(source, modules) == modules - {"readers"}
    assert imports_of("from . import native", modules, "readers") == {"readers", "readers.native"}
    assert imports_of("from numpy import theory", modules) == set()

"""Imports inside the package point one way; function-level imports count like any other."""

import ast
from pathlib import Path

from folders import MAY_IMPORT
from places import ROOT

PACKAGE = ROOT / "pipeline"

EXCEPTIONS = {("simulation.sweep", "measured.signal.verdict"): "a lab stops raising K when the log looks unstable"}


def executed(tree: ast.Module) -> ast.Module:
    """The module without what type checkers alone read; ``pipeline`` offers by name what others import it for."""
    tree.body = [
        node for node in tree.body if not (isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING")
    ]
    return tree


def imports_of(source: str, modules: set[str], package: str = "", own: str = "") -> set[str]:
    """Modules of the package that a source text imports; ``package`` is where relative imports start."""
    found = set()
    tree = ast.parse(source)
    for node in ast.walk(executed(tree) if own == "__init__" else tree):
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
    name: imports_of(path.read_text(encoding="utf-8"), set(FILES), name.rpartition(".")[0], name) - {name}
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


def test_architecture_page_names_every_folder() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    inner = {path.parent.name for path in PACKAGE.rglob("*.py")} - {"pipeline"}
    assert sorted(name for name in inner if f"`{name}`" not in page) == []


def test_imports_point_to_lower_folders() -> None:
    pairs = {(name, other) for name, others in IMPORTS.items() for other in others}
    upward = {(name, other) for name, other in pairs if FOLDER_OF[other] not in MAY_IMPORT[FOLDER_OF[name]]}
    assert upward - set(EXCEPTIONS) == set()


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
    store = modules_in("store") | modules_in("readers") | modules_in("intake")
    quantities = modules_in("measured") - {"measured.stages.stages", "measured.stages.stage_tables"}
    readers = {name for name in quantities if reach(name) & (store | {"records.table_files"})}
    assert readers == set(), "only `stage_tables` reads and writes files"

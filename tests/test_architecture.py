"""Imports inside the package point one way; function-level imports count like any other."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pipeline"
LONGEST_MODULE = 400

LAYERS: dict[str, set[str]] = {
    "ground": {
        "__init__",
        "disk",
        "errors",
        "lock",
        "file_names",
        "regular_files",
        "provenance",
        "rerun",
        "units",
        "wording",
    },
    "records": {
        "models",
        "theory_panels",
        "tables",
        "batch",
        "native",
        "accuracy",
        "accuracy_advice",
        "accuracy_measured_advice",
        "score_records",
        "figure_records",
        "trial_records",
        "trial_codec",
        "results",
        "against_records",
    },
    "store": {
        "storage",
        "profile_text",
        "profile_columns",
        "profile_model",
        "profile_lines",
        "profile_layout",
        "profiles",
        "sources",
        "bags",
        "trialstore",
        "batch_files",
        "versions",
        "compaction",
        "reading",
        "quarantine",
        "excerpt",
        "devices",
        "published",
        "published_theory",
        "human_arm",
        "readers",
        "readers.native",
        "readers.frame",
        "readers.log",
        "readers.plain_text",
        "readers.delimited",
        "readers.time_axis",
        "readers.dates",
        "readers.json_text",
        "readers.rows",
        "readers.conditions",
        "readers.mapping",
        "readers.safety",
        "readers.file_kind",
        "readers.isolation",
        "readers.arrays",
        "readers.json_records",
        "readers.arrow_tables",
        "readers.matlab",
        "readers.matlab5",
        "readers.matlab73",
        "readers.hdf5",
        "readers.tdms",
        "readers.recording",
        "readers.ros_types",
        "readers.topics",
        "readers.rosbag",
        "readers.mcap",
    },
    "ingest": {"ingest", "ingest_report"},
    "measured": {
        "response",
        "modes",
        "momentum",
        "verdict",
        "events",
        "disturbance",
        "outcome",
        "delay",
        "onset",
        "mass",
        "correlated",
        "averaging",
        "friction",
        "damping",
        "fit_motion",
        "fit_filter",
        "fit_noise",
        "fit_window",
        "ghost",
        "fit_search",
        "fit_jitter",
        "fit",
        "arm_stiffness",
        "lag",
        "horizon",
        "costs",
        "reading_error",
        "cost_intervals",
        "tail",
        "energy_intervals",
        "step_metrics",
        "boundary",
        "boundary_band",
        "intervals",
        "trend",
        "combine",
        "aggregate",
        "estimates",
        "stage_columns",
        "stages",
    },
    "theory": {
        "plant",
        "loop",
        "stability",
        "branches",
        "region",
        "extent",
        "robust",
        "passivity",
        "energy",
        "lagsums",
        "transient",
        "slowmodes",
        "envelope",
        "march_buffer",
        "march",
        "pointcosts",
        "optimum",
        "poles",
        "search",
        "lines",
        "overshoot",
        "rules",
        "curves",
        "maps",
        "predictions",
        "theory",
        "theory_map",
        "theory_curves",
        "theory_jumps",
        "outline",
        "responses",
    },
    "accuracy": {
        "accuracy_methods",
        "accuracy_optional",
        "accuracy_searches",
        "accuracy_ladders",
        "accuracy_sweeps",
        "accuracy_run",
    },
    "simulation": {"simulate", "procedure", "course"},
    "accuracy_measured": {
        "accuracy_measured_truth",
        "accuracy_measured_jitter",
        "accuracy_measured_rungs",
        "accuracy_measured_trials",
        "accuracy_measured_costs",
        "accuracy_measured_courses",
        "accuracy_measured_run",
    },
    "rendering": {
        "style",
        "theory_drawings",
        "labels",
        "panels",
        "polyline",
        "svg_paths",
        "svg_compact",
        "canvas",
        "residual_panels",
        "response_drawing",
        "figures",
        "report_figures",
        "report_tables",
        "report_estimates",
        "report_scores",
        "report_index",
        "report_scripts",
        "report",
        "accuracy_figures",
        "accuracy_measured_report",
        "accuracy_report",
        "report_parts",
        "table_values",
        "table_export",
        "report_against",
    },
    "meeting": {
        "scene",
        "tables_d",
        "theory_tables",
        "theory_figures",
        "theory_figures_3",
        "theory_figures_4",
        "theory_figures_5_maps",
        "theory_figures_5_relations",
        "theory_figures_5_responses",
        "boundary_curves",
        "figure_boundaries",
        "figure_optima",
        "figure_residuals",
        "figure_response",
        "figure_data",
        "trial_data",
        "implied_slope",
        "implied_delay",
        "compare_experiment",
        "overlap",
        "agreement",
        "theory_band",
        "upper_bound",
        "score_costs",
        "scores",
        "advice",
        "causes",
        "summary",
        "summary_warnings",
        "compare",
        "status",
        "origin",
        "scene_parts",
        "scene_file",
        "against",
        "against_run",
        "stage_pool",
    },
    "shell": {
        "__main__",
        "console",
        "demo",
        "theory_tables_text",
        "profile_check",
        "profile_draft",
        "cli",
        "cli_profiles",
        "cli_storage",
        "cli_theory",
        "cli_watch",
        "watch",
        "watch_files",
        "watch_pass",
        "verify",
        "verify_logs",
        "cli_report",
    },
}
"""Every module by its layer, as in docs/architecture.md."""

MAY_IMPORT: dict[str, set[str]] = {
    "ground": {"ground"},
    "records": {"ground", "records"},
    "store": {"ground", "records", "store"},
    "ingest": {"ground", "records", "store", "ingest"},
    "measured": {"ground", "records", "store", "measured"},
    "theory": {"ground", "records", "theory"},
    "accuracy": {"ground", "records", "theory", "accuracy"},
    "simulation": {"ground", "records", "store", "simulation"},
    # it holds estimators against simulated truth, whose exact costs and limits are those of theory
    "accuracy_measured": {"ground", "records", "store", "measured", "theory", "simulation", "accuracy_measured"},
    "rendering": {"ground", "records", "rendering"},
    "meeting": {"ground", "records", "store", "measured", "theory", "rendering", "meeting"},
    "shell": set(LAYERS),
}

EXCEPTIONS = {
    ("simulate", "plant"): "the simulated device moves by the same exact flow",
    ("course", "verdict"): "a lab stops raising K when the log looks unstable",
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
    name: imports_of(path.read_text(encoding="utf-8"), set(FILES), "readers" if "readers" in name else "") - {name}
    for name, path in FILES.items()
}
LAYER_OF = {module: layer for layer, modules in LAYERS.items() for module in modules}


def reach(start: str) -> set[str]:
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        for name in IMPORTS.get(waiting.pop(), set()) - seen:
            seen.add(name)
            waiting.append(name)
    return seen


def test_every_module_has_a_layer() -> None:
    assert sorted(set(FILES) - set(LAYER_OF)) == [], "name their layer in LAYERS and in docs/architecture.md"


def test_architecture_page_names_every_module() -> None:
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    absent = [name for name in FILES if name != "__init__" and f"`{name.replace('.', '/')}`" not in page]
    assert absent == []


@pytest.mark.parametrize("name", sorted(FILES))
def test_imports_point_to_lower_layers(name: str) -> None:
    layer = LAYER_OF[name]
    upward = {
        other for other in IMPORTS[name] if LAYER_OF[other] not in MAY_IMPORT[layer] and (name, other) not in EXCEPTIONS
    }
    assert upward == set(), f"{name} ({layer}) may import {sorted(MAY_IMPORT[layer])} only"


def test_exceptions_are_used() -> None:
    assert [pair for pair in EXCEPTIONS if pair[1] not in IMPORTS[pair[0]]] == []


def test_no_module_reaches_itself() -> None:
    assert [name for name in FILES if name in reach(name)] == []


def test_measured_and_theory_never_meet() -> None:
    measured, theory = LAYERS["measured"] & set(FILES), LAYERS["theory"] & set(FILES)
    assert len(measured) > 5
    assert len(theory) > 5
    assert {(m, t) for m in measured for t in reach(m) & theory} == set()
    assert {(t, m) for t in theory for m in reach(t) & measured} == set()


def test_measured_quantities_are_functions_of_arrays() -> None:
    quantities = (LAYERS["measured"] & set(FILES)) - {"stages", "stage_columns"}
    readers = {name for name in quantities if reach(name) & (LAYERS["store"] | {"tables"})}
    assert readers == set(), "only `stages` reads and writes files, and `stage_columns` knows their columns"
    assert not reach("stage_columns") & LAYERS["store"]


def test_nothing_imports_the_command_line() -> None:
    shell = {"__main__", "cli", "cli_profiles", "cli_report", "cli_storage", "cli_theory", "cli_watch"}
    assert {name for name in FILES if name not in shell and IMPORTS[name] & shell} == set()


def test_no_module_is_long() -> None:
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in FILES.items()}
    assert {name: count for name, count in lines.items() if count > LONGEST_MODULE} == {}


def test_imports_are_found_wherever_they_stand() -> None:
    modules = {"__init__", "costs", "loop", "plant", "readers", "readers.native", "stages"}
    source = (
        "import os, pipeline.costs\n"
        "from pipeline import __version__, loop\n"
        "def f():\n"
        "    from pipeline.plant import flow\n"
        "    if True:\n"
        "        import pipeline.readers.native as n\n"
        "    importlib.import_module('pipeline.stages')\n"
    )
    assert imports_of(source, modules) == {"__init__", "costs", "loop", "plant", "readers.native", "stages"}
    assert imports_of("from . import native", modules, "readers") == {"readers", "readers.native"}
    assert imports_of("from numpy import costs", modules) == set()

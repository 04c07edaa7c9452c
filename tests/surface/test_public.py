"""The public Python surface: names, signatures, laziness, errors."""

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT

import pipeline
from pipeline.base.errors import DeviceError, LogError, StoreError, UsageError

SIGNATURES = {
    "ingest": ["paths", "processed", "profile"],
    "read_log": ["path", "profile", "label"],
    "look": ["path", "profile"],
    "plan": ["device", "processed", "experiment", "goal", "count", "dampings", "gentle", "limits"],
    "simulate": ["device", "experiment", "seed", "ideal", "coarsen", "duration_s", "out", "overwrite"],
    "devices": ["processed"],
    "experiments": ["processed", "device"],
    "trials": ["processed", "device", "experiment"],
    "samples": ["processed", "trial_id"],
    "estimates": ["processed", "device", "experiment", "all_methods"],
    "boundary": ["processed", "device", "experiment"],
    "optima": ["processed", "device", "experiment"],
    "costs": ["processed", "device", "experiment"],
    "Comparison": ["result", "compute"],
    "compare": ["device", "processed", "experiments", "criteria", "full"],
    "load": ["report"],
    "human_arms": [],
    "identify": ["paths", "profile", "period", "delay", "report"],
    "Identified": ["document", "evidence"],
    "published_limits": ["loop", "damping", "coulomb", "quantum"],
    "design": ["loop", "stiffness", "settling_s", "overshoot", "margin", "tolerance", "keep"],
    "Design": [
        *("wish", "reached", "wall", "stiffness_reached", "changes", "out_of_reach", "sensitivities", "left_out"),
        "motion",
    ],
    "Loop": [
        *("mass", "damping", "sampling_period_s", "delay_samples", "stiffness", "motion"),
        *("velocity", "actuator_lag_s", "force_gain", "mode", "operator", "friction"),
        *("sensor", "jitter_samples", "constant_force", "force_limit"),
    ],
}

HEAVY = ("numpy", "pandas", "scipy", "pyarrow", "pydantic", "matplotlib", "jinja2", "rich", "typer", "filelock")


def run(script: str) -> str:
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return process.stdout.strip()


def test_names_and_signatures_are_those_of_the_page():
    assert set(pipeline.__all__) == {*SIGNATURES, "PipelineError"}
    assert {name: list(inspect.signature(getattr(pipeline, name)).parameters) for name in SIGNATURES} == SIGNATURES
    assert set(dir(pipeline)) == set(pipeline.__all__), "completion offers public names only"


def test_every_public_name_has_a_type():
    """Type checkers read the imports under TYPE_CHECKING, programs the table of names: both say the same."""
    text = (ROOT / "pipeline" / "__init__.py").read_text(encoding="utf-8")
    typed = {name: place for place, name in re.findall(r"from pipeline\.([\w.]+) import \w+ as ([A-Za-z]\w*)", text)}
    assert typed == {name: place for place, names in pipeline._PUBLIC.items() for name in names}
    assert set(typed) == set(pipeline.__all__)
    assert (ROOT / "pipeline" / "py.typed").exists()


def test_every_public_function_says_what_it_gives():
    for name in SIGNATURES:
        thing = getattr(pipeline, name)
        parts = [thing] if inspect.isfunction(thing) else [thing, *(v for k, v in vars(thing).items() if k[0] != "_")]
        assert all(inspect.getdoc(part) for part in parts if callable(part)), name
        for part in parts:
            if inspect.isfunction(part):
                assert "return" in part.__annotations__, (name, part)


def test_import_loads_nothing_heavy():
    script = f"import sys, pipeline; dir(pipeline); print([m for m in {HEAVY} if m in sys.modules])"
    assert run(script) == "[]"
    assert run(script.replace("dir(pipeline)", "pipeline.PipelineError")) == "[]"


def test_a_loop_loads_no_measured_branch():
    loaded = run("import sys, pipeline; pipeline.Loop; print([m for m in sys.modules if 'measured' in m])")
    assert loaded == "[]"


def test_no_public_name_is_that_of_a_package():
    """A package's import binds its name in ``pipeline``, and would replace the function."""
    inner = {module.name for module in pkgutil.iter_modules(pipeline.__path__)}
    assert inner & set(pipeline.__all__) == set()


@pytest.mark.slow
def test_functions_stay_after_imports_in_any_order():
    modules = ["pipeline.intake.ingest", "pipeline.device_data.devices", "pipeline.comparison.compare"]
    modules += ["pipeline.simulation.simulate", "pipeline.store.samples", "pipeline.loop.normalised_loop"]
    for order in (modules, modules[::-1]):
        names = run(
            "import importlib, pipeline\npipeline.ingest, pipeline.samples\n"
            f"for name in {order}: importlib.import_module(name)\n"
            "print(*[type(getattr(pipeline, n)).__name__ for n in pipeline.__all__])"
        )
        assert set(names.split()) == {"function", "type"}


def test_other_names_are_no_attributes():
    with pytest.raises(AttributeError, match="no attribute 'frobnicate'"):
        importlib.import_module("pipeline").frobnicate  # noqa: B018


def test_what_is_not_there_is_named(tmp_path, falcon):
    for ask in (pipeline.devices, pipeline.trials, lambda folder: pipeline.boundary(folder, "falcon")):
        with pytest.raises(StoreError, match=r"nowhere: does not exist\. Ingest logs first"):
            ask(tmp_path / "nowhere")
    assert pipeline.devices(tmp_path).empty
    assert list(pipeline.experiments(tmp_path).columns) == list(pipeline.experiments(falcon.processed).columns)
    stored = falcon.processed
    with pytest.raises(DeviceError, match=r"no trials of device 'lwr'. Devices with trials: falcon"):
        pipeline.trials(stored, "lwr")
    with pytest.raises(DeviceError, match=r"experiment '9'. Experiments with trials: 1"):
        pipeline.trials(stored, "falcon", "9")
    with pytest.raises(UsageError, match="without its device"):
        pipeline.trials(stored, experiment="1")
    with pytest.raises(DeviceError, match="no logs of experiment '9'; found 1"):
        pipeline.estimates(stored, "falcon", "9")
    with pytest.raises(UsageError, match="no trial 'abc'"):
        pipeline.samples(stored, "abc")
    with pytest.raises(UsageError, match=r"criteria = 'overshoot': expected a list"):
        pipeline.compare("falcon", stored, criteria="overshoot")
    with pytest.raises(UsageError, match="unknown criterion 'x'"):
        pipeline.compare("falcon", stored, criteria=["x"])


def test_a_log_that_is_refused_is_named_with_its_row(tmp_path):
    log = tmp_path / "a.csv"
    log.write_text(
        "# device: x\n# experiment: 1\n# stiffness: 1\n# damping: 1\n# step: 1\n# sampling_period_s: 0.001\n"
    )
    with pytest.raises(LogError, match=r"a\.csv") as refused:
        pipeline.read_log(log)
    with pytest.raises(UsageError, match="does not exist"):
        pipeline.read_log(tmp_path / "b.csv")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="expected one log, found 0"):
        pipeline.read_log(tmp_path / "empty")
    report = pipeline.ingest(log, tmp_path / "processed")
    assert [refusal.reason for refusal in report.quarantined] == [refused.value.__cause__.reason]


def test_a_picture_shows_the_log_as_the_command_does(tmp_path):
    (log,) = pipeline.simulate("falcon", "1", coarsen=40, duration_s=0.1, out=tmp_path / "raw")[:1]
    path = next((tmp_path / "raw").rglob(f"{log.attrs['trial']}.csv"))
    picture = pipeline.look(path)
    assert "Read by profile native, in SI." in str(picture)
    (trial,) = picture.document["trials"]
    assert trial["rows"] == len(log)
    assert trial["step_row"] == int((log["command"] > 0.5 * log.attrs["step"]).to_numpy().argmax())
    page = picture.write(tmp_path / "new" / "look.html").read_text(encoding="utf-8")
    assert page.count("<svg") == len(trial["columns"]) == 2


def test_a_plan_is_that_of_the_command(tmp_path, falcon):
    plan = pipeline.plan("falcon", tmp_path / "none", "1", goal="boundary", limits={"stiffness": 3000.0})
    assert 0 < plan.next[0].stiffness <= 3000
    assert str(plan).startswith(f"K = {plan.next[0].stiffness:g}, B = {plan.next[0].damping:g}: expected")
    printed = run(f"import pipeline; print(pipeline.plan('falcon', {str(falcon.processed)!r}, '1', count=2))")
    command = [sys.executable, "-m", "pipeline", "plan", "--device", "falcon", "--next", "2"]
    told = subprocess.run([*command, "--processed", falcon.processed], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == printed


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"goal": "nicest"}, "goal nicest: expected boundary, optimum or a criterion"),
        ({"count": 0}, "0 walls: expected at least 1"),
        ({"limits": {"speed": 1.0}}, "limit of speed: expected one of stiffness, damping, force, travel"),
        ({"limits": {"force": float("nan")}}, "limit of force: expected a number above 0, found nan"),
        ({"dampings": [-1.0]}, "dampings -1: expected numbers of 0 or more"),
    ],
)
def test_a_wrong_wish_of_a_plan_is_named(tmp_path, wrong, reason):
    with pytest.raises(UsageError, match=reason):
        pipeline.plan("falcon", tmp_path, "1", **wrong)


def test_a_design_is_printed_in_words():
    answer = pipeline.design(pipeline.Loop(0.58, 4.0, 0.001, 4), 20000.0)
    assert "Wanted: K = 20000 N/m.\nReached: no." in str(answer)
    first = answer.changes[0].after["sampling_period_s"]
    assert f"sampling_period_s 0.001 -> {first:.4g} s and delay_samples 4 -> " in str(answer)


def test_documents_of_others_are_refused(tmp_path):
    with pytest.raises(UsageError, match=r"missing\.json: cannot be read"):
        pipeline.load(tmp_path / "missing.html")
    for text in ("{}", "no JSON", '{"pairs": []}'):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(UsageError, match=r"a\.json: is not a comparison document"):
            pipeline.load(tmp_path / "a.json")


def test_a_page_is_not_written_over_its_document(tmp_path, falcon, one_process):
    comparison = pipeline.compare("falcon", falcon.processed, criteria=["overshoot"])
    with pytest.raises(UsageError, match=r"Give .*a\.html"):
        comparison.write(tmp_path / "a.json")
    with pytest.raises(UsageError, match="is a folder"):
        comparison.write(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_numbers_are_those_of_the_document(falcon, falcon_outcome):
    result = falcon_outcome.result
    (experiment,) = result.experiments
    frame = pipeline.estimates(falcon.processed, "falcon", "1", all_methods=True)
    best = frame[frame["recommended"]].set_index("quantity")
    for name, estimate in experiment.estimates.items():
        assert best.loc[name, "unit"] == estimate.unit
        assert best.loc[name, "value"] == estimate.value or (np.isnan(best.loc[name, "value"]) and estimate.reason)
        others = frame[(frame["quantity"] == name) & ~frame["recommended"]]
        assert others["method"].tolist() == list(estimate.by_method)
    boundary = pipeline.boundary(falcon.processed, "falcon", "1")
    assert boundary["unstable"].dropna().tolist() == [p.unstable for p in experiment.boundary if p.unstable is not None]
    optima = pipeline.optima(falcon.processed, "falcon").set_index("criterion")
    assert optima["cost"].to_dict() == {name: found.cost for name, found in experiment.optimum.items()}
    comparison = pipeline.Comparison(result)
    assert comparison.tables["cost"].notna().sum() == sum(row.cost is not None for row in result.tables)
    assert comparison.boundary.drop(columns="truth").equals(boundary.drop(columns="truth"))
    scores = comparison.scores
    counted = scores[(scores["score"] == "verdicts") & (scores["basis"] == "device file")].set_index("quantity")[
        "value"
    ]
    assert counted["both_stable"] == experiment.scores[0].verdicts.both_stable
    assert boundary.attrs["units"] == {
        **dict.fromkeys(("stable", "unstable", "stiffness", "low", "high", "stiffness_large_motion", "truth"), "N/m"),
        "damping": "Ns/m",
    }


def test_names_from_logs_are_escaped_in_notebooks(falcon_outcome):
    title = "<script>alert(1)</script>"
    result = falcon_outcome.result.model_copy(update={"title": title, "warnings": (title,)})
    assert "<script>" not in pipeline.Comparison(result)._repr_html_()

"""The JSON Schemas in `schemas/` are those of the records; what we ship and write obeys them."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from places import ROOT, docs_script

from pipeline.records.findings import BoundaryPoint, Estimate, Record
from pipeline.records.models import SCHEMA_MODELS, ComparisonRow, Device, Experiment, Scene, SceneFile

FOLDER = ROOT / "schemas"
DEVICE_FILES = sorted((FOLDER / "devices").glob("*.toml"))

EXAMPLES: dict[str, Record] = {
    "experiment": Experiment(
        name="1", mass=0.58, damping=4, delay_samples=4, jitter_samples=(3, 4, 5), damping_last=184, damping_step=4,
        stiffness_step=200,
    ),
    "estimate": Estimate(
        value=0.58, low=0.57, high=0.59, unit="kg", method="m", trials=3,
        by_method={"other": Estimate(value=None, unit="kg", method="n", reason="no trial at K = 0")},
    ),
    "boundary_point": BoundaryPoint(damping=4, stable=200, unstable=None, censored=True),
    "comparison_row": ComparisonRow(
        table="D.1", criterion="overshoot", condition="theory", delay_samples=None, stiffness=5056, damping=105, cost=0
    ),
    "scene": Scene(device="falcon", experiments=("1", "2")),
    "scene_file": SceneFile(device="falcon", criteria=("settle", "overshoot"), bands=(2,), delays=(3, 4.5)),
}  # fmt: skip


def made() -> dict[str, str]:
    result: dict[str, str] = docs_script("make_schemas").schemas()
    return result


def stored(name: str) -> dict[str, Any]:
    schema: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    return schema


def faults(value: Any, name: str) -> list[str]:
    """What a value breaks of a stored schema."""
    return [error.message for error in Draft202012Validator(stored(name)).iter_errors(value)]


def test_stored_schemas_equal_the_records() -> None:
    expected = made()
    assert set(expected) == {f"{name}.json" for name in SCHEMA_MODELS}
    found = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.json")}
    assert found == expected, "schemas/ is out of date: run `make docs`"


def test_every_record_with_a_schema_has_an_example_here() -> None:
    assert set(EXAMPLES) | {"device"} == set(SCHEMA_MODELS)


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_records_obey_their_schema(name: str) -> None:
    record = EXAMPLES[name]
    assert faults(record.model_dump(mode="json", by_alias=True), name) == []
    assert SCHEMA_MODELS[name].model_validate_json(record.model_dump_json(by_alias=True)) == record


@pytest.mark.parametrize("path", DEVICE_FILES, ids=lambda path: path.stem)
def test_shipped_device_files_obey_the_schema_as_written(path: Path) -> None:
    values = tomllib.loads(path.read_text(encoding="utf-8"))
    assert faults(values, "device") == []
    assert faults(Device.model_validate(values).model_dump(mode="json", by_alias=True), "device") == []


def test_wrong_values_are_found() -> None:
    values = tomllib.loads(DEVICE_FILES[0].read_text(encoding="utf-8"))
    values["sampling_period_s"] = 0
    values["experiment"][0]["mass"] = "0.58"
    values["experiment"][1]["grip"] = "weak"
    del values["experiment"][1]["delay_samples"]
    values["colour"] = "blue"
    assert len(faults(values, "device")) == 5

"""The JSON Schemas in `schemas/` are those of the records; what we ship and write obeys them."""

import importlib.util
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

from pipeline.records.findings import BoundaryPoint, Estimate, Record
from pipeline.records.models import SCHEMA_MODELS, ComparisonRow, Device, Experiment, Scene, SceneFile

FOLDER = ROOT / "schemas"
DEVICE_FILES = sorted((FOLDER / "devices").glob("*.toml"))

EXAMPLES: dict[str, Record] = {
    "experiment": Experiment(
        name="1",
        mass=0.58,
        damping=4,
        delay_samples=4,
        jitter_samples=(3, 4, 5),
        damping_last=184,
        damping_step=4,
        stiffness_step=200,
    ),
    "estimate": Estimate(
        value=0.58,
        low=0.57,
        high=0.59,
        unit="kg",
        method="m",
        trials=3,
        by_method={"other": Estimate(value=None, unit="kg", method="n", reason="no trial at K = 0")},
    ),
    "boundary_point": BoundaryPoint(damping=4, stable=200, unstable=None, censored=True),
    "comparison_row": ComparisonRow(
        table="D.1",
        criterion="overshoot",
        condition="theory",
        delay_samples=None,
        stiffness=5056,
        damping=104.7,
        cost=0,
    ),
    "scene": Scene(device="falcon", experiments=("1", "2")),
    "scene_file": SceneFile(device="falcon", criteria=("settle", "overshoot"), bands=(2,), delays=(3, 4.5)),
}


def made() -> dict[str, str]:
    spec = importlib.util.spec_from_file_location("make_schemas", ROOT / "docs" / "make_schemas.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    result: dict[str, str] = module.schemas()
    return result


def stored(name: str) -> dict[str, Any]:
    schema: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    return schema


def problems(value: Any, schema: dict[str, Any], root: dict[str, Any], where: str = "$") -> list[str]:
    """Faults of a value by the part of JSON Schema that our records need; other keywords fail."""
    known = {
        "$defs",
        "$ref",
        "additionalProperties",
        "anyOf",
        "const",
        "default",
        "discriminator",
        "description",
        "enum",
        "items",
        "exclusiveMinimum",
        "maxLength",
        "maxItems",
        "maximum",
        "minItems",
        "minLength",
        "minimum",
        "oneOf",
        "properties",
        "required",
        "title",
        "type",
    }
    assert set(schema) <= known, f"{where}: keywords {set(schema) - known} are not checked here"
    found: list[str] = []
    if "$ref" in schema:
        found += problems(value, root["$defs"][schema["$ref"].removeprefix("#/$defs/")], root, where)
    if "anyOf" in schema and all(problems(value, part, root, where) for part in schema["anyOf"]):
        found.append(f"{where}: {value!r} fits no alternative")
    if "oneOf" in schema and sum(not problems(value, part, root, where) for part in schema["oneOf"]) != 1:
        found.append(f"{where}: {value!r} must fit one alternative")
    if "enum" in schema and value not in schema["enum"]:
        found.append(f"{where}: {value!r} is not one of {schema['enum']}")
    kinds: dict[str, Any] = {
        "object": dict,
        "array": list,
        "string": str,
        "boolean": bool,
        "null": type(None),
        "number": (int, float),
        "integer": int,
    }
    kind = schema.get("type")
    if kind and (not isinstance(value, kinds[kind]) or (isinstance(value, bool) and kind in ("number", "integer"))):
        return [*found, f"{where}: {value!r} is no {kind}"]
    if kind == "object":
        properties, others = schema.get("properties", {}), schema.get("additionalProperties", True)
        found += [f"{where}: {name} is missing" for name in schema.get("required", ()) if name not in value]
        for name, entry in value.items():
            if name in properties:
                found += problems(entry, properties[name], root, f"{where}.{name}")
            elif others is False:
                found.append(f"{where}: {name} is not known")
            elif isinstance(others, dict):
                found += problems(entry, others, root, f"{where}.{name}")
    if kind == "array":
        if len(value) < schema.get("minItems", 0):
            found.append(f"{where}: too few entries")
        for index, entry in enumerate(value):
            found += problems(entry, schema.get("items", {}), root, f"{where}[{index}]")
    if kind == "string" and not schema.get("minLength", 0) <= len(value) <= schema.get("maxLength", len(value)):
        found.append(f"{where}: {value!r} has a wrong length")
    if kind in ("number", "integer"):
        if value < schema.get("minimum", value) or value > schema.get("maximum", value):
            found.append(f"{where}: {value} is out of range")
        if "exclusiveMinimum" in schema and value <= schema["exclusiveMinimum"]:
            found.append(f"{where}: {value} is not above {schema['exclusiveMinimum']}")
    return found


def test_stored_schemas_equal_the_records() -> None:
    expected = made()
    assert set(expected) == {f"{name}.json" for name in SCHEMA_MODELS}
    found = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.json")}
    assert found == expected, "schemas/ is out of date: run `make docs`"


def test_every_record_with_a_schema_has_an_example_here() -> None:
    assert set(EXAMPLES) | {"device"} == set(SCHEMA_MODELS)


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_records_obey_their_schema(name: str) -> None:
    schema = stored(name)
    record = EXAMPLES[name]
    assert problems(record.model_dump(mode="json", by_alias=True), schema, schema) == []
    assert SCHEMA_MODELS[name].model_validate_json(record.model_dump_json(by_alias=True)) == record


@pytest.mark.parametrize("path", DEVICE_FILES, ids=lambda path: path.stem)
def test_shipped_device_files_obey_the_schema_as_written(path: Path) -> None:
    schema = stored("device")
    values = tomllib.loads(path.read_text(encoding="utf-8"))
    assert problems(values, schema, schema) == []
    device = Device.model_validate(values)
    assert problems(device.model_dump(mode="json", by_alias=True), schema, schema) == []


def test_wrong_values_are_found() -> None:
    schema = stored("device")
    values = tomllib.loads(DEVICE_FILES[0].read_text(encoding="utf-8"))
    values["sampling_period_s"] = 0
    values["experiment"][0]["mass"] = "0.58"
    values["experiment"][1]["grip"] = "weak"
    del values["experiment"][1]["delay_samples"]
    values["colour"] = "blue"
    assert len(problems(values, schema, schema)) == 5

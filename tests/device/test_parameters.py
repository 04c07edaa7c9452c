"""The table of parameters against the parts of a loop, device files and formulas by hand."""

from __future__ import annotations

import json
import math
import re
from dataclasses import fields, replace
from typing import Any

import pytest
from places import ROOT, docs_script

from pipeline.base.errors import ParameterError
from pipeline.device.loop import PARTS, Loop
from pipeline.device.parameters import MOTIONS, PARAMETERS
from pipeline.device.parts import (
    AdaptiveWindow,
    Butterworth,
    Coefficients,
    Difference,
    Friction,
    Kalman,
    Levant,
    LoopTable,
    Mode,
    Operator,
    Part,
    Sensor,
)

PART_MODELS: dict[str, tuple[type[Part], ...]] = {
    "velocity": (Difference, Butterworth, Coefficients, Kalman, AdaptiveWindow, Levant),
    "mode": (Mode,),
    "operator": (Operator,),
    "friction": (Friction,),
    "sensor": (Sensor,),
}

IDEAL = Loop(0.5, 3.0, 0.001, 2.0)
KALMAN = {"kind": "kalman", "acceleration": 50.0, "noise": 1e-5}
RICH = Loop(
    *(0.5, 3.0, 0.001, 2.4, 200.0),
    motion="rotation",
    velocity=KALMAN,
    actuator_lag_s=0.002,
    force_gain=0.4,
    mode={"frequency_hz": 60.0, "damping_ratio": 0.02, "mass": 0.15, "sensor": "load", "load_damping": 1.0},
    operator={"mass": 0.2, "damping": 9.0, "stiffness": 50.0},
    friction={"coulomb": 0.3, "stiction": 0.5, "stribeck_velocity": 0.02},
    sensor={"quantum": 1e-5, "noise": 2e-6},
    constant_force=-0.7,
    force_limit=12.0,
)
FILTERS: dict[str, dict[str, Any]] = {
    "velocity.cutoff_hz": {"kind": "butterworth", "order": 2, "cutoff_hz": 80.0},
    "velocity.order": {"kind": "butterworth", "order": 2, "cutoff_hz": 80.0},
    "velocity.samples": {"kind": "difference", "samples": 4},
    "velocity.acceleration": KALMAN,
    "velocity.noise": KALMAN,
    "velocity.bound": {"kind": "foaw", "bound": 1e-5},
    "velocity.longest": {"kind": "foaw", "bound": 1e-5},
}
"""A filter that has the number."""


def numbers_of(model: type[Part]) -> dict[str, dict[str, Any]]:
    """Return the JSON Schema of each field of a part that is a single number, by name."""
    properties: dict[str, dict[str, Any]] = model.model_json_schema()["properties"]
    either = {
        name: next((s for s in given.get("anyOf", ()) if "type" in s), given) for name, given in properties.items()
    }
    return {name: schema for name, schema in either.items() if schema.get("type") in ("number", "integer")}


def with_part(name: str) -> Loop:
    """Return a loop that has a number."""
    return replace(RICH, velocity=FILTERS[name]) if name in FILTERS else RICH


def test_every_number_of_a_part_has_one_row_with_its_bounds() -> None:
    assert set(PART_MODELS) == set(PARTS)
    rows = {
        f"{part}.{name}": schema
        for part, models in PART_MODELS.items()
        for model in models
        for name, schema in numbers_of(model).items()
    }
    assert set(rows) == {name for name, parameter in PARAMETERS.items() if parameter.part}
    for name, schema in rows.items():
        positive = schema.get("exclusiveMinimum") == 0 or (schema["type"] == "integer" and schema["minimum"] == 1)
        assert (positive or schema.get("minimum") == 0.0, positive) == (True, PARAMETERS[name].positive), name
        assert PARAMETERS[name].lower == 0.0, name


def test_every_number_of_the_loop_itself_has_a_row() -> None:
    numbers = {each.name for each in fields(Loop)} - {"motion", *PARTS}
    assert numbers == {name for name, parameter in PARAMETERS.items() if not parameter.part}


def test_names_symbols_and_meanings_are_unique() -> None:
    assert [parameter.name for parameter in PARAMETERS.values()] == list(PARAMETERS)
    for what in ("symbol", "meaning"):
        values = [getattr(parameter, what) for parameter in PARAMETERS.values()]
        assert len(set(values)) == len(values), what
        assert all(values), what


def test_labels_are_unique() -> None:
    labels = [parameter.label for parameter in PARAMETERS.values()]
    assert {label for label in labels if labels.count(label) > 1} == set()


def test_keys_of_device_files_are_the_names() -> None:
    schema = json.loads((ROOT / "schemas" / "device.json").read_text(encoding="utf-8"))
    tables = {name: set(each["properties"]) for name, each in schema["$defs"].items()} | {
        "Device": set(schema["properties"])
    }
    elsewhere = {"constant_force": ("SimulationParts", "constant_force"), "force_limit": ("Limits", "force")}
    for name, parameter in PARAMETERS.items():
        if parameter.part:
            models = [model.__name__ for model in PART_MODELS[parameter.part]]
            assert any(parameter.key in tables[model] for model in models), name
        elif name in elsewhere:
            table, key = elsewhere[name]
            assert key in tables[table], name
        else:
            assert any(name in tables[table] for table in ("Device", "Experiment", "LoopTable")), name
    assert set(LoopTable.model_fields) - set(PARTS) < set(PARAMETERS)


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("motion", MOTIONS)
def test_units_are_those_of_the_motion(name: str, motion: Any) -> None:
    unit = PARAMETERS[name].unit(motion)
    assert not unit.startswith(("N/m", "Ns/m", "m/s")) if motion.startswith("rotation") else "rad" not in unit
    kind, _, drive = motion.partition(" in ")
    of_force = PARAMETERS[name].unit(kind).startswith(("N", "kg"))
    assert not drive or (unit.startswith(drive) if of_force else unit == PARAMETERS[name].unit(kind))


@pytest.mark.parametrize("name", [name for name in PARAMETERS if name != "jitter_samples"])
def test_a_number_is_replaced_by_its_name(name: str) -> None:
    loop = with_part(name)
    before = loop.value(name)
    assert before is not None
    after = before + 1 if isinstance(_raw(loop, name), int) else before * 1.01
    changed = loop.replace({name: after})
    assert changed.value(name) == after
    assert {other for other in PARAMETERS if changed.value(other) != loop.value(other)} == {name}
    assert type(changed) is Loop


def _raw(loop: Loop, name: str) -> Any:
    parameter = PARAMETERS[name]
    return getattr(getattr(loop, parameter.part) if parameter.part else loop, parameter.key)


@pytest.mark.parametrize("name", [name for name, parameter in PARAMETERS.items() if parameter.part])
def test_a_part_that_is_missing_has_no_value(name: str) -> None:
    expected = 0.0 if PARAMETERS[name].part == "sensor" else None
    assert IDEAL.value(name) == expected


def test_a_part_that_is_missing_is_added() -> None:
    loop = IDEAL.replace({"operator.mass": 0.2, "friction.coulomb": 0.1, "sensor.noise": 1e-6, "mass": 0.7})
    assert (loop.operator, loop.friction) == (Operator(mass=0.2), Friction(coulomb=0.1))
    assert (loop.sensor.noise, loop.mass, loop.damping) == (1e-6, 0.7, 3.0)


def test_jitter_is_the_standard_deviation_of_the_delays() -> None:
    loop = Loop(0.5, 3.0, 0.001, 4.0, jitter_samples=(3, 4, 5))
    assert loop.value("jitter_samples") == pytest.approx(math.sqrt(2 / 3))
    assert IDEAL.value("jitter_samples") == 0.0
    with pytest.raises(ParameterError, match=r"jitter_samples.*dataclasses\.replace"):
        loop.replace({"jitter_samples": 1.0})


@pytest.mark.parametrize("call", [lambda: IDEAL.value("lag"), lambda: IDEAL.replace({"mode.far_mass": 1.0})])
def test_an_unknown_name_is_refused_with_the_known_ones(call: Any) -> None:
    with pytest.raises(
        ParameterError, match=r"is not a parameter of a loop; expected one of mass, damping.*sensor\.noise"
    ):
        call()


def test_the_apparent_device_includes_the_operator_per_unit_of_command() -> None:
    g, motor = 0.4, 0.5 - 0.15
    slower = math.sqrt((0.15 * motor / 0.5) / (0.15 * (motor + 0.2) / 0.7))
    expected = {
        "mass": 0.7 / g,
        "damping": 12.0 / g,
        "stiffness": 250.0 / g,
        "force_gain": 1.0,
        "mode.frequency_hz": 60.0 * slower,
        "mode.damping_ratio": 0.02 * slower,
        "mode.mass": 0.15 / g,
        "mode.load_damping": 1.0 / g,
        "friction.coulomb": 0.3 / g,
        "friction.stiction": 0.5 / g,
        "constant_force": -0.7 / g,
        "operator.mass": None,
        "operator.damping": None,
        "operator.stiffness": None,
    }
    for name in set(PARAMETERS) - {"force_limit"}:
        want = expected.get(name, RICH.value(name))
        assert RICH.apparent().value(name) == (None if want is None else pytest.approx(want, rel=1e-14)), name
    assert RICH.apparent().mode.sensor == "load"  # type: ignore[union-attr]
    assert IDEAL.apparent() == IDEAL


def test_the_limit_of_a_command_is_no_force_of_the_device() -> None:
    assert RICH.apparent().force_limit == 12.0


def test_the_normalised_device_has_the_factors_of_table_3_1() -> None:
    T, apparent = 0.001, RICH.apparent()
    m = apparent.mass
    normalised = RICH.normalised()
    factors = {
        **dict.fromkeys(("mass", "mode.mass"), m),
        **dict.fromkeys(("damping", "mode.load_damping"), m / T),
        **dict.fromkeys(("stiffness", "friction.coulomb", "friction.stiction"), m / T**2),
        **dict.fromkeys(("constant_force", "force_limit"), m / T**2),
        **dict.fromkeys(("sampling_period_s", "actuator_lag_s"), T),
        **dict.fromkeys(("mode.frequency_hz", "friction.stribeck_velocity"), 1 / T),
        "velocity.acceleration": 1 / T**2,
    }
    for name in PARAMETERS:
        value = apparent.value(name)
        want = None if value is None else pytest.approx(value / factors.get(name, 1.0), rel=1e-14)
        assert normalised.value(name) == want, name
    assert (normalised.mass, normalised.sampling_period_s) == (1.0, 1.0)


@pytest.mark.parametrize("name", [name for name in PARAMETERS if name != "jitter_samples"])
@pytest.mark.parametrize("value", [-1.0, 0.0, math.nan, math.inf])
def test_a_number_outside_its_bounds_is_refused_by_name(name: str, value: float) -> None:
    parameter, loop = PARAMETERS[name], with_part(name)
    allowed = math.isfinite(value) and (
        value > parameter.lower or (value == parameter.lower and not parameter.positive)
    )
    if allowed:
        smaller = {"friction.stiction": "friction.coulomb", "damping": "mode.load_damping"}  # at most as large
        changed = {name: value} | ({smaller[name]: 0.0} if name in smaller else {})
        assert loop.replace(changed).value(name) == value
        return
    with pytest.raises(ParameterError, match=rf"{re.escape(name)} = {value!r}: .*(expected|should be|must be)"):
        loop.replace({name: value})


MODE = {"frequency_hz": 60.0, "damping_ratio": 0.02, "mass": 0.15}


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"mode": MODE | {"mass": 0.5}}, r"mode\.mass: found 0\.5; must be below the mass of both sides, 0\.5"),
        ({"mode": MODE | {"load_damping": 4}}, r"mode\.load_damping: found 4; must not exceed the total damping.*, 3"),
        (
            {"mode": MODE | {"mass": 1e-8, "damping_ratio": 0}},
            r"mode\.mass: found 1e-08, below 1e-06.*leave the mode out",
        ),
        (
            {"velocity": {"kind": "butterworth", "order": 1, "cutoff_hz": 500.0}},
            r"velocity\.cutoff_hz: found 500; must be below half the sampling rate, 500 Hz",
        ),
        (
            {"velocity": {"kind": "kalman", "acceleration": 1e-9, "noise": 1e9}},
            r"velocity: found a tracking index acceleration T\^2/noise of 1e-24; the filter's poles would",
        ),
        ({"friction": {"coulomb": 1.0, "stiction": 0.5}}, r"stiction \(0\.5\) must not be below coulomb \(1\.0\)"),
        (
            {"velocity": {"kind": "coefficients", "b": [1], "a": [1, -1]}},
            r"velocity.*expected a stable filter.*distance 1",
        ),
        ({"motion": "bend"}, r"motion = 'bend': expected translation or rotation"),
        ({"mode": {"far_mass": 0.1}}, r"mode\.far_mass = 0\.1: .*Use the keys of a device file"),
    ],
)
def test_numbers_that_contradict_each_other_are_refused(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        replace(IDEAL, **parts)


def test_a_delay_that_is_not_the_mean_of_its_jitter_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"delay_samples.*jitter_samples"):
        Loop(0.5, 3.0, 0.001, 1.0, jitter_samples=(6, 7, 8))


def test_the_page_of_symbols_is_made_from_the_table() -> None:
    page = (ROOT / "docs" / "nomenclature.md").read_text(encoding="utf-8")
    assert page == docs_script("make_nomenclature").page(), "docs/nomenclature.md is out of date: run `make docs`"
    assert all(f"| `{name}` |" in page for name in PARAMETERS)

"""Factors of units to SI, from their definitions."""

from __future__ import annotations

import re
from math import pi

import pytest

from pipeline.base.errors import ParameterError
from pipeline.base.units import UNITS, factor_to_si, quantity_in_si

PREFIXES = {"k": 1e3, "": 1.0, "c": 1e-2, "m": 1e-3, "u": 1e-6, "n": 1e-9}
LENGTHS = {f"{prefix}m": factor for prefix, factor in PREFIXES.items() if prefix != "k"}
ANGLES = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": pi / 180, "rev": 2 * pi}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
FORCES = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
TORQUES = {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3}
EXPECTED = {
    **LENGTHS,
    **ANGLES,
    **TIMES,
    **FORCES,
    **TORQUES,
    **{f"N{length}": LENGTHS[length] for length in ("mm", "cm")},
    **{f"{length}/s": LENGTHS[length] for length in ("m", "cm", "mm", "um")},
    "rad/s": 1.0,
    "deg/s": pi / 180,
    "rev/s": 2 * pi,
    "rpm": 2 * pi / TIMES["min"],
    **{f"N/{length}": 1 / LENGTHS[length] for length in ("m", "cm", "mm")},
    "kN/m": 1e3,
    "Nm/rad": 1.0,
    "mNm/rad": 1e-3,
    "Nm/deg": 180 / pi,
    "mNm/deg": 1e-3 * 180 / pi,
    "Ns/m": 1.0,
    "Ns/mm": 1e3,
    "Nms/rad": 1.0,
    "mNms/rad": 1e-3,
    "Nms/deg": 180 / pi,
    "mNms/deg": 1e-3 * 180 / pi,
}
DRIVES = {"V": 1.0, "mV": 1e-3, "A": 1.0, "mA": 1e-3, "count": 1.0, "counts": 1.0, "%": 1.0}
NEWTONS = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
TORQUES_ALL = {**TORQUES, "Nmm": 1e-3, "Ncm": 1e-2}
EXPECTED |= DRIVES
for _drive, _factor in DRIVES.items():
    EXPECTED |= {f"{force}/{_drive}": size / _factor for force, size in {**NEWTONS, **TORQUES_ALL}.items()}
    for _place, _size in {**LENGTHS, **ANGLES}.items():
        EXPECTED |= {f"{_drive}/{_place}": _factor / _size, f"{_drive}s/{_place}": _factor / _size}
        if len(_drive) > 1:
            EXPECTED[f"{_drive} s/{_place}"] = _factor / _size


def test_each_unit_has_the_factor_of_its_definition() -> None:
    assert {name: unit.factor for name, unit in UNITS.items()} == pytest.approx(EXPECTED, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("5 N/mm", 5000.0), ("5N/mm", 5000.0), ("0,5 kN/m", 500.0), ("5000", 5000.0), ("1e3 N/m", 1000.0)],
)
def test_a_quantity_is_read_with_or_without_its_unit(text: str, expected: float) -> None:
    assert quantity_in_si(text, ("stiffness",), "--stiffness") == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5 mm", "--stiffness '5 mm': unit 'mm' measures length; expected stiffness"),
        ("stiff", "--stiffness 'stiff': expected a number, with or without its unit, such as '5 N/m'"),
        ("1,000 N/m", "the comma may separate thousands. Write 1.000 or 1000"),
        ("5 apples", "unit 'apples' is not known"),
        ("", "expected a number"),
    ],
)
def test_a_quantity_that_is_none_is_refused_with_what_is_expected(text: str, message: str) -> None:
    with pytest.raises(ParameterError, match=re.escape(message)):
        quantity_in_si(text, ("stiffness",), "--stiffness")


def test_a_unit_of_another_quantity_is_refused() -> None:
    with pytest.raises(ParameterError, match="'mm' measures length; expected torque"):
        factor_to_si("mm", ("torque",))

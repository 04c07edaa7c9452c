"""Factors of units to SI, from their definitions."""

from __future__ import annotations

from math import pi

import pytest

from pipeline.base.errors import ParameterError
from pipeline.base.units import UNITS, factor_to_si

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
    "rpm": 2 * pi / TIMES["min"],
    **{f"N/{length}": 1 / LENGTHS[length] for length in ("m", "cm", "mm")},
    "kN/m": 1e3,
    "Nm/rad": 1.0,
    "mNm/rad": 1e-3,
    "Nm/deg": 180 / pi,
    "Ns/m": 1.0,
    "Ns/mm": 1e3,
    "Nms/rad": 1.0,
    "mNms/rad": 1e-3,
    "Nms/deg": 180 / pi,
}


def test_each_unit_has_the_factor_of_its_definition() -> None:
    assert {name: unit.factor for name, unit in UNITS.items()} == pytest.approx(EXPECTED, rel=1e-15)


def test_a_unit_of_another_quantity_is_refused() -> None:
    with pytest.raises(ParameterError, match="'mm' measures length; expected torque"):
        factor_to_si("mm", ("torque",))

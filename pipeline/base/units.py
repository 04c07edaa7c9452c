"""Units of foreign logs and their factors to SI; conversion happens here, at the border, and nowhere else."""

from __future__ import annotations

import re
from collections.abc import Collection
from math import pi
from typing import NamedTuple

from pipeline.base.errors import ParameterError


class Unit(NamedTuple):
    """Physical quantity of a unit and the factor that turns its numbers into SI."""

    quantity: str
    factor: float


_DEGREE = pi / 180

_FACTORS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9},
    "angle": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": _DEGREE, "rev": 2 * pi},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "um/s": 1e-6},
    "angular velocity": {"rad/s": 1.0, "deg/s": _DEGREE, "rpm": 2 * pi / 60},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
    "stiffness": {"N/m": 1.0, "kN/m": 1e3, "N/cm": 1e2, "N/mm": 1e3},
    "rotational stiffness": {"Nm/rad": 1.0, "mNm/rad": 1e-3, "Nm/deg": 1 / _DEGREE},
    "damping": {"Ns/m": 1.0, "Ns/mm": 1e3},
    "rotational damping": {"Nms/rad": 1.0, "mNms/rad": 1e-3, "Nms/deg": 1 / _DEGREE},
}
"""What each unit of a quantity is in SI, the SI unit first."""

UNITS = {name: Unit(quantity, factor) for quantity, units in _FACTORS.items() for name, factor in units.items()}
"""Known units by symbol; a micro sign or degree sign is read as `u` and `deg` (see `find_unit`)."""

_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "°": "deg", "·": "", "*": "", " ": ""})


def find_unit(symbol: str) -> Unit | None:
    """Return the unit of a symbol (`mm`, `µm`, `N*m`, `°`), or None where it is not known."""
    return UNITS.get(symbol.strip().translate(_SPELLINGS))


_IN_BRACKETS = re.compile(r"(.*?)[\s/_]*[\[(]([^\[\]()]+)[\])]\s*")
_PER_TIME = re.compile(r"_(?:per_)?(s|min)$")
"""How a velocity is written where a name may have no slash: v_mm_s."""
_BEFORE_UNIT = re.compile(r"\s*/\s*|_|\s+in\s+")


def unit_in_heading(heading: str, quantities: Collection[str]) -> tuple[str, str]:
    """Return the name in the heading of a column, and the unit that stands behind it, empty where there is none.

    Parameters
    ----------
    heading : str
    quantities : collection of str
        Physical quantities that the column may have; what stands in brackets is taken for a unit in any case.

    Examples
    --------
    >>> [unit_in_heading(heading, ("length",)) for heading in ("x/mm", "x [mm]", "x_mm")]
    [('x', 'mm'), ('x', 'mm'), ('x', 'mm')]
    >>> unit_in_heading("m_1", ("length",)), unit_in_heading("force/torque", ("torque",))
    (('m_1', ''), ('force/torque', ''))
    """
    # an index such as data[0] is no unit
    if (match := _IN_BRACKETS.fullmatch(heading)) and not match[2].strip().isdigit():
        return match[1], match[2]
    if find_unit(heading) is None:  # a ratio such as N/mm
        for sign in _BEFORE_UNIT.finditer(heading):
            name, symbol = heading[: sign.start()], _PER_TIME.sub(r"/\1", heading[sign.end() :])
            unit = find_unit(symbol)
            in_path = "/" in sign[0] and "/" in name
            if name and not in_path and unit is not None and unit.quantity in quantities:
                return name, symbol.strip()
    return heading, ""


def unit_between(symbol: str, factor: float, tolerance: float) -> str | None:
    """Return the unit of the same quantity that is so many times another one, up to a relative tolerance.

    >>> unit_between("m", 1.1e-3, 0.2)
    'mm'
    """
    unit = find_unit(symbol)
    if unit is None:
        return None
    others = (name for name, known in UNITS.items() if known.quantity == unit.quantity and known != unit)
    return next((name for name in others if abs(UNITS[name].factor / (unit.factor * factor) - 1) <= tolerance), None)


def factor_to_si(symbol: str, quantities: tuple[str, ...]) -> float:
    """Return the factor that turns numbers in a unit into SI.

    Parameters
    ----------
    symbol : str
        Unit as a profile writes it, such as ``mm``.
    quantities : tuple of str
        Physical quantities that are allowed there, such as ``("length",)``.

    Raises
    ------
    ParameterError
        If the unit is not known or measures another quantity.
    """
    unit = find_unit(symbol)
    allowed = [name for name, known in UNITS.items() if known.quantity in quantities]
    if unit is None or unit.quantity not in quantities:
        what = "is not known" if unit is None else f"measures {unit.quantity}"
        raise ParameterError(f"unit {symbol!r} {what}; expected {' or '.join(quantities)}: one of {allowed}")
    return unit.factor

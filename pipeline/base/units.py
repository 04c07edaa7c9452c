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

UNITS: dict[str, Unit] = {
    "s": Unit("time", 1.0),
    "ms": Unit("time", 1e-3),
    "us": Unit("time", 1e-6),
    "ns": Unit("time", 1e-9),
    "min": Unit("time", 60.0),
    "m": Unit("length", 1.0),
    "cm": Unit("length", 1e-2),
    "mm": Unit("length", 1e-3),
    "um": Unit("length", 1e-6),
    "nm": Unit("length", 1e-9),
    "rad": Unit("angle", 1.0),
    "mrad": Unit("angle", 1e-3),
    "urad": Unit("angle", 1e-6),
    "deg": Unit("angle", _DEGREE),
    "rev": Unit("angle", 2 * pi),
    "m/s": Unit("velocity", 1.0),
    "cm/s": Unit("velocity", 1e-2),
    "mm/s": Unit("velocity", 1e-3),
    "um/s": Unit("velocity", 1e-6),
    "rad/s": Unit("angular velocity", 1.0),
    "deg/s": Unit("angular velocity", _DEGREE),
    "rpm": Unit("angular velocity", 2 * pi / 60),
    "N": Unit("force", 1.0),
    "mN": Unit("force", 1e-3),
    "kN": Unit("force", 1e3),
    "Nm": Unit("torque", 1.0),
    "mNm": Unit("torque", 1e-3),
    "Nmm": Unit("torque", 1e-3),
    "Ncm": Unit("torque", 1e-2),
    "kNm": Unit("torque", 1e3),
    "N/m": Unit("stiffness", 1.0),
    "kN/m": Unit("stiffness", 1e3),
    "N/cm": Unit("stiffness", 1e2),
    "N/mm": Unit("stiffness", 1e3),
    "Nm/rad": Unit("rotational stiffness", 1.0),
    "mNm/rad": Unit("rotational stiffness", 1e-3),
    "Nm/deg": Unit("rotational stiffness", 1 / _DEGREE),
    "Ns/m": Unit("damping", 1.0),
    "Ns/mm": Unit("damping", 1e3),
    "Nms/rad": Unit("rotational damping", 1.0),
    "mNms/rad": Unit("rotational damping", 1e-3),
    "Nms/deg": Unit("rotational damping", 1 / _DEGREE),
}
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

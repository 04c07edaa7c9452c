"""Units of foreign logs and their factors to SI; conversion happens only here, at the input."""

from __future__ import annotations

import re
from collections.abc import Collection
from math import pi
from typing import NamedTuple

from pipeline.base.errors import ParameterError


class Unit(NamedTuple):
    """Physical quantity of a unit and its factor to SI."""

    quantity: str
    factor: float


_DEGREE = pi / 180

_FACTORS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9},
    "angle": {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": _DEGREE, "rev": 2 * pi},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "um/s": 1e-6},
    "angular velocity": {"rad/s": 1.0, "deg/s": _DEGREE, "rev/s": 2 * pi, "rpm": 2 * pi / 60},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "torque": {"Nm": 1.0, "mNm": 1e-3, "Nmm": 1e-3, "Ncm": 1e-2, "kNm": 1e3},
    "stiffness": {"N/m": 1.0, "kN/m": 1e3, "N/cm": 1e2, "N/mm": 1e3},
    "rotational stiffness": {"Nm/rad": 1.0, "mNm/rad": 1e-3, "Nm/deg": 1 / _DEGREE},
    "damping": {"Ns/m": 1.0, "Ns/mm": 1e3},
    "rotational damping": {"Nms/rad": 1.0, "mNms/rad": 1e-3, "Nms/deg": 1 / _DEGREE},
}
"""Factor to SI of each unit by quantity, the SI unit first."""

DRIVES: dict[str, dict[str, float]] = {
    "voltage": {"V": 1.0, "mV": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "counts": {"counts": 1.0, "count": 1.0},
    "percent": {"%": 1.0},
}
"""Units of a command that is not yet a force or torque, the internal one first: all parameters of a device are per that
unit until a gain converts the command to force."""


def drive_unit(drive: str, behind: str) -> str:
    """Return a unit with a drive unit in place of N or Nm.

    >>> drive_unit("V", "s/m"), drive_unit("counts", "s/m"), drive_unit("%", "")
    ('Vs/m', 'counts s/m', '%')
    """
    return f"{drive} {behind}" if len(drive) > 1 and behind[:1] not in ("", "/") else f"{drive}{behind}"


def _of_drives() -> dict[str, dict[str, float]]:
    """Return the units derived from a drive: of stiffness, damping, and of the gain that converts it to force."""
    factors: dict[str, dict[str, float]] = {}
    for name, drives in DRIVES.items():
        factors[name] = drives
        for place in ("length", "angle"):
            stiffness = {f"{d}/{x}": f / g for d, f in drives.items() for x, g in _FACTORS[place].items()}
            factors[f"{name} per {place}"] = stiffness
            factors[f"{name} per velocity of {place}"] = {
                spelling: f / g
                for d, f in drives.items()
                for x, g in _FACTORS[place].items()
                for spelling in dict.fromkeys((drive_unit(d, f"s/{x}"), f"{d}s/{x}"))
            }
        for force in ("force", "torque"):
            factors[f"{force} per {name}"] = {
                f"{n}/{d}": g / f for d, f in drives.items() for n, g in _FACTORS[force].items()
            }
    return factors


_FACTORS |= _of_drives()

UNITS = {name: Unit(quantity, factor) for quantity, units in _FACTORS.items() for name, factor in units.items()}
"""Known units by symbol; a micro sign or degree sign is read as `u` and `deg` (see `find_unit`)."""

_WORDS = {
    "sec": "s",
    "second": "s",
    "seconds": "s",
    "milliseconds": "ms",
    "newton": "N",
    "newtons": "N",
    "meter": "m",
    "meters": "m",
    "metres": "m",
    "radian": "rad",
    "radians": "rad",
    "degree": "deg",
    "turn": "rev",
    "turns": "rev",
    "rotations": "rev",
    "revolutions": "rev",
    "turns/s": "rev/s",
    "degrees": "deg",
    "volt": "V",
    "volts": "V",
    "amps": "A",
    "percent": "%",
}
"""Unit names that programs write in full."""

_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "°": "deg", "·": "", "*": "", " ": ""})


def find_unit(symbol: str) -> Unit | None:
    """Return the unit of a symbol or its name (`mm`, `µm`, `N*m`, `°`, `seconds`), or None if unknown."""
    text = symbol.strip()
    return UNITS.get(_WORDS.get(text.lower(), text).translate(_SPELLINGS))


_QUANTITY = re.compile(r"\s*([+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")


_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")


def _decimal(number: str) -> float:
    if _THOUSANDS.fullmatch(number):
        wanted = f"{number.replace(',', '.')} or {number.replace(',', '')}"
        raise ParameterError(f"{number!r}: the comma may separate thousands. Write {wanted}")
    return float(number.replace(",", "."))


def split_quantity(text: str) -> tuple[float, str] | None:
    """Return number and unit of a text such as ``'5 N/mm'``, ``'30ms'`` or ``'2,5 N'``; None if it is no number.

    The unit is empty if there is none. An unknown unit also gives None: ``'1 m'`` is a quantity, ``'2nd'``
    and ``'3 apples'`` are not.

    Raises
    ------
    ParameterError
        If a comma may separate thousands.

    Examples
    --------
    >>> split_quantity("5 N/mm"), split_quantity("2,5"), split_quantity("10 kHz")
    ((5.0, 'N/mm'), (2.5, ''), None)
    """
    match = _QUANTITY.fullmatch(text)
    if match is None or (match[2] and find_unit(match[2]) is None):
        return None
    return _decimal(match[1]), match[2]


def quantity_in_si(text: str, quantities: tuple[str, ...], what: str) -> float:
    """Return a quantity in SI; a plain number is in SI.

    Parameters
    ----------
    text : str
        Such as ``'5 N/mm'`` or ``'5000'``.
    quantities : tuple of str
        Allowed physical quantities.
    what : str
        Name of the option or key, for messages.

    Raises
    ------
    ParameterError
        If it is not a number, or its unit is unknown or belongs to another quantity.

    Examples
    --------
    >>> quantity_in_si("30 ms", ("time",), "--settling"), quantity_in_si("0.03", ("time",), "--settling")
    (0.03, 0.03)
    """
    match = _QUANTITY.fullmatch(text)
    if match is None:
        allowed = next(name for name, known in UNITS.items() if known.quantity in quantities)
        raise ParameterError(f"{what} {text!r}: expected a number, with or without its unit, such as '5 {allowed}'.")
    try:
        return _decimal(match[1]) * (factor_to_si(match[2], quantities) if match[2] else 1.0)
    except ParameterError as error:
        raise ParameterError(f"{what} {text!r}: {error}.") from error


_IN_BRACKETS = re.compile(r"(.*?)[\s/_]*[\[(]([^\[\]()]+)[\])]\s*")
_PER_TIME = re.compile(r"_(?:per_)?(s|min)$")
"""Notation of a velocity unit in names that may not contain a slash: v_mm_s."""
_BEFORE_UNIT = re.compile(r"\s*/\s*|_|\s+in\s+")


def unit_in_heading(heading: str, quantities: Collection[str]) -> tuple[str, str]:
    """Return the name in the heading of a column, and the unit after it; empty if there is none.

    Parameters
    ----------
    heading : str
    quantities : collection of str
        Physical quantities that the column may have; text in brackets always counts as a unit.

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
    """Return the unit of the same quantity that is `factor` times another one, within a relative tolerance.

    >>> unit_between("m", 1.1e-3, 0.2)
    'mm'
    """
    unit = find_unit(symbol)
    if unit is None:
        return None
    others = (name for name, known in UNITS.items() if known.quantity == unit.quantity and known != unit)
    return next((name for name in others if abs(UNITS[name].factor / (unit.factor * factor) - 1) <= tolerance), None)


def factor_to_si(symbol: str, quantities: tuple[str, ...]) -> float:
    """Return the factor of a unit to SI.

    Parameters
    ----------
    symbol : str
        Unit as a profile writes it, such as ``mm``.
    quantities : tuple of str
        Allowed physical quantities, such as ``("length",)``.

    Raises
    ------
    ParameterError
        If the unit is unknown or belongs to another quantity.
    """
    unit = find_unit(symbol)
    allowed = [name for name, known in UNITS.items() if known.quantity in quantities]
    if unit is None or unit.quantity not in quantities:
        what = "is not known" if unit is None else f"measures {unit.quantity}"
        raise ParameterError(f"unit {symbol!r} {what}; expected {' or '.join(quantities)}: one of {allowed}")
    return unit.factor

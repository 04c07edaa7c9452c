"""Units in logs of other programs, and their factors to SI units. Values are converted only when they are read."""

from __future__ import annotations

import re
from collections.abc import Collection
from math import pi
from typing import NamedTuple

from pipeline.base.errors import ParameterError


class Unit(NamedTuple):
    """Physical quantity of a unit, and its factor to the SI unit."""

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
    "rotational stiffness": {"Nm/rad": 1.0, "mNm/rad": 1e-3, "Nm/deg": 1 / _DEGREE, "mNm/deg": 1e-3 / _DEGREE},
    "damping": {"Ns/m": 1.0, "Ns/mm": 1e3},
    "rotational damping": {
        "Nms/rad": 1.0,
        "mNms/rad": 1e-3,
        "Nms/deg": 1 / _DEGREE,
        "mNms/deg": 1e-3 / _DEGREE,
    },
}
"""Factors to the SI unit, keyed by quantity and symbol. The first unit of each quantity is the SI unit."""

DRIVES: dict[str, dict[str, float]] = {
    "voltage": {"V": 1.0, "mV": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "counts": {"counts": 1.0, "count": 1.0},
    "percent": {"%": 1.0},
}
"""Units of a command that is not a force or torque. The first unit of each kind is used internally. All parameters of a
device are per this unit, unless a gain converts the command to a force."""


def drive_unit(drive: str, behind: str) -> str:
    """Return a compound unit, with the unit of a drive in place of N or Nm.

    >>> drive_unit("V", "s/m"), drive_unit("counts", "s/m"), drive_unit("%", "")
    ('Vs/m', 'counts s/m', '%')
    """
    return f"{drive} {behind}" if len(drive) > 1 and behind[:1] not in ("", "/") else f"{drive}{behind}"


def _of_drives() -> dict[str, dict[str, float]]:
    """Return the units of stiffness, of damping and of the gain to a force, for each kind of drive unit."""
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
"""Known units by symbol. `find_unit` replaces a micro sign by `u` and a degree sign by `deg`."""

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
"""Symbols for unit names that programs write in full."""

_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "°": "deg", "·": "", "*": "", " ": ""})


def find_unit(symbol: str) -> Unit | None:
    """Return the unit with a symbol or name (`mm`, `µm`, `N*m`, `°`, `seconds`), or None if it is unknown."""
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
    """Split a text such as ``'5 N/mm'``, ``'30ms'`` or ``'2,5 N'`` into a number and a unit, which may be empty.

    Return None if the text is not a number or if its unit is unknown. For example, ``'1 m'`` is a quantity, but
    ``'2nd'`` and ``'3 apples'`` are not.

    Raises
    ------
    ParameterError
        If a comma may be a thousands separator.

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
    """Convert a quantity to SI units. A number without a unit is already in SI units.

    Parameters
    ----------
    text : str
        Quantity, such as ``'5 N/mm'`` or ``'5000'``.
    quantities : tuple of str
        Allowed physical quantities.
    what : str
        Name of the option or key for messages.

    Raises
    ------
    ParameterError
        If the text is not a number, or if its unit is unknown or belongs to a different quantity.

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
"""Notation of a velocity unit in names that may not contain a slash, such as v_mm_s."""
_BEFORE_UNIT = re.compile(r"\s*/\s*|_|\s+in\s+")


def unit_in_heading(heading: str, quantities: Collection[str]) -> tuple[str, str]:
    """Split the heading of a column into a name and a unit. The unit is empty if there is none.

    Parameters
    ----------
    heading : str
    quantities : collection of str
        Physical quantities that the column may have. Text in brackets always counts as a unit.

    Examples
    --------
    >>> [unit_in_heading(heading, ("length",)) for heading in ("x/mm", "x [mm]", "x_mm")]
    [('x', 'mm'), ('x', 'mm'), ('x', 'mm')]
    >>> unit_in_heading("m_1", ("length",)), unit_in_heading("force/torque", ("torque",))
    (('m_1', ''), ('force/torque', ''))
    """
    # an index, as in data[0], is not a unit
    if (match := _IN_BRACKETS.fullmatch(heading)) and not match[2].strip().isdigit():
        return match[1], match[2]
    if find_unit(heading) is None:  # a unit with a slash, such as N/mm, is not split
        for sign in _BEFORE_UNIT.finditer(heading):
            name, symbol = heading[: sign.start()], _PER_TIME.sub(r"/\1", heading[sign.end() :])
            unit = find_unit(symbol)
            in_path = "/" in sign[0] and "/" in name
            if name and not in_path and unit is not None and unit.quantity in quantities:
                return name, symbol.strip()
    return heading, ""


def unit_between(symbol: str, factor: float, tolerance: float) -> str | None:
    """Return the unit that equals `factor` times a given unit within a relative tolerance, or None if there is none.

    >>> unit_between("m", 1.1e-3, 0.2)
    'mm'
    """
    unit = find_unit(symbol)
    if unit is None:
        return None
    others = (name for name, known in UNITS.items() if known.quantity == unit.quantity and known != unit)
    return next((name for name in others if abs(UNITS[name].factor / (unit.factor * factor) - 1) <= tolerance), None)


def factor_to_si(symbol: str, quantities: tuple[str, ...]) -> float:
    """Return the factor from a unit to the SI unit.

    Parameters
    ----------
    symbol : str
        Unit as written in a profile, such as ``mm``.
    quantities : tuple of str
        Allowed physical quantities, such as ``("length",)``.

    Raises
    ------
    ParameterError
        If the unit is unknown or belongs to a different quantity.
    """
    unit = find_unit(symbol)
    allowed = [name for name, known in UNITS.items() if known.quantity in quantities]
    if unit is None or unit.quantity not in quantities:
        what = "is not known" if unit is None else f"measures {unit.quantity}"
        raise ParameterError(f"unit {symbol!r} {what}; expected {' or '.join(quantities)}: one of {allowed}")
    return unit.factor

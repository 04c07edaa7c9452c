"""Criteria by which walls are judged. A record for each criterion defines all of its properties.

A new criterion is a record here. If its costs are computed in a new way, it has a new family, with a function in
`pipeline.measured.cost.costs` and another in `pipeline.theory.costs`. Importing this module is fast, because every
command imports it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

DISCRETE = "_discrete"
"""Suffix of the name of a criterion whose cost refers to the sampled response."""


@dataclass(frozen=True)
class Family:
    """Criteria whose costs are computed together, in the stage with the same name.

    Parameters
    ----------
    name, title : str
        Name of the stage, and printed name of its costs.
    unit : str
        Unit of a cost: ``samples``, or 1 for a dimensionless number.
    scale : float
        Factor from a cost to the printed number, for example 100 for a share that is printed in percent.
    levels : tuple of float
        Costs at which contours are drawn. If it is empty, contours are drawn at doublings of the smallest cost. Costs
        with levels may be zero, and are therefore compared by their difference. Other costs are compared by their
        ratio.
    none : float
        Largest cost that counts as zero.
    floor : str
        Stored column of the apparent cost due to sensor and chatter alone, if there is one.
    whole : bool
        True if measured costs are integers.
    needs : tuple of str
        Stages whose results the stage uses.
    figure : str
        Figure of the thesis on which maps of the costs are modelled.
    term, definition : str
        Definition in a report, as HTML.
    """

    name: str
    title: str
    unit: str = "1"
    scale: float = 1.0
    levels: tuple[float, ...] = ()
    none: float = 0.0
    floor: str = ""
    whole: bool = False
    needs: tuple[str, ...] = ("response", "wall_law")
    figure: str = "6.5"
    term: str = ""
    definition: str = ""

    @property
    def printed_unit(self) -> str:
        """Unit of the printed number. It is empty for a dimensionless number."""
        return "%" if self.scale != 1 else self.unit.removeprefix("1")


@dataclass(frozen=True)
class Criterion:
    """A criterion.

    Parameters
    ----------
    name, label : str
        Name in commands, files and tables, and name in print.
    family : Family
    column, meaning : str
        Stored column of the measured cost, and its meaning. They are empty if the criterion does not apply to logs.
    band : float, optional
        Half-width of the settling band, relative to the final displacement.
    weight : float
        Exponent w of the time weighting.
    signal : str
        Response to which the criterion applies: ``step`` or ``impulse``. It is empty for criteria of the poles, which
        have no sampled response.
    reported : bool
        True if a report includes the criterion by default.
    tabled : bool
        True if tables include the criterion for an experiment without published values.
    optimum_only : bool
        True if theory provides only the optimum, without costs.
    """

    name: str
    label: str
    family: Family
    column: str = ""
    meaning: str = ""
    band: float | None = None
    weight: float = 0
    signal: str = "step"
    reported: bool = False
    tabled: bool = False
    optimum_only: bool = False


SETTLING = Family(
    "settling",
    "settling time",
    unit="samples",
    whole=True,
    needs=("response", "wall_law", "device", "model", "delay"),
    term="Settling time <i>C</i><sub>settle</sub> [samples], (5.10)",
    definition="Time after which the position stays inside a band of ±1, 2 or 5 % around its final value, divided by "
    "<i>T</i>.\n<i>C</i>* is the first sample from which on all samples are inside.",
)
OVERSHOOT = Family(
    "overshoot",
    "overshoot",
    scale=100.0,
    # The first level is the edge of the region without overshoot. It is the coarsest resolution with which a log
    # counts as free of overshoot, so that theory and logs are compared at one level. Beyond the last level, contours
    # merge with the stability boundary.
    levels=(1e-2, *(0.1 * n for n in range(1, 11))),
    none=1e-12,
    floor="overshoot_floor",
    term="Overshoot <i>C</i><sub>ov</sub> [%], (5.12)",
    definition="(max <i>x</i> − <i>x</i><sub>∞</sub>) / (<i>x</i><sub>∞</sub> − <i>x</i><sub>0</sub>) of the step "
    "response. Its optimum is the largest\nstiffness without overshoot. In theory, that is below 1e-12. In logs, it is "
    "below the resolution of sensor and noise, if\nthis is at most 1 %.",
)
ENERGY = Family(
    "energy",
    "energy cost",
    needs=("response", "wall_law", "device", "model", "delay", "mass"),
    figure="6.6",
    term="Energy cost <i>C</i><sub>E<i>w</i></sub> [1], (5.7) and (5.14)",
    definition="Integral of <i>E</i>(<i>t</i>) <i>t</i><sup><i>w</i></sup> over the response, divided by "
    "<i>T</i><sup><i>w</i>+1</sup><i>E</i><sub>0</sub>, with the\nenergy <i>E</i> = ½(<i>K</i> + <i>k</i>)(<i>x</i> − "
    "<i>x</i><sub>∞</sub>)² + ½<i>m</i>ẋ² and <i>E</i><sub>0</sub> = <i>F</i><sub>0</sub>² / (2(<i>K</i> + "
    "<i>k</i>)), (5.8). It\nextends the ISE (<i>w</i> = 0), ITSE (<i>w</i> = 1) and ISTSE (<i>w</i> = 2) by the "
    "kinetic energy.",
)
RISE = Family(
    "rise",
    "rise time",
    unit="samples",
    term="Rise time <i>C</i><sub>rise</sub> [samples]",
    definition="Time from the first 10 % to the first 90 % of the way to the final value, divided by <i>T</i>.\n"
    "<i>C</i>* takes the motion between two samples as a straight line.",
)
POLES = Family("poles", "poles")

RISE_LEVELS = (0.1, 0.9)
"""Fractions of the final displacement between which the rise time is measured."""


_ALL = (
    *(
        Criterion(
            *(f"settle_{percent}pct", f"settling time, {percent} % band", SETTLING),
            *(f"settle_{percent}pct", f"discrete settling time, band {percent} %", percent / 100),
            reported=True,
            tabled=percent == 2,
        )
        for percent in (1, 2, 5)
    ),
    Criterion(
        *("overshoot", "overshoot", OVERSHOOT, "overshoot"),
        "(max x - x_inf)/(x_inf - x_0), 0 if the position stays below",
        reported=True,
        tabled=True,
    ),
    *(
        Criterion(
            *(f"energy_step_w{w}", f"energy cost, w = {w} ({name}-like)", ENERGY, f"energy_w{w}"),
            f"discrete energy cost, w = {w}: sum minus the contribution of noise, plus the tail",
            weight=w,
            reported=True,
            tabled=True,
        )
        for w, name in enumerate(("ISE", "ITSE", "ISTSE"))
    ),
    Criterion(
        *("rise_time", "rise time, 10 % to 90 %", RISE, "rise_time"),
        "time from first reaching 10 % to first reaching 90 % of x_inf - x_0, linear between samples",
    ),
    # For this criterion, the optimum is required to have no overshoot at all (5.2.2).
    Criterion("overshoot_at_all", "overshoot at all", OVERSHOOT, optimum_only=True),
    *(
        Criterion(f"energy_impulse_w{w}", f"energy cost of the impulse, w = {w}", ENERGY, weight=w, signal="impulse")
        for w in (0, 1, 2)
    ),
    Criterion("pole_radius", "pole radius", POLES, signal=""),
    Criterion("damping", "damping", POLES, signal=""),
)

CRITERIA = {criterion.name: criterion for criterion in _ALL}
"""All criteria by name, in the order in which they are listed."""

MEASURED = tuple(c.name for c in _ALL if c.column)
"""Criteria that apply to the log of a step response."""

REPORTED = tuple(c.name for c in _ALL if c.reported)
"""Criteria of a report by default."""

FAMILIES = {family.name: family for family in (OVERSHOOT, SETTLING, ENERGY, RISE)}
"""Families of `MEASURED` by the names of their stages, in the order of computation."""

_ANY = re.compile(r"settle_(?P<percent>\d+(?:\.\d+)?)pct|energy_(?P<signal>step|impulse)_w(?P<w>\d+(?:\.\d+)?)")
"""Patterns of criteria with a user-defined number: a settling band, or a real exponent w (5.13)."""

SETTLING_BANDS = {c.name: c.band for c in _ALL if c.band is not None}
"""Half-width of the settling band, relative to the final displacement, keyed by criterion."""


WIDEST = 50.0
"""Half-width of the widest settling band [%]. With a wider band, the response would begin inside."""

STEEPEST = 8.0
"""Largest exponent w. Largest exponent w. With a larger exponent, only the last samples above the noise would
contribute."""


def criterion_of(name: str) -> Criterion:
    """Return the criterion with the given name.

    `DISCRETE` may be appended, and any settling band or exponent is allowed.

    Raises
    ------
    KeyError
        If the name is unknown.

    Examples
    --------
    >>> criterion_of("settle_3pct").band, criterion_of("energy_step_w0.5_discrete").weight
    (0.03, 0.5)
    """
    base = name.removesuffix(DISCRETE)
    return CRITERIA[base] if base in CRITERIA else _of_any(base)


@cache
def _of_any(name: str) -> Criterion:
    """Return the settling time for a band of any width, or the energy with any exponent."""
    found = _ANY.fullmatch(name)
    percent, w = (float(found[part] or 0) if found else 0.0 for part in ("percent", "w"))
    if 0 < percent <= WIDEST and name == f"settle_{percent:g}pct":
        return Criterion(name, f"settling time, {percent:g} % band", SETTLING, name, band=percent / 100)
    if found is None or not found["w"] or w > STEEPEST or name != f"energy_{found['signal']}_w{w:g}":
        raise KeyError(name)
    words, column = ("", f"energy_w{w:g}") if found["signal"] == "step" else (" of the impulse", "")
    return Criterion(name, f"energy cost{words}, w = {w:g}", ENERGY, column, weight=w, signal=found["signal"])


def is_criterion(name: str, names: Iterable[str]) -> bool:
    """Return True if a name is one of the given criteria, possibly with `DISCRETE`, or with a different band or
    exponent.

    >>> is_criterion("settle_0.5pct_discrete", MEASURED), is_criterion("settle_60pct", MEASURED)
    (True, False)
    >>> is_criterion("energy_step_w0.5", MEASURED), is_criterion("energy_impulse_w0.5", MEASURED)
    (True, False)
    """
    names = tuple(names)
    if name in with_discrete(names):
        return True
    try:
        found = criterion_of(name)
    except KeyError:
        return False
    others = {(other.family, other.signal) for other in map(criterion_of, names)}
    return found.family in (SETTLING, ENERGY) and (found.family, found.signal) in others


def is_measured(name: str) -> bool:
    """Return True if a criterion applies to logs: one of `MEASURED`, possibly with a different band or exponent.

    >>> is_measured("energy_step_w0.5"), is_measured("settle_2pct_discrete"), is_measured("pole_radius")
    (True, False, False)
    """
    return is_criterion(name, MEASURED) and not name.endswith(DISCRETE)


def members(family: Family, names: Iterable[str] = MEASURED) -> list[Criterion]:
    """Return the given criteria that belong to a family."""
    return [criterion_of(name) for name in names if criterion_of(name).family is family]


def with_discrete(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of criteria, followed by the names with `DISCRETE` appended of the criteria that apply to a
    response."""
    names = tuple(names)
    return (*names, *(f"{name}{DISCRETE}" for name in names if CRITERIA[name].signal))

"""All data figures of the thesis's theory chapters by number: what `pipeline theory figures` draws.

A figure is one or more functions that make a panel, over a list of parameters; its words are in ``figures.toml``.
Left out are 3.1 to 3.4, sketches of device and control loop.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from pipeline.base.errors import UsageError
from pipeline.studies.figure import Panel, TheoryFigure
from pipeline.studies.thesis import maps, passivity, relations, stability, steps
from pipeline.studies.thesis.curves import plain_loop
from pipeline.studies.thesis.relations import IMPULSE, STEP
from pipeline.theory.optimum.optimum import optimal_point

DELAYS = (0.0, 1.0)
"""Delay factors of the maps."""

Content = tuple[list[Panel], tuple[float, ...]]
"""Panels of a figure, and the numbers that its caption states."""


def _over(panel: Callable[..., Panel], parameters: Iterable[Any] = ((),)) -> Callable[[], Content]:
    """Return the panels of a function over a list of parameters, each a tuple of them or one alone."""
    return _in_turn(parameters, panel)


def _in_turn(parameters: Iterable[Any], *panels: Callable[..., Panel]) -> Callable[[], Content]:
    """Return for each parameter the panels of all functions, in turn."""
    each = [given if isinstance(given, tuple) else (given,) for given in parameters]
    return lambda: ([panel(*given) for given in each for panel in panels], ())


def _maps(*criteria: str, stated: str = "cost") -> Callable[[], Content]:
    """Return maps of criteria with both delays; the caption states what their optima come to."""
    pairs = [*product(criteria, DELAYS)]
    return lambda: (
        [maps.cost_map(*pair) for pair in pairs],
        tuple(getattr(optimal_point(plain_loop(delay), criterion), stated) for criterion, delay in pairs),
    )


_RULED = (
    (("settle_2pct", "overshoot"), "(a) settling time and overshoot, "),
    (STEP, "(b) energy, step, "),
    (IMPULSE, "(c) energy, impulse, "),
)
_RATIOS = ("(b) ratio", stability.DELAY_SWEEP, 0.7), ("(c) ratio, longer delays", passivity.FAR, 1.05)
_SIDES = ("stiffness", 60.0), ("damping", 75.0)
_ENERGY_OPTIMA = (
    ("a", "step", "step", 0.0, 5.0),
    ("a", "step", "impulse", -0.8, 2.0),
    ("b", "impulse", "step", 0.0, 12.0),
    ("b", "impulse", "impulse", -0.8, 2.0),
)
"""Parameters of panels that are listed here to be read."""

_FIGURES: dict[str, Callable[[], Content]] = {
    "3.5": _over(stability.human_arm),
    "3.6": _over(stability.limits, (0.0, 1.0)),
    "3.7": _over(stability.origin, (0.0, 1.0)),
    "3.8": _over(stability.family),
    "3.9": _in_turn(((),), stability.largest_stiffness, stability.largest_damping),
    "3.10": _over(stability.limits, (2.0, 4.0)),
    "3.11": _over(stability.linear_condition, (0.0, 1.0)),
    "4.1": _over(passivity.regions),
    "4.2": _over(passivity.largest),
    "4.3": _in_turn(((),), passivity.whole, passivity.around_origin),
    "4.4": lambda: ([passivity.both_largest(), *(passivity.ratio(*ratio) for ratio in _RATIOS)], ()),
    "4.5": _in_turn(passivity.SPRING_DELAYS, passivity.springs, passivity.springs_close, passivity.undamped_springs),
    "5.1": _in_turn(((),), relations.settling_circles, relations.damping_spirals),
    "5.2": _maps("pole_radius"),
    "5.3": _maps("damping"),
    "5.4": _maps("settle_2pct_discrete", "settle_2pct"),
    "5.5": steps.quickest_settling,
    "5.6": steps.settling_jump,
    "5.7": _over(maps.poles_against_response, DELAYS),
    "5.8": _maps("overshoot_discrete", "overshoot", stated="alpha"),
    "5.9": steps.overshoot_jump,
    "5.10": _over(maps.energy_map, (*STEP, *IMPULSE)),
    "5.11": _over(steps.energy_optima, _ENERGY_OPTIMA),
    "5.12": _over(relations.against_rules, [(*ruled, d) for ruled, d in product(_RULED, DELAYS)]),
    "5.13": _over(relations.against_rules, [(("pole_radius", "damping"), "", d) for d in DELAYS]),
    "5.14": _over(relations.optima, (0.0, 1.0, 2.0)),
    "5.15": _over(relations.share_of_largest, [(title, *side) for title, side in product(relations.GROUPS, _SIDES)]),
    "5.16": _in_turn(relations.GROUPS, relations.optimal_costs, relations.approximation_errors),
}
"""What makes the panels of each figure."""


def _place(number: str) -> tuple[int, int]:
    chapter, figure = number.split(".")
    return int(chapter), int(figure)


NUMBERS = tuple(sorted(_FIGURES, key=_place))
"""Numbers of all figures, in the order of the thesis."""


@cache
def _words() -> dict[str, dict[str, Any]]:
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def _figure(number: str) -> TheoryFigure:
    words, (panels, stated) = _words()[number], _FIGURES[number]()
    caption = words["caption"].format(*stated)
    return TheoryFigure(number, words["title"], caption, tuple(panels), words.get("columns", 2))


def compute(numbers: Sequence[str] = NUMBERS) -> Iterator[TheoryFigure]:
    """Yield figures by number, each as soon as it is computed, in the order of the thesis and once each.

    Parameters
    ----------
    numbers : sequence of str
        Of `NUMBERS`.

    Raises
    ------
    UsageError
        For an unknown number, before anything is computed.

    Notes
    -----
    Optimal curves and points are shared between figures and computed once a process; all figures take about 40 s.
    """
    unknown = [number for number in numbers if number not in _FIGURES]
    if unknown:
        raise UsageError(f"figure {unknown[0]!r} is unknown; expected one of {', '.join(NUMBERS)}.")
    return map(_figure, sorted(set(numbers), key=_place))

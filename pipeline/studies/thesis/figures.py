"""All data figures of the thesis's theory chapters by number: what `pipeline theory figures` draws.

Left out are 3.1 to 3.4, sketches of device and control loop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from pipeline.base.errors import UsageError
from pipeline.studies.panels import TheoryFigure
from pipeline.studies.thesis import courses, maps, passivity, relations, stability

_MODULES = (stability, passivity, maps, courses, relations)


def _place(number: str) -> tuple[int, int]:
    chapter, figure = number.split(".")
    return int(chapter), int(figure)


_FIGURES: dict[str, Callable[[], TheoryFigure]] = {
    number: figure for module in _MODULES for number, figure in module.FIGURES.items()
}

NUMBERS = tuple(sorted(_FIGURES, key=_place))
"""Numbers of all figures, in the order of the thesis."""


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
    return (_FIGURES[number]() for number in sorted(set(numbers), key=_place))

"""Small figures as SVG that a page draws in its own colours: trials in the plane, limits, a response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from pipeline.records.batch import Floats

WIDTH, HEIGHT = 640.0, 400.0
LEFT, RIGHT, TOP, BOTTOM = 104.0, 16.0, 12.0, 58.0
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
MOST_POINTS = 1200
"""Of a line; more are not told apart on any screen."""


@dataclass(frozen=True)
class Layer:
    """Points or a line: name of its class in the style sheet, places, and ends of intervals of the ordinate."""

    kind: str
    x: Floats
    y: Floats
    label: str
    low: Floats | None = None
    high: Floats | None = None
    links: Sequence[str] = ()


def figure(layers: Sequence[Layer], x_label: str, y_label: str, title: str, zero: bool = True) -> Markup:
    """Return layers over each other, with axes; ``zero`` begins both at 0."""
    xs = np.concatenate([layer.x for layer in layers] or [np.zeros(1)])
    ys = np.concatenate(
        [v for layer in layers for v in (layer.y, layer.low, layer.high) if v is not None] or [np.zeros(1)]
    )
    x_axis, y_axis = (_Axis.of(values[np.isfinite(values)], zero) for values in (xs, ys))
    role = "group" if any(layer.links for layer in layers) else "img"  # an image hides what is in it
    parts = [
        f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="{role}" class="plot"><title>{escape(title)}</title>',
        *_axes(x_axis, y_axis, x_label, y_label),
    ]
    for layer in layers:
        parts += _drawn(layer, x_axis, y_axis)
    return Markup("".join([*parts, "</svg>"]))


@dataclass(frozen=True)
class _Axis:
    low: float
    high: float
    ticks: Floats

    @classmethod
    def of(cls, values: Floats, zero: bool) -> _Axis:
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        low = min(low, 0.0) if zero else low
        high = high if high > low else low + 1.0
        power = 10.0 ** np.floor(np.log10((high - low) / 4))
        step = next(s * power for s in STEPS if s * power >= (high - low) / 5)
        first, last = np.floor(low / step), np.ceil(high / step)
        return cls(first * step, last * step, np.arange(first, last + 1) * step)

    def at(self, values: Floats, start: float, end: float) -> Floats:
        return np.asarray(start + (values - self.low) / (self.high - self.low) * (end - start))


def _axes(x: _Axis, y: _Axis, x_label: str, y_label: str) -> list[str]:
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    parts = []
    for value, place in zip(x.ticks.tolist(), x.at(x.ticks, LEFT, right).tolist(), strict=True):
        parts.append(f'<path class="grid" d="M{place:.1f} {TOP:g}V{bottom:g}"/>')
        parts.append(f'<text class="tick" x="{place:.1f}" y="{bottom + 20:g}" text-anchor="middle">{value:.5g}</text>')
    for value, place in zip(y.ticks.tolist(), y.at(y.ticks, bottom, TOP).tolist(), strict=True):
        parts.append(f'<path class="grid" d="M{LEFT:g} {place:.1f}H{right:g}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 6:g}" y="{place + 4:.1f}" text-anchor="end">{value:.5g}</text>')
    middle_x, middle_y = (LEFT + right) / 2, (TOP + bottom) / 2
    parts.append(
        f'<text class="label" x="{middle_x:g}" y="{HEIGHT - 8:g}" text-anchor="middle">{escape(x_label)}</text>'
    )
    turn = f'transform="rotate(-90 18 {middle_y:g})"'
    parts.append(f'<text class="label" x="18" y="{middle_y:g}" text-anchor="middle" {turn}>{escape(y_label)}</text>')
    return parts


def _drawn(layer: Layer, x_axis: _Axis, y_axis: _Axis) -> list[str]:
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    x, y = x_axis.at(layer.x, LEFT, right), y_axis.at(layer.y, bottom, TOP)
    kind = escape(layer.kind)
    parts = [f'<g class="{kind}"><title>{escape(layer.label)}</title>']
    if layer.low is not None and layer.high is not None:
        ends = zip(x, y_axis.at(layer.low, bottom, TOP), y_axis.at(layer.high, bottom, TOP), strict=True)
        parts += [f'<path class="interval" d="M{a:.1f} {b:.1f}V{c:.1f}"/>' for a, b, c in ends if np.isfinite(b + c)]
    if layer.links:
        for a, b, link in zip(x, y, layer.links, strict=True):
            label = f"trial {link.rpartition('/')[2]}, {layer.label}"
            parts.append(f'<a href="{escape(link)}" aria-label="{escape(label)}">{_mark(layer.kind, a, b)}</a>')
    else:
        every = max(1, len(x) // MOST_POINTS)
        places = [f"{a:.1f} {b:.1f}" for a, b in zip(x[::every], y[::every], strict=True) if np.isfinite(a + b)]
        parts.append(f'<path class="line" d="M{"L".join(places)}"/>' if places else "")
    return [*parts, "</g>"]


def _mark(kind: str, x: float, y: float) -> str:
    """Return a mark that is told from others without colours, too."""
    if kind == "unstable":
        return f'<path class="mark" d="M{x - 4:.1f} {y - 4:.1f}l8 8m0-8l-8 8"/>'
    return f'<circle class="mark" cx="{x:.1f}" cy="{y:.1f}" r="{4 if kind == "stable" else 3}"/>'

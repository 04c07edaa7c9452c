"""Determine stability and costs of virtual walls under delay from step-response logs, and compare them with theory.

The names in `__all__` are the public Python interface (``docs/python.md``): functions, and record classes whose tables
are data frames in SI units. Each name is imported at its first use, so that ``import pipeline`` is fast. All other
modules are private and are listed in ``docs/architecture.md``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from pipeline.base.provenance import __version__ as __version__

if TYPE_CHECKING:
    from pipeline.base.errors import PipelineError as PipelineError
    from pipeline.rig.design import Design as Design
    from pipeline.rig.design import design as design
    from pipeline.rig.published import published_limits as published_limits
    from pipeline.surface.comparisons import Comparison as Comparison
    from pipeline.surface.comparisons import compare as compare
    from pipeline.surface.comparisons import load as load
    from pipeline.surface.identify import IdentifiedDevice as Identified
    from pipeline.surface.identify import identify as identify
    from pipeline.surface.log_picture import look as look
    from pipeline.surface.logs import ingest as ingest
    from pipeline.surface.logs import read_log as read_log
    from pipeline.surface.logs import simulate as simulate
    from pipeline.surface.next_wall import plan as plan
    from pipeline.surface.physical_loop import Loop as Loop
    from pipeline.surface.stored import boundary as boundary
    from pipeline.surface.stored import costs as costs
    from pipeline.surface.stored import devices as devices
    from pipeline.surface.stored import estimates as estimates
    from pipeline.surface.stored import experiments as experiments
    from pipeline.surface.stored import human_arms as human_arms
    from pipeline.surface.stored import optima as optima
    from pipeline.surface.stored import samples as samples
    from pipeline.surface.stored import trials as trials

_PUBLIC = {
    "base.errors": ("PipelineError",),
    "surface.logs": ("ingest", "read_log", "simulate"),
    "surface.stored": (
        *("devices", "experiments", "trials", "samples", "estimates", "boundary", "optima", "costs"),
        "human_arms",
    ),
    "surface.comparisons": ("Comparison", "compare", "load"),
    "surface.identify": ("Identified", "identify"),
    "surface.log_picture": ("look",),
    "surface.next_wall": ("plan",),
    "surface.physical_loop": ("Loop",),
    "rig.design": ("Design", "design"),
    "rig.published": ("published_limits",),
}
"""Module that defines each public name."""

_CLASSES = {"Identified": "IdentifiedDevice"}
"""Name of a public class in its module, if it differs from the public name."""

__all__ = [
    "Comparison",
    "Design",
    "Identified",
    "Loop",
    "PipelineError",
    "boundary",
    "compare",
    "costs",
    "design",
    "devices",
    "estimates",
    "experiments",
    "human_arms",
    "identify",
    "ingest",
    "load",
    "look",
    "optima",
    "plan",
    "published_limits",
    "read_log",
    "samples",
    "simulate",
    "trials",
]


def __getattr__(name: str) -> Any:
    for module, names in _PUBLIC.items():
        if name in names:
            value = getattr(import_module(f"{__name__}.{module}"), _CLASSES.get(name, name))
            globals()[name] = value  # later accesses find the name in the module and skip this function
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)

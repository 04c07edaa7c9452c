"""Compute theoretical optima in physical units, in parallel, with a cache in `processed/theory/`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict

from pipeline.base.disk import if_writable, read_result, write_result
from pipeline.base.errors import ParameterError
from pipeline.base.process import process_pool
from pipeline.base.provenance import code_digest, digest, sha256
from pipeline.device.loop import Loop
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.records.criteria import criterion_of
from pipeline.records.results import SourcedLoop
from pipeline.records.trials import Floats
from pipeline.theory.boundary import Boundary, boundary, stabilises, stiffness_limit
from pipeline.theory.costs import costs_at
from pipeline.theory.optimum import optimal_point
from pipeline.theory.passivity import passive_outline
from pipeline.theory.search import OptimalPoint

_TURN = {"overshoot": 0, "energy": 2}
"""Order in which families are computed, with the slowest first. The order of other families is 1."""

BOUNDARY_POINTS = 160
"""Number of points of a boundary in a figure."""


@dataclass(frozen=True)
class Prediction:
    """Stiffness [N/m, Nm/rad], damping [Ns/m, Nms/rad] and cost of a theoretical optimum.

    ``region`` is (K, K, B, B) if the optimum is a region.
    """

    stiffness: float
    damping: float
    cost: float
    region: tuple[float, float, float, float] | None


@dataclass(frozen=True)
class Theory:
    """Theory of a loop."""

    described: SourcedLoop

    @property
    def loop(self) -> Loop:
        """Loop in SI."""
        return self.described.loop

    @property
    def source(self) -> str:
        """Source of the parameters."""
        return self.described.source

    @cached_property
    def units(self) -> LoopUnits:
        """Factors between physical and normalised parameters."""
        return LoopUnits.of(self.loop)

    @cached_property
    def normalised(self) -> NormalisedLoop:
        """Loop in normalised parameters."""
        return NormalisedLoop.of(self.loop)

    @cached_property
    def stabilised(self) -> bool:
        """Whether some damping stabilises a soft wall. Otherwise, there is neither a boundary nor an optimum."""
        return stabilises(self.normalised)

    @cached_property
    def passive_outline(self) -> tuple[Floats, Floats] | None:
        """Outline of the passive region, alpha and beta, for the damping of the device only, or None if there is
        none."""
        if self.loop.damping <= 0 or self.normalised.plant.sensor_at_load:
            return None
        return passive_outline(self.normalised, self.loop.passive_damping / self.units.damping)

    @cached_property
    def boundary(self) -> Boundary:
        """Normalised stability boundary."""
        return boundary(self.normalised, BOUNDARY_POINTS)

    def margin(self, wall: Prediction) -> float | None:
        """Return the stability limit at the damping of a wall, divided by its stiffness. None for K = 0."""
        if not wall.stiffness > 0:
            return None
        limit = stiffness_limit(self.normalised, np.array([wall.damping / self.units.damping]))
        return float(limit[0]) * self.units.stiffness / wall.stiffness

    def physical(self, point: OptimalPoint) -> Prediction:
        """Return an optimal point in physical units."""
        k, b = self.units.stiffness, self.units.damping
        region = point.box and (point.box[0] * k, point.box[1] * k, point.box[2] * b, point.box[3] * b)
        return Prediction(point.alpha * k, point.beta * b, point.cost, region)


Request = tuple[NormalisedLoop, str]


Found = OptimalPoint | str
"""Optimum, or the reason why there is none."""


class _Kept(BaseModel):
    """File of cached optima. Its loop is only information for readers."""

    loop: str
    optima: dict[str, Found]

    model_config = ConfigDict(allow_inf_nan=False)


def _found(loop: NormalisedLoop, criterion: str) -> Found:
    """Return an optimum, or the reason why there is none. A criterion without an optimum does not stop a comparison."""
    try:
        return optimal_point(loop, criterion)
    except ParameterError as error:
        return str(error).rstrip(".")


@dataclass
class Predictions:
    """Requested optima, from a cache or computed. As a context manager, it stops running computations on exit.

    Parameters
    ----------
    folder : Path
        Folder of the cached optima, with one JSON file per loop.
    """

    folder: Path
    _known: dict[Request, Found] = field(default_factory=dict)
    _pending: dict[Request, Future[Found]] = field(default_factory=dict)
    _pool: ExitStack = field(default_factory=ExitStack)
    _costs: dict[tuple[NormalisedLoop, str, str], Floats] = field(default_factory=dict)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: Any) -> None:
        self._pending = {}
        self._pool.__exit__(*reason)

    def costs_at(
        self, theory: Theory, stiffness: Floats, damping: Floats, criteria: Sequence[str]
    ) -> dict[str, Floats]:
        """Return the costs of `costs.costs_at` at points in physical units. Earlier results are cached.

        Parameters
        ----------
        theory : Theory
        stiffness, damping : float64, shape (n,)
        criteria : sequence of str
        """
        alpha, beta = stiffness / theory.units.stiffness, damping / theory.units.damping
        points = sha256(alpha.tobytes() + beta.tobytes())
        new = [c for c in criteria if (theory.normalised, points, c) not in self._costs]
        found = costs_at(theory.normalised, alpha, beta, new) if new else {}
        self._costs |= {(theory.normalised, points, c): cost for c, cost in found.items()}
        return {c: self._costs[theory.normalised, points, c] for c in criteria}

    def missing(self, requests: Iterable[Request]) -> list[Request]:
        """Return the requests without a cached result."""
        wanted = dict.fromkeys(requests)
        for loop in {loop for loop, _ in wanted}:
            self._known |= {(loop, c): p for c, p in self._read(loop).items()}
        return [request for request in wanted if request not in self._known]

    def start(self, requests: Iterable[Request]) -> None:
        """Start to compute missing optima, in other processes if there are several optima and processors."""
        missing = self.missing(requests)
        workers = min(len(missing), os.cpu_count() or 1)
        if workers < 2:
            self._store({request: _found(*request) for request in missing})
            return
        pool = self._pool.enter_context(process_pool(workers))
        # slow computations first, so that processors finish at similar times
        order = sorted(missing, key=lambda r: (_TURN.get(criterion_of(r[1]).family.name, 1), -r[0].delay))
        self._pending = {request: pool.submit(_found, *request) for request in order}

    def finish(self) -> None:
        """Wait for the computations of `start`, and cache their results."""
        try:
            found = {request: future.result() for request, future in self._pending.items()}
        except BrokenProcessPool:
            # a process was killed, or could not import the main program of the caller (interactive, or without a guard)
            found = {request: _found(*request) for request in self._pending}
        self._store(found)
        self._pending = {}
        self._pool.close()

    def get(self, theory: Theory, criterion: str) -> Prediction | None:
        """Return a requested optimum in physical units, or None if it does not exist."""
        found = self._known[theory.normalised, criterion]
        return None if isinstance(found, str) else theory.physical(found)

    def why(self, theory: Theory, criterion: str) -> str:
        """Return why a requested optimum does not exist. The result is empty if the optimum exists."""
        found = self._known[theory.normalised, criterion]
        return found if isinstance(found, str) else ""

    def cost(self, loop: NormalisedLoop, criterion: str) -> float | None:
        """Return the cost of a requested optimum, or None if it does not exist."""
        found = self._known[loop, criterion]
        return None if isinstance(found, str) else found.cost

    def _store(self, found: Mapping[Request, Found]) -> None:
        self._known |= found
        for loop in {loop for loop, _ in found}:
            points = self._read(loop) | {c: p for (other, c), p in found.items() if other == loop}
            kept = _Kept.model_construct(loop=repr(loop), optima=dict(sorted(points.items())))
            with if_writable():
                write_result(self.folder, self._key(loop), ".json", f"{kept.model_dump_json(indent=1)}\n".encode())

    def _key(self, loop: NormalisedLoop) -> str:
        return digest([*(repr(getattr(loop, part.name)) for part in fields(loop)), code_digest("theory")])

    def _read(self, loop: NormalisedLoop) -> dict[str, Found]:
        data = read_result(self.folder, self._key(loop), ".json")
        try:
            return {} if data is None else _Kept.model_validate_json(data).optima
        except ValueError:
            return {}  # the file has another format and is recomputed

"""Trials with what their costs are computed from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from columns import Columns

from pipeline.measured.cost.costs import CostInputs, ReadingInputs, overshoot, settling
from pipeline.measured.cost.energy import energy_interval, energy_terms
from pipeline.measured.cost.reading_error import gain_at_rest, reading_error, sensor_error, usual_gain
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import judge
from pipeline.records.criteria import SETTLING_BANDS


@dataclass
class Logs:
    """Trials of one sensor and a delay [samples]; a verdict or a response may be given in place of the log's."""

    trials: object
    delay: int = 4
    sensor: float | None = None
    gain: float | None = None
    given_responses: list | None = None
    given_verdicts: list | None = None

    @cached_property
    def responses(self):
        return self.given_responses or [find_response(trial) for trial in self.trials]

    @cached_property
    def verdicts(self):
        return self.given_verdicts or [judge(*pair) for pair in zip(self.trials, self.responses, strict=True)]

    @cached_property
    def errors(self):
        seen = Columns(self.responses)
        rows = np.maximum(seen.edge_row, 0)
        sensor = sensor_error(seen.sensor_noise, seen.sensor_quantum, rows) if self.sensor is None else self.sensor
        pairs = list(zip(self.trials, self.responses, strict=True))
        gain = self.gain or usual_gain(np.array([gain_at_rest(*pair, self.delay, sensor) for pair in pairs]))
        return [reading_error(*pair, self.delay, sensor=sensor, gain=gain) for pair in pairs]

    def each(self, function, *arguments, errors=(), **more):
        """What a function returns of each trial, with its response, verdict and perhaps error."""
        logs = zip(self.trials, self.responses, self.verdicts, *errors, strict=True)
        return [function(*log[:3], *arguments, *log[3:], **more) for log in logs]

    def settling(self, *, errors=True, **more):
        """Settling times by criterion."""
        costs = self.each(settling, self.delay, errors=[self.errors] if errors else (), **more)
        return {name: Columns(cost[name] for cost in costs) for name in SETTLING_BANDS}

    def overshoot(self, *, errors=True):
        return Columns(self.each(overshoot, errors=[self.errors] if errors else ()))

    def energy(self, mass, **more):
        """Energies with their intervals, shape (n, 3)."""
        inputs = CostInputs(ReadingInputs(self.delay, None, 1.0, 0.0), mass=mass, **more)
        logs = zip(self.trials, self.responses, self.verdicts, self.errors, strict=True)
        return Columns(energy_interval(*log, inputs) for log in logs)

    def terms(self):
        return Columns(self.each(energy_terms, self.delay))

    def summed(self, mass):
        """Plain sums of the energies, shape (n, 3)."""
        return np.array([terms.summed(mass) for terms in self.terms().records])

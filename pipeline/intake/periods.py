"""Keeps logs of one sampling period together: one that differs by more than 1 % is of another loop and experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import pyarrow as pa

from pipeline.readers import Log

APART = 0.01
"""Part by which sampling periods of one experiment may differ: a clock is off by 1e-4, and the limit of a stiff wall is
proportional to 1/T."""


class Periods:
    """Sampling period [s] of each experiment of a store, by device and name; the first log decides.

    Parameters
    ----------
    stored : pyarrow.Table
        Device, experiment and period of all stored trials.
    """

    def __init__(self, stored: pa.Table) -> None:
        self.stored = stored

    @cached_property
    def known(self) -> dict[tuple[str, str], float]:
        """What is stored, and what was taken since."""
        columns = ["device", "experiment", "sampling_period_s"]
        device, experiment, period = (self.stored.column(name).to_pylist() for name in columns)
        # the first row of each is what counts
        return dict(zip(zip(device[::-1], experiment[::-1], strict=True), period[::-1], strict=True))

    def apart(self, logs: Sequence[Log]) -> tuple[Log, ...]:
        """Return logs with the names of experiments of their own period; one that is renamed says so."""
        return tuple(map(self._of_own_period, logs))

    def _of_own_period(self, log: Log) -> Log:
        header, period = log.header, log.header.sampling_period_s
        common = self.known.setdefault((header.device, header.experiment), period)
        if alike(common, period):
            return log
        stem = f"{header.experiment}-T"
        name = next(
            (
                other
                for (device, other), known in self.known.items()
                if device == header.device and other.startswith(stem) and alike(known, period)
            ),
            f"{stem}{1e3 * period:.4g}ms",
        )
        self.known.setdefault((header.device, name), period)
        text = (
            f"the sampling period is {1e3 * period:.4g} ms; logs of experiment {header.experiment!r} have "
            f"{1e3 * common:.4g} ms. It is stored as experiment {name!r}: another period is another loop."
        )
        return replace(log, header=replace(header, experiment=name), warnings=(*log.warnings, text))


def alike(one: float, other: float) -> bool:
    """Return whether two sampling periods [s] may be of one experiment."""
    return abs(one - other) <= APART * max(one, other)

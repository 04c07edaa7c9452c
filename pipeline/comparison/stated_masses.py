"""Compare the apparent mass of the logs with the masses that a device file and a publication state.

Source: Hulin 2017, secs. 6.1.2, 6.2.2 and 6.3 (the apparent inertia differs from the weighed one).
"""

from __future__ import annotations

from collections.abc import Iterator

from pipeline.device.loop import Loop
from pipeline.device_data.published import published_mass
from pipeline.records.findings import Estimate
from pipeline.records.models import Device
from pipeline.records.results import MassDeviation, MassSource, MeasuredExperiment

MOMENTUM = "thesis_momentum_balance"
"""Method of the thesis that gives a mass by the balance of linear momentum (6.4)."""


def mass_deviations(
    result: MeasuredExperiment, device: Device | None, stated: Loop | None
) -> tuple[MassDeviation, ...]:
    """Return the stated masses of an experiment, with the deviations of the masses of the logs from them.

    The tuple is empty if no mass is stated.

    Parameters
    ----------
    result : MeasuredExperiment
    device : Device or None
        Device as described by its file.
    stated : Loop or None
        Loop of the device file for this experiment, with its operator.

    Notes
    -----
    A published mass is that of the device alone. It is compared only if no operator was on the device.
    """
    return tuple(_deviations(result, device, stated))


def _deviations(result: MeasuredExperiment, device: Device | None, stated: Loop | None) -> Iterator[MassDeviation]:
    mass = result.estimates.get("mass")
    if mass is None:
        return
    if stated is not None:
        yield _deviation("device file", "", stated.apparent().mass, mass)
    known = published_mass(device.published_as or device.name) if device is not None else None
    if known is not None and result.grip == "none":
        yield _deviation("weighed", known.section, known.mass, mass)


def _deviation(source: MassSource, section: str, stated: float, mass: Estimate) -> MassDeviation:
    """Return a stated mass [kg, kg m^2] with the deviations of the estimate and of the momentum mass [%]."""

    def percent(value: float | None) -> float | None:
        return None if value is None else 100 * (value / stated - 1)

    momentum = mass.by_method.get(MOMENTUM)
    return MassDeviation(
        source=source,
        section=section,
        stated=stated,
        percent=percent(mass.value),
        low=percent(mass.low),
        high=percent(mass.high),
        momentum_percent=percent(momentum.value if momentum else None),
        momentum_low=percent(momentum.low if momentum else None),
        momentum_high=percent(momentum.high if momentum else None),
    )

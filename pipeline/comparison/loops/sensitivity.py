"""Compute what limits a device, and what makes its stable region smaller or larger than that of theory.

Source: Hulin 2017, secs. 3.6 (influence of each parameter), 6.2.3 and 6.3 (smaller region of the light-weight robot).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.comparison.limits import Stretches, measured_limits, overlap
from pipeline.comparison.loops.loop_basis import LoopBasis
from pipeline.device.loop import Loop
from pipeline.measured.experiment.identified_loop import IdentifiedLoop
from pipeline.planning.loop_limits import damping_of_stiffest, linear_limits
from pipeline.records.findings import Limit, holds
from pipeline.records.results import ChangeCode, LoopChange, MeasuredExperiment, RegionCauses
from pipeline.records.trials import Floats


def sensitivities(loop: Loop, limits: Sequence[Limit]) -> tuple[LoopChange, ...]:
    """Return the change in the largest stable stiffness if the delay is one sample shorter, or without each part.

    Parameters
    ----------
    loop : Loop
        Loop whose limits are considered.
    limits : sequence of Limit
        Limits of this loop at the tested dampings. With friction or jitter, they state the linear limits, too.
    """
    most = _stiffest(loop)
    if not most > 0:
        return ()
    found = [LoopChange(code=code, percent=100 * (_stiffest(other) / most - 1)) for code, other in _without_parts(loop)]
    if (bent := _nonlinear(limits)) is not None:
        stiffness, linear = (values.max() for values in bent)
        if stiffness > 0:
            found.append(LoopChange(code=_nonlinear_code(loop), percent=100 * float(linear / stiffness - 1)))
    return tuple(found)


def _stiffest(loop: Loop) -> float:
    """Return the largest stable stiffness of the linear loop over all dampings [N/m, Nm/rad]."""
    return float(linear_limits(loop, np.array([damping_of_stiffest(loop)]))[0])


def _without_parts(loop: Loop) -> Iterator[tuple[ChangeCode, Loop]]:
    """Yield the loop with one sample less of delay, and without each of its linear parts."""
    if loop.delay_samples >= 1:
        yield "delay", replace(loop, delay_samples=loop.delay_samples - 1, jitter_samples=())
    if loop.velocity is not None:
        yield "velocity_filter", replace(loop, velocity=None)
    if loop.actuator_lag_s > 0:
        yield "actuator_lag", replace(loop, actuator_lag_s=0.0)
    if loop.mode is not None:
        yield "vibration_mode", replace(loop, mode=None)
    if loop.operator is not None:
        yield "operator", replace(loop, operator=None)
    if loop.damping > 0:
        yield "damping", loop.with_damping(0.0)


def _nonlinear(limits: Sequence[Limit]) -> tuple[Floats, Floats] | None:
    """Return the limits for the step and the linear limits, (n,) each, or None if the loop is linear."""
    pairs = [(each.stiffness, each.stiffness_large_motion) for each in limits]
    if not pairs or any(linear is None for _, linear in pairs):
        return None
    stiffness, linear = np.array(pairs, dtype=np.float64).T
    return stiffness, linear


def _nonlinear_code(loop: Loop) -> ChangeCode:
    return "friction" if loop.friction is not None else "delay_jitter"


def region_causes(
    result: MeasuredExperiment, stated: Loop | None, basis: LoopBasis, limits: Sequence[Limit]
) -> RegionCauses | None:
    """Compute the changes in the area of theory's stable region due to the numbers and parts of the logs.

    The result is None without a device file, without an identified device, or with fewer than two measured limits.

    Parameters
    ----------
    result : MeasuredExperiment
        Experiment with measured limits.
    stated : Loop or None
        Loop of the device file.
    basis : LoopBasis
        Device identified from the logs, and the loop on which the conclusions are based.
    limits : sequence of Limit
        Limits of the loop on which the conclusions are based. With friction or jitter, they state the linear limits,
        too.

    Notes
    -----
    The area is that between the first and the last tested damping, below the end of the tested range. One number or
    part of the device file at a time is replaced by that of the logs, if the stated value lies outside the 95 %
    interval of the logs. Friction and jitter change the area by the ratio of the limits for the step to the linear
    limits.
    """
    measured = measured_limits(result.boundary)
    B, device = measured.damping, basis.identified
    if stated is None or device is None or len(B) < 2:
        return None
    loop = stated.apparent()

    def area(limit: Floats) -> float:
        region = Stretches.up_to(np.nan_to_num(limit))
        return overlap(B, region, region, measured.top).first

    whole = area(linear_limits(loop, B))
    if not whole > 0:
        return None
    changes = [
        LoopChange(code=code, percent=100 * (area(linear_limits(other, B)) / whole - 1))
        for code, other in _replaced(loop, device)
    ]
    together = area(linear_limits(device.loop, B)) / whole
    if (bent := _nonlinear(limits)) is not None:
        at = np.array([each.damping for each in limits])
        stiffness, linear = (area(np.interp(B, at, values, left=0.0, right=0.0)) for values in bent)
        if linear > 0:
            changes.append(LoopChange(code=_nonlinear_code(basis.loop), percent=100 * (stiffness / linear - 1)))
            together *= stiffness / linear
    return RegionCauses(changes=tuple(changes), together_percent=100 * (together - 1))


def _replaced(stated: Loop, device: IdentifiedLoop) -> Iterator[tuple[ChangeCode, Loop]]:
    """Yield the stated loop with one number or part replaced by that of the logs, for each that differs."""
    of_logs, period = device.loop, stated.sampling_period_s
    own_lag, lag = (loop.actuator_lag_s / period for loop in (of_logs, stated))
    numbers: tuple[tuple[ChangeCode, str, float, float], ...] = (
        ("delay", "delay_samples", stated.delay_samples + lag, own_lag),
        ("mass", "mass", stated.mass, 0.0),
        ("damping", "damping", stated.damping, 0.0),
        ("spring", "stiffness", stated.stiffness, 0.0),
    )
    changed: list[tuple[ChangeCode, dict[str, object]]] = []
    for code, name, value, offset in numbers:
        if name not in device.values or device.why_unknown(name):
            continue
        interval = device.interval(name)
        if holds(interval.low + offset, value, interval.high + offset):
            continue
        changes: dict[str, object] = {name: getattr(of_logs, name)}
        if code == "delay":  # logs show the sum of delay and lag
            changes |= {"actuator_lag_s": of_logs.actuator_lag_s, "jitter_samples": ()}
        changed.append((code, changes))
    changed += [("velocity_filter", {"velocity": of_logs.velocity})] if of_logs.velocity != stated.velocity else []
    changed += [("vibration_mode", {"mode": of_logs.mode})] if of_logs.mode != stated.mode else []
    for code, changes in changed:
        try:
            other = replace(stated, **changes)  # type: ignore[arg-type]
        except ParameterError:
            continue  # the number of the logs contradicts another part of the file
        yield code, other

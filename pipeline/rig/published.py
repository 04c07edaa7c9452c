"""Published conditions on the stiffness of a virtual wall, compared with the exact limit of stability."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.trials import Floats
from pipeline.surface.physical_loop import Loop
from pipeline.theory.boundary import quantum_limit
from pipeline.theory.passivity import passive_stiffness

if TYPE_CHECKING:  # loading it takes longer than computing the limits
    import pandas as pd

_ANGLES = 4000
"""Number of angles at which (4.6) is evaluated. Between the angles, the limit is at most 1e-7 lower."""


@dataclass(frozen=True)
class Condition:
    """Published condition with its source, guarantee and assumptions, and with its largest K for each damping B.

    The function ``stiffness`` receives the loop, the largest K that friction and sensor resolution of the device permit
    (NaN if unknown), and B.
    """

    name: str
    source: str
    promises: Literal["stability", "passivity"]
    assumes: str
    stiffness: Callable[[Loop, float, Floats], Floats]


def _late(loop: Loop) -> float:
    """Return the effective delay t_d + T/2 [s], which includes half a sample of the zero-order hold."""
    return (loop.delay_samples + 0.5) * loop.sampling_period_s


def _passive_damping(loop: Loop) -> float:
    """Return the damping of the device per unit of command.

    The result is nan if the position is sensed at the load of a mode, because no wall is passive then.
    """
    return np.nan if loop.mode and loop.mode.sensor == "load" else loop.passive_damping


def _minsky(loop: Loop, _: float, B: Floats) -> Floats:
    device = loop.apparent()
    return (device.damping + B) / _late(loop) - device.stiffness


def _linear(loop: Loop, _: float, B: Floats) -> Floats:
    return (loop.apparent().damping + B) / _late(loop)


def _gil(loop: Loop, by_friction: float, B: Floats) -> Floats:
    return _linear(loop.replace({"delay_samples": 0.0}), by_friction, B)


def _colgate(loop: Loop, _: float, B: Floats) -> Floats:
    return 2 * (_passive_damping(loop) - np.abs(B)) / loop.sampling_period_s


def _salcudean(loop: Loop, _: float, B: Floats) -> Floats:
    return Loop(loop.apparent().mass, 0.0, loop.sampling_period_s, 1.0).linear_limits(B)


def _abbott(loop: Loop, by_friction: float, B: Floats) -> Floats:
    return np.where(B == 0, np.minimum(2 * _passive_damping(loop) / loop.sampling_period_s, by_friction), np.nan)


def _hulin(loop: Loop, _: float, B: Floats) -> Floats:
    d, damping = loop.delay_samples, _passive_damping(loop)
    if d % 1 and damping >= 0:  # (4.6) requires an integer delay, but its sum over aliases does not
        unit = loop.units
        ideal = NormalisedLoop.ideal(0.0, damping / unit.damping, d)
        return passive_stiffness(ideal, ideal.delta, B / unit.damping) * unit.stiffness
    angle = np.linspace(0, np.pi / (d + 1), _ANGLES + 1)[1:]
    # (4.6), with its sums of cosines written as products: b >= K T sin((d + 1/2) w)/(2 sin(w/2)) - B cos((d + 1) w)
    room = np.append(1 / (d + 0.5), 2 * np.sin(angle / 2) / np.sin((d + 0.5) * angle)) / loop.sampling_period_s
    left = damping + np.outer(B, np.cos((d + 1) * np.append(0.0, angle)))
    return np.asarray((left * room).min(axis=1))


CONDITIONS = (
    Condition(
        "Minsky et al. 1990",
        "Minsky, Ouh-young, Steele, Brooks, Behensky: Feeling and seeing, Computer Graphics 24 (2)",
        "stability",
        "sampling modelled as a delay; slow motion; the stiffness of a hand is added to that of the wall",
        _minsky,
    ),
    Condition(
        "Colgate and Schenkel 1997",
        "Passivity of a class of sampled-data systems, J. Robotic Systems 14 (1); Hulin 2017, eq. 4.7",
        "passivity",
        "no delay, plain difference; any passive hand",
        _colgate,
    ),
    Condition(
        "Salcudean and Vlaar 1997",
        "On the emulation of stiff walls and static friction, ASME J. Dyn. Syst. Meas. Control 119 (1)",
        "stability",
        "mass only, no damping, one sample of delay; exact",
        _salcudean,
    ),
    Condition(
        "Gil et al. 2004",
        "Stability analysis of a 1 DOF haptic interface using the Routh-Hurwitz criterion, IEEE Trans. CST 12 (4)",
        "stability",
        "no delay, slow motion; a hand's damping helps, its stiffness does not matter",
        _gil,
    ),
    Condition(
        "Abbott and Okamura 2005, Diolaiti et al. 2006",
        "IEEE Trans. Robotics 21 (5) and 22 (2): K <= min(2 b/T, 2 f_c/quantum)",
        "passivity",
        "no virtual damping, no delay; Coulomb friction and quantum known",
        _abbott,
    ),
    Condition(
        "Hulin et al. 2006, linear",
        "Stability boundary for haptic rendering: influence of physical damping, IROS; Hulin 2017, eq. 3.25",
        "stability",
        "slow motion, any delay",
        _linear,
    ),
    Condition(
        "Hulin et al. 2014",
        "Passivity and stability boundaries for haptic systems with time delay, IEEE Trans. CST 22 (4); eq. 4.6",
        "passivity",
        "any delay (a fractional delay by the sum of 4.6 in docs/definitions.md), plain difference; any passive hand",
        _hulin,
    ),
)


def _without(loop: Loop) -> str:
    """Return a text that names the parts of a loop that no published condition includes, to follow the assumptions."""
    present = {
        "velocity filter": loop.velocity is not None,
        "actuator lag": loop.actuator_lag_s > 0,
        "vibration mode": loop.mode is not None,
        "jitter": "jitter" in loop.left_out,
    }
    names = [name for name, is_present in present.items() if is_present]
    return f"; without {', '.join(names)}" if names else ""


def _exact_assumes(loop: Loop) -> str:
    left_out = ["adaptive velocity filter" if name == "velocity" else name for name in loop.left_out]
    return f"the linear loop, without {', '.join(left_out)}" if left_out else "the whole loop"


def published_limits(
    loop: Loop, damping: object, *, coulomb: float | None = None, quantum: float | None = None
) -> pd.DataFrame:
    """Compute the largest stiffness according to published conditions, and the exact limit of stability.

    Parameters
    ----------
    loop : Loop
        Loop. The conditions use its mass, damping and stiffness per unit of command. Operator values are included if
        the condition includes a hand. Conditions of passivity exclude the damping of the load of a mode. Only the exact
        limit includes filter, lag and mode.
    damping : array of float
        Damping B of the wall [Ns/m, Nms/rad].
    coulomb, quantum : float, optional
        Coulomb friction f_c [N, Nm] and sensor resolution [m, rad] of the device, or 0 if unknown. The default values
        are taken from the loop.

    Returns
    -------
    pandas.DataFrame
        Columns ``condition``, ``promises`` (stability or passivity), ``assumes`` (with the parts of the loop that the
        condition neglects), ``source``, ``damping`` and ``stiffness`` [N/m, Nm/rad]. The stiffness is nan if a
        condition does not apply, and 0 if it permits no wall. The last rows contain the exact limit.

    Raises
    ------
    ParameterError
        If friction or resolution is negative or not finite.

    Examples
    --------
    >>> rig = Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=0)
    >>> table = published_limits(rig, [0.0], coulomb=1.0, quantum=1e-4).set_index("condition")["stiffness"]
    >>> float(table["Colgate and Schenkel 1997"]), float(table["Abbott and Okamura 2005, Diolaiti et al. 2006"])
    (8000.0, 8000.0)
    """
    import pandas as pd

    return pd.DataFrame(published_rows(loop, damping, coulomb=coulomb, quantum=quantum))


def published_rows(
    loop: Loop, damping: object, *, coulomb: float | None = None, quantum: float | None = None
) -> list[dict[str, Any]]:
    """Compute the rows of `published_limits`."""
    coulomb = loop.value("friction.coulomb") or 0.0 if coulomb is None else coulomb
    quantum = loop.sensor.quantum if quantum is None else quantum
    for name, value in (("coulomb", coulomb), ("quantum", quantum)):
        if not 0 <= value < np.inf:
            raise ParameterError(f"{name} = {value}: expected a finite nonnegative number.")
    B = np.atleast_1d(np.asarray(damping, dtype=np.float64))
    by_friction, without = quantum_limit(coulomb, quantum, loop.force_gain) if quantum > 0 else np.nan, _without(loop)
    rows: list[dict[str, Any]] = []
    exact = Condition("exact", "this package", "stability", _exact_assumes(loop), lambda *_: K)
    K = loop.linear_limits(B)
    for condition in (*CONDITIONS, exact):
        stiffness = np.maximum(condition.stiffness(loop, by_friction, B), 0.0)
        assumes = condition.assumes if condition is exact else condition.assumes + without
        words = {"promises": condition.promises, "assumes": assumes, "source": condition.source}
        walls = zip(B.tolist(), stiffness.tolist(), strict=True)
        rows += [{"condition": condition.name, **words, "damping": b, "stiffness": k} for b, k in walls]
    return rows

"""The table of parameters: every number of a `pipeline.device.loop.Loop`, with symbol, unit, bounds, label and meaning.

Keys of device files and of JSON documents, stored columns, units, labels and the order of a covariance are those of
`PARAMETERS`. To add a part to the loop: one row for each number here, a field of `Loop`, and its lines in
`pipeline.loop.state_space`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal, get_args

from pipeline.base.units import drive_unit

Motion = Literal[
    "translation",
    "rotation",
    "translation in V",
    "rotation in V",
    "translation in A",
    "rotation in A",
    "translation in counts",
    "rotation in counts",
    "translation in %",
    "rotation in %",
]
"""Type of motion of a device, and the unit of its commands if they are not forces or torques, but those of a drive with
unknown gain. Together they determine the units of all parameters, which are then per volt, ampere, count or percent.
"""

MOTIONS: tuple[Motion, ...] = get_args(Motion)


def is_rotation(motion: str) -> bool:
    """Return whether a device rotates, independent of the unit of its commands.

    >>> is_rotation("rotation in V"), is_rotation("translation")
    (True, False)
    """
    return motion.startswith("rotation")


def drive_of(motion: str) -> str:
    """Return the unit of the commands of a drive; empty if commands are forces or torques.

    >>> drive_of("rotation in V"), drive_of("rotation")
    ('V', '')
    """
    return motion.partition(" in ")[2]


Dimension = Literal[
    "mass", "damping", "stiffness", "force", "length", "velocity", "acceleration", "time", "frequency", "ratio"
]

UNITS: dict[Dimension, tuple[str, str]] = {
    "mass": ("kg", "kg m^2"),
    "damping": ("Ns/m", "Nms/rad"),
    "stiffness": ("N/m", "Nm/rad"),
    "force": ("N", "Nm"),
    "length": ("m", "rad"),
    "velocity": ("m/s", "rad/s"),
    "acceleration": ("m/s^2", "rad/s^2"),
    "time": ("s", "s"),
    "frequency": ("Hz", "Hz"),
    "ratio": ("", ""),
}
"""SI unit of each dimension for translation and rotation."""

_PER_COMMAND: dict[str, str] = {"mass": "s^2/{}", "damping": "s/{}", "stiffness": "/{}", "force": ""}
"""Suffix after the unit of a command in the unit of each dimension that contains a force."""


def unit_of(dimension: Dimension, motion: Motion) -> str:
    """Return the unit of a dimension for a kind of motion: SI, with the unit of a drive in place of N or Nm.

    >>> unit_of("mass", "rotation"), unit_of("mass", "translation in V"), unit_of("damping", "rotation in counts")
    ('kg m^2', 'Vs^2/m', 'counts s/rad')
    """
    rotational, drive = is_rotation(motion), drive_of(motion)
    if not drive or dimension not in _PER_COMMAND:
        return UNITS[dimension][rotational]
    return drive_unit(drive, _PER_COMMAND[dimension].format("rad" if rotational else "m"))


def unit_in(unit: str, motion: Motion) -> str:
    """Return the unit that replaces ``unit``, the SI unit for translation, for a kind of motion.

    >>> unit_in("N/m", "rotation"), unit_in("N/m", "translation in V"), unit_in("s", "rotation in V")
    ('Nm/rad', 'V/m', 's')
    """
    dimension = next((name for name, (linear, _) in UNITS.items() if linear == unit and linear), None)
    return unit if dimension is None else unit_of(dimension, motion)


POWERS: dict[Dimension, tuple[int, int]] = {
    "mass": (1, 0),
    "damping": (1, -1),
    "stiffness": (1, -2),
    "force": (1, -2),
    "length": (0, 0),
    "velocity": (0, -1),
    "acceleration": (0, -2),
    "time": (0, 1),
    "frequency": (0, -1),
    "ratio": (0, 0),
}
"""Powers of mass and time of each dimension. Quantities with a power of the mass are per unit of command at the wall;
in units of mass and sampling period these are the factors of Table 3.1 (Hulin 2017)."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a loop: its names, unit and bounds.

    Parameters
    ----------
    name : str
        Path in the record, in the ``[loop]`` table of a device file and in JSON, such as ``mode.frequency_hz``.
    symbol : str
        Symbol of the thesis, or of the docs if it has none.
    dimension : Dimension
        Determines the SI unit for translation and rotation (`UNITS`).
    label : str
        Short noun for tables and figures.
    meaning : str
        A sentence without a full stop.
    positive : bool
        Whether 0 is excluded.
    lower : float
        Smallest value; itself excluded where ``positive``.
    may_seem_negative : bool
        Whether an estimate may be negative: a device near an unstable equilibrium has a negative stiffness.
    unit_name : str
        Unit that replaces that of the dimension, such as ``samples`` for counts.
    """

    name: str
    symbol: str
    dimension: Dimension
    label: str
    meaning: str
    positive: bool = False
    lower: float = 0.0
    may_seem_negative: bool = False
    unit_name: str = ""

    @property
    def part(self) -> str:
        """Part of the loop that the number belongs to, such as ``mode``; empty for the loop's own."""
        return self.name.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Name within its part."""
        return self.name.rpartition(".")[2]

    def unit(self, motion: Motion) -> str:
        """Return the SI unit for a kind of motion.

        >>> PARAMETERS["damping"].unit("rotation"), PARAMETERS["delay_samples"].unit("translation")
        ('Nms/rad', 'samples')
        """
        return self.unit_name or unit_of(self.dimension, motion)

    def normalising_unit(self, mass: float, time: float) -> float:
        """Return mass^a time^b of the parameter's dimension, the divisor for units of mass and time.

        >>> PARAMETERS["stiffness"].normalising_unit(0.5, 1e-3)
        500000.0
        """
        of_mass, of_time = POWERS[self.dimension]
        unit = mass if of_mass else 1.0
        return unit * time**of_time if of_time >= 0 else unit / time**-of_time


def _rows() -> tuple[Parameter, ...]:
    velocity = "of the velocity filter"
    return (
        Parameter("mass", "m", "mass", "mass", "moving mass of the device, including a mode's load", positive=True),
        Parameter(
            "damping", "b", "damping", "damping", "viscous damping of the device, including that of a mode's load"
        ),
        Parameter("stiffness", "k", "stiffness", "stiffness", "spring to ground", may_seem_negative=True),
        Parameter("sampling_period_s", "T", "time", "sampling period", "time between two samples", positive=True),
        Parameter("delay_samples", "d", "ratio", "delay", "delay from command to force", unit_name="samples"),
        Parameter(
            "jitter_samples",
            "s_d",
            "ratio",
            "jitter",
            "standard deviation of the delay from command to command",
            unit_name="samples",
        ),
        Parameter("force_gain", "g", "ratio", "force gain", "force per unit of command", positive=True),
        Parameter("actuator_lag_s", "tau", "time", "actuator lag", "time constant of the actuator, of first order"),
        Parameter("velocity.cutoff_hz", "f_f", "frequency", "cut-off", f"cut-off frequency {velocity}", positive=True),
        Parameter("velocity.order", "n", "ratio", "order", f"order {velocity}", positive=True),
        Parameter("velocity.samples", "N", "ratio", "window", f"samples of the difference {velocity}", positive=True),
        Parameter(
            "velocity.acceleration", "a_f", "acceleration", "acceleration", f"acceleration {velocity}", positive=True
        ),
        Parameter("velocity.noise", "s_f", "length", "noise of the filter", f"sensor noise {velocity}", positive=True),
        Parameter(
            "velocity.bound", "e_f", "length", "bound", f"largest distance {velocity} from a line", positive=True
        ),
        Parameter("velocity.longest", "L", "ratio", "longest window", f"longest window {velocity}", positive=True),
        Parameter(
            "mode.frequency_hz",
            "f_v",
            "frequency",
            "mode frequency",
            "resonance of motor and load on their spring, both free",
            positive=True,
        ),
        Parameter("mode.damping_ratio", "zeta_v", "ratio", "mode damping ratio", "damping ratio of that resonance"),
        Parameter("mode.mass", "m_l", "mass", "load mass", "load, a part of the moving mass", positive=True),
        Parameter("mode.load_damping", "b_l", "damping", "load damping", "part of the damping that acts on the load"),
        Parameter("operator.mass", "m_h", "mass", "operator mass", "operator, attached to the motor", positive=True),
        Parameter("operator.damping", "b_h", "damping", "operator damping", "damping of the operator"),
        Parameter("operator.stiffness", "k_h", "stiffness", "operator stiffness", "stiffness of the operator"),
        Parameter("friction.coulomb", "f_c", "force", "Coulomb friction", "Coulomb friction on the motor side"),
        Parameter("friction.stiction", "f_s", "force", "stiction", "force that sets the resting motor in motion"),
        Parameter(
            "friction.stribeck_velocity",
            "v_s",
            "velocity",
            "Stribeck velocity",
            "speed at which friction has fallen from stiction to Coulomb friction",
            positive=True,
        ),
        Parameter(
            "constant_force",
            "f_0",
            "force",
            "constant force",
            "force on the motor in addition to the command, such as gravity",
            lower=-inf,
            may_seem_negative=True,
        ),
        Parameter("force_limit", "F_max", "force", "largest force", "command that is clipped beyond", positive=True),
        Parameter("sensor.quantum", "q", "length", "quantum", "step of the position sensor"),
        Parameter("sensor.noise", "s_x", "length", "noise", "standard deviation of the position sensor's noise"),
    )


PARAMETERS: dict[str, Parameter] = {parameter.name: parameter for parameter in _rows()}
"""All numbers of a loop by name, in the order of files, tables and covariances."""

ESTIMATE_PARAMETERS = {"friction": "friction.coulomb", "device_stiffness": "stiffness"}
"""Parameter of each name in ``estimates`` of a comparison's document that differs from the parameter's name."""

"""Find the parameters that logs cannot identify, with reasons, identifiable combinations, and recommended
recordings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.base.wording import counted
from pipeline.measured.identification.estimated import Numbers, Quantity
from pipeline.measured.identification.final_fit import Choice
from pipeline.measured.identification.intervals import Errors, Interval
from pipeline.measured.identification.recordings import Recording, median
from pipeline.records.trials import Floats

WIDE = 0.5
"""Largest half-width of the interval of an identifiable quantity, relative to its value. At this limit, the upper end
is three times the lower end."""

FEWEST_COUNTS = 10
"""Smallest motion of a device in the log with the largest motion, in sensor steps. Presliding alone may cause as
many."""

STILL_COUNTS, SPRING_LIKE = 3.0, 0.5
"""Largest motion of a device at rest, in sensor steps, and smallest correlation between position and command at which
the device follows the command like a spring. Friction without sliding acts like a spring."""

FEW_COUNTS = 100
"""Threshold for the number of sensor steps. Below it, the report states that a device without an identifiable mass
hardly moves."""

PER_MASS = {"damping", "stiffness", "mode.mass", "mode.load_damping", "friction.coulomb", "constant_force"}
"""Parameters that cannot be identified if the mass cannot be identified."""


@dataclass(frozen=True)
class IdentifiableCombination:
    """Combination of parameters that is identifiable although its members are not.

    Parameters
    ----------
    code : str
    members : tuple of str
        Names of the members, as in `PARAMETERS`.
    interval : Interval
        Value and 95 % interval in SI.
    unit : str
        Dimension in `parameters.UNITS`, or a unit.
    record : str
        Recommended recording that makes each member identifiable.
    """

    code: str
    members: tuple[str, ...]
    interval: Interval
    unit: str
    record: str


@dataclass(frozen=True)
class Recorded:
    """Content of recordings: numbers of command sizes in one direction, of command signs, of directions of motion, and
    of trials."""

    sizes: int
    signs: int
    directions: int
    trials: int

    @classmethod
    def of(cls, recordings: list[Recording]) -> Recorded:
        """Return the content of a set of recordings."""
        largest = max(float(np.abs(each.command).max()) for each in recordings) or 1.0
        usual = np.round([20 * median(each.command[len(each.command) // 4 :]) / largest for each in recordings])
        ways = {np.sign(each.position[-1] - each.position[0]) for each in recordings}
        turns = any(_turns(each.position) for each in recordings)
        several = any(len(np.unique(np.round(20 * each.command / largest))) > 2 for each in recordings)
        signs = {np.sign(level) for level in usual} - {0.0}
        sizes = max((len({level for level in usual if level * sign > 0}) for sign in signs), default=0)
        return cls(
            max(sizes, 2 if several else 0),
            2 if several else len(signs),
            2 if turns else len(ways - {0.0}),
            len(recordings),
        )

    def remedy(self) -> str:
        """Return the recommended recording that separates friction, a constant force and the mass."""
        if self.sizes < 2:
            return "steps of two sizes in one direction"
        if self.directions < 2 or self.signs < 2:
            return "the same steps in the other direction, or a step that reverses the motion"
        return f"more than {counted(self.trials, 'run')} of several sizes and directions"


def _turns(position: Floats) -> bool:
    """Return whether the position moves back and forth by at least a tenth of its range."""
    way = float(np.ptp(position))
    ahead = np.maximum.accumulate(position) - position
    behind = position - np.minimum.accumulate(position)
    return bool(way > 0 and min(ahead.max(), behind.max()) > 0.1 * way)


def is_identifiable(interval: Interval) -> bool:
    """Return whether an interval is narrow enough for its value to be meaningful."""
    return bool(np.isfinite(interval.error) and interval.high - interval.low < 2 * WIDE * abs(interval.value))


def largest_command(recordings: list[Recording]) -> float:
    """Return the largest absolute command of recordings [N, Nm]."""
    return max(float(np.abs(each.command).max()) for each in recordings)


def sensor_resolution(recordings: list[Recording]) -> float:
    """Return the coarsest position resolution of the recordings [m, rad], or 0 if none is visible."""
    return max(each.rounding for each in recordings) * float(np.sqrt(12.0))


def stuck(steps: float, command: float) -> str:
    """Return the reason why a device that moves by only a few sensor steps is not identifiable."""
    return (
        f"the device hardly moves: its position changes by {counted(round(steps), 'step')} of the sensor while the "
        f"command reaches {command:.3g}. Static friction larger than that command, or a stop, blocks it. Record larger "
        "commands"
    )


def _rests(each: Recording, resolution: float) -> bool:
    """Return whether the device rests in the last third of a log or follows its command like a spring."""
    last = each.position[-max(len(each.position) // 3, 1) :]
    if np.ptp(last) <= STILL_COUNTS * resolution:
        return True
    x, u = each.position - each.position.mean(), each.command - each.command.mean()
    return bool(x @ u > SPRING_LIKE * np.sqrt((x @ x) * (u @ u)))


def unidentifiable(parameters: dict[str, Interval], choice: Choice) -> set[str]:
    """Return the names of parameters whose interval is too wide for a meaningful value.

    The interval is too wide if it includes 0 (mass, frequency, force limit), exceeds the largest command (forces),
    spans several samples (delay), or includes a damping or a spring that would stop the device within a sample.
    """
    period, command = choice.units.period, choice.units.command
    mass = parameters["mass"]
    names = {"mass"} if not is_identifiable(mass) else set()
    if names:
        names |= PER_MASS & set(parameters)
    if "friction.coulomb" in parameters and choice.parts["friction"] <= 0:
        names.add("friction.coulomb")
    per_sample = abs(mass.value) / period
    widest = {
        "friction.coulomb": 2 * command,
        "constant_force": 2 * command,
        "delay_samples": max(2.0, parameters["delay_samples"].value if "delay_samples" in parameters else 0.0),
        "damping": per_sample,
        "mode.load_damping": per_sample,
        "stiffness": per_sample / period,
        "actuator_lag_s": max(
            2.0 * period, parameters["actuator_lag_s"].value if "actuator_lag_s" in parameters else 0.0
        ),
        "mode.damping_ratio": 1.0,
    }
    for name, most in widest.items():
        if name in parameters and not parameters[name].high - parameters[name].low <= most:
            names.add(name)
    names |= {
        name
        for name in ("mode.frequency_hz", "force_limit")
        if name in parameters and not is_identifiable(parameters[name])
    }
    if "mode.frequency_hz" in names:
        names |= {"mode.damping_ratio", "mode.mass", "mode.load_damping"} & set(parameters)
    return names


def reasons(
    names: set[str], choice: Choice, recordings: list[Recording], recorded: Recorded, *, slow_rows: bool, misfit: str
) -> dict[str, str]:
    """Return the reason why each given parameter is not identifiable, with the recommended recording.

    ``slow_rows`` states whether the command explains the motion without an inertia. ``misfit`` is the reason why no
    device explains the motion, or empty if a device explains it.
    """
    resolution = sensor_resolution(recordings)
    travel = max(float(np.ptp(each.position)) for each in recordings)
    command, period = choice.units.command, choice.units.period
    forces = f"Mass and force gain cannot be separated from these logs. Record {recorded.remedy()}."
    if travel < FEW_COUNTS * resolution and all(_rests(each, resolution) for each in recordings):
        forces = stuck(travel / resolution, command) + "."
    elif slow_rows:
        forces = (
            f"The sampling period ({period:.3g} s) is longer than the time constant of the device, so the inertia is "
            "not visible. Record at a higher sampling rate."
        )
    elif misfit:
        return dict.fromkeys(sorted(names), misfit)
    elif "asymmetry" in choice.fit.device.numbers and "mass" in names:
        forces = (
            "The gain of the drive differs by direction, so no single value per unit of command "
            "describes it. The mass for each direction is given instead."
        )
    elif "curvature" in choice.fit.device.numbers and "mass" in names:
        forces = (
            "The gain of the drive differs by the size of the command, so no single value per unit of command "
            "describes it. The masses for small and large commands are given instead."
        )
    result = dict.fromkeys(sorted(names), forces)
    wide = {
        "delay_samples": "The interval of the delay is wider than the delay. Record larger steps of the command, use a "
        "finer sensor, or sample faster.",
        "actuator_lag_s": "Actuator lag and delay cannot be separated from these logs. Record at a higher sampling "
        "rate.",
        "mode.frequency_hz": "The vibration hardly moves the position. Record larger steps, or use a finer sensor.",
        "force_limit": f"No command up to {command:.3g} reaches a force limit. Record larger commands.",
    }
    wide |= dict.fromkeys(("mode.damping_ratio", "mode.mass"), wide["mode.frequency_hz"])
    for name in names & wide.keys():
        if name == "mode.mass" and "mode.frequency_hz" not in names:
            continue
        result[name] = wide[name]
    if "mass" not in names:
        both = f"Friction and a constant force cannot be separated from these logs. Record {recorded.remedy()}."
        result |= dict.fromkeys(names & {"friction.coulomb", "constant_force"}, both)
        little = "The inertia hides damping and stiffness in these logs. Record longer motions at several speeds."
        result |= dict.fromkeys(names & {"damping", "stiffness", "mode.load_damping"}, little)
    return result


def combinations(choice: Choice, errors: Errors, recorded: Recorded, names: set[str]) -> list[IdentifiableCombination]:
    """Return identifiable combinations of parameters that are not individually identifiable."""
    units, numbers = choice.units, errors.numbers
    acceleration = units.position / units.period**2
    level = _usual_level(choice)
    found: list[IdentifiableCombination] = []

    def add(code: str, members: tuple[str, ...], quantity: Quantity, unit: str, record: str) -> None:
        interval = errors.interval(quantity)
        if is_identifiable(interval):
            found.append(IdentifiableCombination(code, members, interval, unit, record))

    if "mass" in names:
        remedy = recorded.remedy()

        def driven(n: Numbers) -> float:
            against = n.get("coulomb", 0.0) * np.sign(level)
            return float((n["gain"] * level - against + n.get("force", 0.0)) * acceleration)

        members = ("mass", *(("friction.coulomb",) if "coulomb" in numbers else ()), "constant_force")
        add("acceleration", members, driven, "acceleration", remedy)
        add("damping_per_mass", ("damping", "mass"), lambda n: n["delta"] / units.period, "1/s", remedy)
        if "gamma" in numbers:
            add("stiffness_per_mass", ("stiffness", "mass"), lambda n: n["gamma"] / units.period**2, "1/s^2", remedy)
    elif "friction.coulomb" in names and "force" in numbers:

        def against(n: Numbers) -> float:
            return float((n["coulomb"] - np.sign(level) * n["force"]) / n["gain"] * units.command)

        add("friction_less_force", ("friction.coulomb", "constant_force"), against, "force", recorded.remedy())
    if "delay_samples" in choice.bounds or ("delay_samples" in names and "lag" in numbers):
        add(
            "delay_and_lag",
            ("delay_samples", "actuator_lag_s"),
            lambda n: (n["delay"] + n.get("lag", 0.0)) * units.period,
            "s",
            "steps of the command at a higher sampling rate or with a finer sensor",
        )
    return found


def _usual_level(choice: Choice) -> float:
    """Return the signed median command of the segment in which it is largest, in units of `LogUnits`."""
    segments = choice.segments
    usual = np.array([median(segments.command[a:b]) for a, b in zip(segments.first, segments.behind, strict=True)])
    return float(usual[np.argmax(np.abs(usual))]) if len(usual) else 1.0

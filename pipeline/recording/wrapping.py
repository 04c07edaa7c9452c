"""Detect and unwrap angles that wrap around after a turn or another modulus of the encoder."""

from __future__ import annotations

import numpy as np

from pipeline.base.wording import counted
from pipeline.recording.samples import NORMAL_QUARTILE, THIRD_GAIN, Samples, middle
from pipeline.records.findings import Finding
from pipeline.records.trials import Floats, Integers

JUMP = 0.5
"""Smallest change per row, relative to the range of the position, that may be a wrap-around."""

SLOW = 0.4
"""Largest change per row apart from jumps, relative to the modulus, for which the direction of motion is
unambiguous."""

SMOOTH = 0.2
"""Largest difference between the changes on both sides of a jump, relative to the modulus, for a continuous motion."""

ALIKE = 0.05
"""Largest difference between the jumps of a log, after subtraction of the motion during the jumps, relative to the
modulus."""

SURE = 4.0
"""Largest difference between a standard and the estimated modulus, in standard errors, for which they count as
equal."""

UNSEEN = 1e-4
"""Relative error of a modulus that its jumps may not reveal."""

FEWEST_STEPS = 16
"""Smallest number of sensor steps in a modulus, because a sensor at rest between two values also jumps."""

MODULI = (2 * np.pi, np.pi, 4 * np.pi, 8 * np.pi, 25.0)
"""Moduli of common encoders [rad]: one turn, half a turn, several turns, and +-12.5 rad."""

SMALL_DOUBT = 3.0
"""Largest uncertainty, in reading errors, with which an estimated modulus is accepted if it is not a standard
modulus."""

LEAST_ROWS = 3
"""Smallest number of rows after the first jump that are needed to show that the motion continues."""

REMEDY = "To confirm this, set unwrap = true in [columns.position] of the profile."


def unwrapped(position: Floats, rule: bool | float | None = None) -> tuple[Floats, Finding | None]:
    """Return a position without its wrap-around jumps, and the finding that reports them.

    Parameters
    ----------
    position : float64, shape (rows,)
    rule : bool or float, optional
        A modulus in the unit of the position. False does not change the position. By default, jumps are detected.

    Notes
    -----
    A modulus is detected if three conditions are met. Every jump is from near one end of the range to near the other
    end. All jumps have the same size, apart from the motion during the jump. The motion is slow enough for its
    direction to be unambiguous. Uncertain jumps remain in the position (see `wrapped_position`).
    """
    if rule is False or len(position) < 2 * LEAST_ROWS:
        return position, None
    change, reach = position[1:] - position[:-1], float(position.max() - position.min())
    if rule is not None and rule is not True:
        turns = np.rint(change / rule)
        return _joined(position, turns, float(rule), np.flatnonzero(turns))
    jumps = np.flatnonzero(np.abs(change) > JUMP * reach)
    if not len(jumps) or reach == 0:
        return position, None
    found = _modulus(position, change, jumps)
    if found is None or not found[1]:
        return position, None
    return _joined(position, np.sign(change) * np.isin(np.arange(len(change)), jumps), found[0], jumps)


def _joined(position: Floats, turns: Floats, modulus: float, jumps: Integers) -> tuple[Floats, Finding | None]:
    if not len(jumps):
        return position, None
    joined = position.copy()
    joined[1:] -= modulus * np.cumsum(turns)
    name = "2 pi" if modulus == 2 * np.pi else f"{modulus:.8g}"
    return joined, Finding(
        code="wrapped_angle",
        first_row=int(jumps[0]) + 1,
        rows=len(jumps),
        evidence=f"The position wraps around at {name} in {counted(len(jumps), 'row')}, first in row "
        f"{jumps[0] + 1}. It was unwrapped.",
        remedy=REMEDY,
        severity="repaired",
    )


def _modulus(position: Floats, change: Floats, jumps: Integers) -> tuple[float, bool] | None:
    """Return the modulus that explains all jumps, with True if it is certain, or None if there is no such modulus."""
    is_jump = np.zeros(len(change), dtype=np.bool_)
    is_jump[jumps] = True
    others = np.flatnonzero(~is_jump)
    if jumps[0] + LEAST_ROWS > len(change) or len(others) < LEAST_ROWS:
        return None
    # motion during a jump, from the two nearest changes without a jump on each side
    place = np.searchsorted(others, jumps)
    near_by = [change[others[np.clip(place + offset, 0, len(others) - 1)]] for offset in (-2, -1, 0, 1)]
    before, behind = near_by[1], near_by[2]
    size = np.abs(change[jumps] - (4 * (before + behind) - near_by[0] - near_by[3]) / 6)
    modulus = middle(size)
    step = float(np.min(np.abs(change[change != 0])))
    if modulus < FEWEST_STEPS * step:
        return None
    doubt = middle(np.abs(size - modulus)) + SURE * float(size.std()) / np.sqrt(len(size))
    doubt += 2 * step if step > 1e-6 * modulus else UNSEEN * modulus
    known = [each for each in MODULI if abs(modulus - each) <= doubt]
    fastest = float(np.abs(change[others]).max())
    ends = np.minimum(position.max() - position, position - position.min())
    near = 1.5 * fastest + ALIKE * modulus
    at_ends = (ends[jumps] <= near).all() and (ends[jumps + 1] <= near).all()
    alike = (np.abs(size - modulus) <= ALIKE * modulus).all()
    smooth = (np.abs(behind - before) <= SMOOTH * modulus).all()
    inside = float(position.max() - position.min()) <= 1.02 * modulus + fastest
    if not (at_ends and alike and smooth and inside):
        return None
    # a single jump may be a noise peak, and a single row at the other end may be an outlier of any size
    if not known and len(jumps) == 1 and fastest > SLOW * modulus:
        return None
    if not known and len(jumps) > 1 and (np.diff(jumps) == 1).all():
        return None
    reading = step if step > 1e-6 * modulus else 0.0
    reading = max(reading, middle(np.abs(np.diff(change[others], 2))) / (NORMAL_QUARTILE * np.sqrt(THIRD_GAIN)))
    is_clear = len(known) == 1 or (not known and doubt <= SMALL_DOUBT * max(reading, UNSEEN * modulus))
    return (known[0] if known else modulus), is_clear and fastest <= SLOW * modulus


def wrapped_position(samples: Samples) -> Finding | None:
    """Return a finding if the position still wraps around because the modulus is uncertain or the motion is too
    fast."""
    if samples.fastest <= JUMP * samples.range:
        return None
    jumps = np.flatnonzero(samples.size > JUMP * samples.range)
    found = _modulus(samples.position, samples.change, jumps)
    if found is None:
        return None
    return samples.finding(
        "wrapped_angle",
        "unsafe",
        f"The position jumps by about {found[0]:.5g} in {counted(len(jumps), 'row')}, first in row "
        f"{jumps[0] + 1}, like an angle that wraps around.",
        "Set unwrap to the modulus in [columns.position] of the profile, or record at a higher rate.",
        first_row=int(jumps[0]) + 1,
        rows=len(jumps),
    )

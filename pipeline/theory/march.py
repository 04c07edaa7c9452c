"""Simulate (march) step responses for settling, overshoot and rise, one wall at a time, in loops compiled by numba.

A response is simulated exactly from sample to sample. Between samples, the motion is a polynomial over each piece of
the interval (`pipeline.theory.motion`), which is evaluated where the velocity changes sign. After some samples, the
poles bound the remaining motion, in three steps.

1. The poles are the roots of a polynomial in zeta = z - 1 and z, computed from the roots of a neighbouring wall
   (Ehrlich and Aberth). The eigenvectors follow from the adjugate. If roots coincide, eigenvectors of the whole matrix
   are inputs.
2. Mode m has the size c_m over a sampling interval (hull of its Bernstein coefficients) and the decay s_m. The
   deviation from sample k onward is at most sum_m c_m exp(-s_m k). If this sum is inside a band, the response stays
   inside.
3. The modes move the response to some samples before this time. It is then simulated to the end, which gives the last
   entry into the band. For the overshoot, it is simulated while the sum of the modes that can exceed the final position
   is larger than the peak.

Deviations are relative to the final displacement, and times are in samples. A response that needs more samples than the
limit ends with a status instead of a number. ``interval`` is the motion over a sampling interval
(`motion.interval_motion`). Own states are the states of the loop without the delayed forces (`motion.own_basis`). The
lever is a bound of the time [samples] for which the velocity of an own state acts on the position. ``walls`` contains
alpha and beta of the walls, and the constants of their loop: the output rows of sensed position and filtered velocity;
three rows for the largest effect of each own state on the position (a constant, a factor of the lever, and a factor of
a short lever); gamma, the shortest lever and the longest short lever; and the own states at sample 0. ``first``
contains the first three own states, which a march keeps in registers: sensed position, velocity and last sample.
``state`` has a row for each mode, at sample 0: its own states, and the wall forces of the last samples, newest first.
``view`` is computed by `outlook`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.compiled import compiled, inlined, part
from pipeline.records.trials import Floats

Complexes = NDArray[np.complex128]
Arrays = tuple[Any, ...]
"""Arrays of a loop, a wall or a result, in the order of the signatures below."""

Three = tuple[float, float, float]
Forces = tuple[float, float]
"""The older and the newer force that act in an interval."""

INTERVAL = "Tuple((f8[:,::1],f8[:,::1],f8[:,:,::1],f8[:,::1]))"
WALLS = "Tuple((f8[::1],f8[::1],Tuple((f8[:,::1],f8[:,::1],UniTuple(f8,3),f8[::1]))))"
MODAL = "Tuple((f8[::1],f8[:,::1],f8[:,:,::1],f8[:,::1],f8[:,::1],f8[:,::1]))"
RULE = "Tuple((f8[::1],b1,b1,i8,f8,f8))"

LAW, LEVERS, OWN, LINE, MOVED, CURVE, BEGUN, BEGUN_LINE, SETTLED, PEAK, CALM, START, FORCES, ENTRY = range(14)
"""Rows of the work array of a march. The rows from `ENTRY` onward contain the entries into the bands, and then the
view."""

MOVING, STILL, LATE = 0, 1, 2
"""Ends of a march. It ends at its last sample, at rest, or because its cost is above the cutoff."""

KNOWN, UNSETTLED, UNFINISHED, NO_MODES = 0, 1, 2, 4
"""Status of a response. It is complete, has no settling time, has no overshoot, or needs modes from eigenvectors."""

PATIENCE = 4
"""Ratio of the numbers of samples before modes are computed, without and with overshoot. For settling alone, most
responses are at rest or too late by then."""

TURN_STEPS = 5
"""Number of Newton steps to a turning point from a guess within a piece of at most one radian. Each step doubles the
number of digits."""

PASSING_STEPS, PASSING_SHARE = 55, 1e-13
"""Largest number of steps to a level crossing, by Newton's method or bisection, and size of the last step as a share of
a piece."""

ROOT_STEPS, FIRST_TURN, LAST_STEP = 30, 1e-5, 1e-9
"""Largest number of iterations to the poles (about two from the poles of a neighbour), relative rotation of the first
guesses, since real guesses would stay real, and relative change at which the iteration ends. The remaining error is the
third power of this change."""

ROUNDED = 1e-12
"""Tolerance for rounding of three numbers. They are the step of a pole relative to its distance from z = 1, the
imaginary part of a real pole, and the relative difference between the state at sample 0 and its modes."""

CANCELLED = 1e3
"""Threshold for the ratio of the sum of all mode sizes to the size of their sum. Above it, cancellation loses too many
digits. The rounding error grows with the square of this ratio."""

ROUNDED_SAMPLES = 64
"""Number of samples in which the rounding error of a pole rotates its mode by the initial tolerance of `agrees`."""

GONE = 1e-30
"""Pole of a motion that ends immediately."""

OUTWEIGHED = 0.99
"""Largest sum of all other modes, relative to a leading negative mode, for which the sign stays negative."""

WINDOW_SAMPLES, MAX_WINDOW_SAMPLES = 24, 1 << 22
"""Initial and largest number of samples that are simulated before the end of an envelope. An envelope may be far above
the motion. The window is also limited to an eighth of the square of the largest number of samples of a response."""

CLIMB_SAMPLES, MIN_JUMP_SAMPLES = 32, 2.0
"""Number of samples between two checks whether a response may exceed its peak, and smallest number of skipped
samples."""


@inlined
def seen_by(rows: Floats, r: int, z: Floats, first: Three) -> float:
    """Return the product of a row and the own states."""
    value: float = rows[r, 0] * first[0] + rows[r, 1] * first[1] + rows[r, 2] * first[2]
    for i in range(3, len(z)):
        value += rows[r, i] * z[i]
    return value


@inlined
def behind(rows: Floats, r: int, z: Floats, first: Three, forces: Forces) -> float:
    """Return the product of a row and the own states and forces."""
    acting: float = rows[r, len(z)] * forces[0] + rows[r, len(z) + 1] * forces[1]
    return seen_by(rows, r, z, first) + acting


@inlined
def delayed(line: Floats, at: int, force: float) -> tuple[Forces, int]:
    """Return the applied forces and the next index in the delay line.

    The new force replaces the oldest force in this line.
    """
    if not len(line):
        return (force, force), 0
    after = at + 1 if at + 1 < len(line) else 0
    forces = line[at], line[after] if len(line) > 1 else force
    line[at] = force
    return forces, after


@inlined
def advanced(step: Floats, z: Floats, moved: Floats, first: Three, forces: Forces) -> Three:
    """Return the first three own states at the next sample, and write the others to ``moved``."""
    for i in range(3, len(z)):
        moved[i] = behind(step, i, z, first, forces)
    return behind(step, 0, z, first, forces), behind(step, 1, z, first, forces), seen_by(step, 2, z, first)


@inlined
def begun_again(z: Floats, moved: Floats, first: Three) -> Three:
    """Replace the own states by the states of the next sample, and return the first three of them."""
    z[0], z[1], z[2] = first
    for i in range(3, len(z)):
        z[i] = moved[i]
    return first


@inlined
def copy(source: NDArray[Any], target: NDArray[Any]) -> None:
    """Copy the first numbers of an array."""
    for i in range(len(target)):
        target[i] = source[i]


@inlined
def begin(walls: Arrays, n: int, body: Arrays) -> None:
    """Set the feedback row and the lever row of wall n, and the own states and the delayed forces at sample 0."""
    alpha, beta, (outputs, effects, (gamma, least, short), start) = walls
    rows, z, line, _, _ = body
    lever = max(least, 2 * (alpha[n] + gamma) ** -0.5)
    for i in range(len(z)):
        rows[LAW, i] = -alpha[n] * outputs[0, i] - beta[n] * outputs[1, i]
        rows[LEVERS, i] = effects[0, i] + lever * effects[1, i] + min(lever, short) * effects[2, i]
    copy(start, z)
    for i in range(len(line)):
        line[i] = alpha[n]


@inlined
def body_of(rows: Floats, sizes: tuple[int, int], powers: int) -> Arrays:
    """Return the part of a work array that a march of a wall needs.

    It contains the work array with the feedback row and the lever row, own states ``z``, delayed forces ``line`` with
    that of sample k at k modulo the delay, and two work arrays.
    """
    own, delay = sizes
    return rows, rows[OWN, :own], rows[LINE, :delay], rows[MOVED, :own], rows[CURVE, :powers]


@inlined
def notes_of(rows: Floats, sizes: tuple[int, int], count: int) -> Arrays:
    """Return the records of a march in a work array.

    For each band, the last sample outside (``settled``), and the interval, piece and start of the last entry into the
    band (``entry``). ``peak`` contains the largest deviation of the motion between samples, and that of the samples.
    ``calm`` counts the samples for which all motion was small compared with the bands, and compared with bands and
    peak.
    """
    return rows[SETTLED, :count], rows[ENTRY : ENTRY + count, : 5 + sizes[0]], rows[PEAK, :2], rows[CALM, :2]


@inlined
def curve_of(curves: Floats, j: int, z: Floats, forces: Forces, curve: Floats) -> None:
    """Compute the coefficients of the position over a piece."""
    for c in range(len(curve)):
        curve[c] = curves[j, c, len(z)] * forces[0] + curves[j, c, len(z) + 1] * forces[1]
        for i in range(len(z)):
            curve[c] += curves[j, c, i] * z[i]


@inlined
def motion_at(curve: Floats, share: float) -> Three:
    """Return the value of a polynomial at a share of its piece, and its first and second derivatives."""
    value, slope, bend = 0.0, 0.0, 0.0
    for i in range(len(curve) - 1, -1, -1):
        bend = bend * share + 2 * slope
        slope = slope * share + value
        value = value * share + curve[i]
    return value, slope, bend


@inlined
def turn_of(curve: Floats) -> float:
    """Return the share of a piece at which the velocity is zero, or 1 if the motion does not turn."""
    end = motion_at(curve, 1.0)[1]
    if curve[1] * end >= 0:
        return 1.0
    share: float = curve[1] / (curve[1] - end)
    for _ in range(TURN_STEPS):
        _, slope, bend = motion_at(curve, share)
        share = min(max(share - slope / bend, 0.0), 1.0) if bend else share
    return share


@inlined
def passing(curve: Floats, level: float) -> float:
    """Return the share of a piece at which a motion passes a level after its turning point."""
    share, low, high = turn_of(curve), 0.0, 1.0
    for number in range(PASSING_STEPS):
        value, slope, _ = motion_at(curve, share)
        miss, before = value - level, share
        low, high = (share, high) if miss * level > 0 else (low, share)
        # the slope is zero at the turning point, so Newton's method cannot start there
        tangent = number and slope and low <= before - miss / slope <= high
        share = before - miss / slope if tangent else 0.5 * (low + high)
        if abs(share - before) <= PASSING_SHARE:
            break
    return share


@part
def extreme_of(curves: Floats, j: int, z: Floats, forces: Forces, curve: Floats) -> float:
    """Return the position at which the motion turns in a piece. Turns are rare, so this function is not inlined into a
    march."""
    curve_of(curves, j, z, forces, curve)
    return motion_at(curve, turn_of(curve))[0]


@part
def note_entry(entry: Floats, place: tuple[int, int, float], z: Floats, forces: Forces) -> None:
    """Record an entry into a band: interval, piece and level, and forces and own states at the start."""
    entry[0], entry[1], entry[2] = place
    entry[3], entry[4] = forces
    for i in range(len(z)):
        entry[5 + i] = z[i]


@part
def march(
    interval: Arrays, rows: Floats, sizes: tuple[int, int], span: tuple[int, int, int, int], requested: Arrays
) -> tuple[int, int]:
    """Simulate a response from one sample to another or until rest, and return the last sample and the kind of end.

    Parameters
    ----------
    interval : tuple
        Result of `interval_motion`.
    rows : float64
        Work array, see `body_of` and `notes_of`.
    sizes : tuple of int
        Number of own states, and delay.
    span : tuple of int
        First and last sample, first band to check, and the band after the last one to check.
    requested : tuple
        ``bands``, whether overshoot and motion between samples are requested, memory of the loop in samples, threshold
        of small motion as a share of a band or a peak, deviation that is not an overshoot, and cutoff, which is a
        settling time, or an overshoot if there are no bands.

    Notes
    -----
    At a single sample, all states of the device may be small while a delayed force or a filter stores future motion. A
    response is therefore at rest if all motion was small for as long as the memory of the loop.
    """
    step, ends, curves, timing = interval
    _, z, line, moved, curve = body_of(rows, sizes, curves.shape[1])
    bands, swings, between, memory, share, floor, cutoff = requested
    settled, entry, peak, calm = notes_of(rows, sizes, len(bands))
    first, (k, end, low, high) = (z[0], z[1], z[2]), span
    narrowest, widest = 1.0 / share, 0.0
    for b in range(low, high):
        narrowest, widest = min(narrowest, bands[b]), max(widest, bands[b])
    at, how, small = k % len(line) if len(line) else 0, MOVING, share * narrowest
    late = math.ceil(cutoff) if cutoff < end and not swings else end + 1
    ceiling = math.inf if len(bands) else cutoff
    # these numbers are kept in registers, and are written back to the arrays at the end
    highest, sampled, calm_of_bands, calm_of_all = peak[0], peak[1], calm[0], calm[1]
    place, speed, _ = first
    while k < end:
        forces, at = delayed(line, at, seen_by(rows, LAW, z, first))
        following, largest = advanced(step, z, moved, first, forces), 0.0
        for j in range(len(curves)):
            after, speed_after, _ = following
            if 2 * j < len(ends):
                after, speed_after = behind(ends, 2 * j, z, first, forces), behind(ends, 2 * j + 1, z, first, forces)
            extreme = 0.0
            if between and (speed > 0) != (speed_after > 0):
                reach = timing[1, j] * min(abs(speed), abs(speed_after))
                turns = (swings or low == high) and speed > 0 and max(place, after) + reach > max(sampled, floor)
                away = max(abs(place), abs(after)) + reach
                for b in range(low, high):
                    turns = turns or abs(after) <= bands[b] < away
                if turns:
                    extreme = extreme_of(curves, j, z, forces, curve)
                    highest = max(highest, extreme)
            for b in range(low, high):
                # another march may have found a later entry
                if abs(after) <= bands[b] < max(abs(place), abs(extreme)) and not k < entry[b, 0]:
                    side = extreme if abs(extreme) > bands[b] else place
                    note_entry(entry[b], (k, j, math.copysign(bands[b], side)), z, forces)
            place, speed = after, speed_after
            largest = max(largest, abs(place))
        first = begun_again(z, moved, following)
        k += 1
        sampled = max(sampled, place)
        for b in range(low, high):
            if abs(place) > bands[b]:
                settled[b] = k
        quiet = min(small, max(share * sampled, floor)) if swings else small
        if largest <= (small if low < high else quiet):
            size = 0.0
            for i in range(len(z)):
                size += abs(z[i]) * rows[LEVERS, i]
            largest = max(largest, size)
        calm_of_bands = calm_of_bands + 1 if largest <= small else 0.0
        calm_of_all = calm_of_all + 1 if largest <= quiet else 0.0
        if calm_of_all > memory:
            how = STILL
            break
        if (k >= late and abs(place) > widest > 0) or max(highest, sampled) > ceiling:
            how = LATE
            break
    peak[0], peak[1], calm[0], calm[1] = highest, sampled, calm_of_bands, calm_of_all
    return k, how


@inlined
def power_of(base: complex, exponent: int) -> complex:
    """Return an integer power."""
    result = 1 + 0j
    while exponent:
        if exponent & 1:
            result *= base
        base *= base
        exponent >>= 1
    return result


@inlined
def over(top: complex, bottom: complex) -> complex:
    """Return a ratio, or NaN if the denominator is 0."""
    return top * bottom.conjugate() * (1 / square(bottom))


@inlined
def square(number: complex) -> float:
    """Return the squared modulus of a number."""
    return number.real * number.real + number.imag * number.imag


@part
def roots(determinant: Floats, walls: Floats, wall: tuple[float, float], zeta: Floats, forces: Floats) -> bool:
    """Find zeta = z - 1 of all poles from guesses, in place (Ehrlich and Aberth), and return whether the method
    converged.

    ``determinant`` and ``walls`` are those of `modes.polynomials`, and ``forces`` is a work array.
    """
    delay = len(zeta) - len(forces) + 1
    for k in range(len(forces)):
        forces[k] = walls[0, k] * wall[0] + walls[1, k] * wall[1]
    for i in range(len(zeta)):
        zeta[i] *= 1 + FIRST_TURN * complex(i % 3 - 1.0, 1.0 + i % 2)
    for _ in range(ROOT_STEPS):
        moves = False
        for i in range(len(zeta)):
            place = zeta[i]
            top, top_slope, low, low_slope, others = 0j, 0j, 0j, 0j, 0j
            for k in range(len(forces) - 1, -1, -1):
                top_slope = top_slope * place + top
                top = top * place + determinant[k]
                low_slope = low_slope * place + low
                low = low * place + forces[k]
            for j in range(len(zeta)):
                away = place - zeta[j]
                if j != i:
                    others += over(1 + 0j, away)
            power = power_of(1 + place, delay)
            value = power * top + low
            slope = power * (top_slope + delay * over(top, 1 + place)) + low_slope
            change = over(value, slope - value * others)
            zeta[i] -= change
            moves = moves or not square(change) <= LAST_STEP**2 * square(place)
        if not moves:
            return True
    return False


@compiled("void(Tuple((f8[::1],f8[:,::1])),UniTuple(f8[::1],2),c16[::1],Tuple((c16[:,::1],b1[::1],f8[::1])))")
def poles_of_walls(polynomials: Arrays, walls: Arrays, first: Complexes, out: Arrays) -> None:
    """Compute z - 1 of all poles of each wall, and whether the search converged.

    Parameters
    ----------
    polynomials, walls : tuple
        Determinant and walls of `modes.polynomials`; alpha and beta.
    first : complex128, shape (states,)
        Poles of some wall, from which the first search starts.
    out : tuple
        The poles, shape (n, states), and whether they converged, shape (n,), as an output; and a work array.
    """
    zeta, known, forces = out
    last = -1
    for n in range(len(known)):
        copy(first if last < 0 else zeta[last], zeta[n])
        known[n] = roots(polynomials[0], polynomials[1], (walls[0][n], walls[1][n]), zeta[n], forces)
        last = n if known[n] else last


@inlined
def upper_half(zeta: Floats) -> int:
    """Move real poles and poles above the real axis to the front, and return their number.

    The result is 0 if the other poles are not their conjugates.
    """
    count, pairs = 0, 0
    for m in range(len(zeta)):
        place = zeta[m]
        if abs(place.imag) < ROUNDED:
            place = complex(place.real, 0.0)
        if place.imag >= 0:
            zeta[count] = place
            count, pairs = count + 1, pairs + (place.imag > 0)
    return count if count + pairs == len(zeta) else 0


@part
def shapes(modal: Arrays, wall: tuple[float, float], start: Floats, pole: Floats, state: Floats) -> None:
    """Compute the part of each mode in the states at sample 0, from right and left eigenvectors.

    ``pole`` contains the poles minus 1, which are replaced by the poles. A mode above the real axis includes the part
    of its conjugate. The eigenvectors are expressed by the own states and their gains G of the oldest force and of z
    times the newer one: right (adj G, D z^(delay - age)), left (law adj z^delay, law adj G z^(age - 1)). For the oldest
    force, only its own gain is used.
    """
    determinant, _, rows, columns, gains, _ = modal
    own, delay = rows.shape[2], len(start) - rows.shape[2]
    for m in range(len(pole)):
        zeta, one = pole[m], 1 + pole[m]
        top, begun, size, oldest, newer, older = 0j, 0j, 0j, 0j, 0j, 0j
        for k in range(own, -1, -1):
            top = top * zeta + determinant[k]
        for i in range(own):
            left, right = 0j, columns[own, i] + 0j
            for k in range(own - 1, -1, -1):
                left = left * zeta - wall[0] * rows[0, k, i] - wall[1] * rows[1, k, i]
                right = right * zeta + columns[k, i]
            size += left * right
            begun += left * start[i]
            oldest += gains[0, i] * left
            newer += gains[1, i] * left
            state[m, i] = right
        power, pushed = 1 + 0j, oldest + one * newer
        for j in range(delay - 1, -1, -1):  # power: one^(delay - 1 - j)
            state[m, own + j] = top * power
            if j:
                older += power * start[own + delay - 1 - j]
                power *= one
            else:
                size = size * one * power + top * power * ((delay - 1) * pushed + oldest)
                begun = begun * one * power + pushed * older + power * oldest * start[own + delay - 1]
        scale = over(begun, size) * (2 if zeta.imag > 0 else 1)
        for i in range(len(start)):
            state[m, i] *= scale
        pole[m] = one


@inlined
def are_complete(state: Floats, start: Floats) -> bool:
    """Return whether modes sum to the state at sample 0, and are small enough to avoid cancellation."""
    largest, off, sizes, size = 0.0, 0.0, 0.0, 0.0
    for i in range(len(start)):
        total, parts = 0.0, 0.0
        for m in range(len(state)):
            total += state[m, i].real
            parts += abs(state[m, i].real) + abs(state[m, i].imag)
        largest, off = max(largest, parts), max(off, abs(total - start[i]))
        size, sizes = size + abs(start[i]), sizes + parts
    return off <= ROUNDED * largest and sizes <= CANCELLED * size


@part
def outlook(rows: Floats, own: int, hull: Floats, pole: Floats, state: Floats, view: Floats) -> bool:
    """Compute the contribution of modes to the motion in the interval after sample 0, and return whether all modes
    decay.

    The columns of ``view`` are the decay per sample, the real part of the pole, the largest size, the distance below
    zero that the mode keeps (for a real positive pole), a power of the pole (two columns), and its imaginary part.
    """
    delay = state.shape[1] - own
    for m in range(len(state)):
        if abs(pole[m].imag) < ROUNDED:
            pole[m] = complex(pole[m].real, 0.0)
        view[m, 0] = -0.5 * math.log(max(square(pole[m]), GONE**2))
        view[m, 1], view[m, 6] = pole[m].real, pole[m].imag
        force, size, least = 0j, 0.0, math.inf
        for i in range(own):
            force += rows[LAW, i] * state[m, i]
        older = state[m, own + delay - 1] if delay else force
        newer = state[m, own + delay - 2] if delay > 1 else force
        for c in range(len(hull)):
            place = hull[c, own] * older + hull[c, own + 1] * newer
            for i in range(own):
                place += hull[c, i] * state[m, i]
            size, least = max(size, square(place)), min(least, -place.real)
        view[m, 2] = math.sqrt(size)
        view[m, 3] = max(least, 0.0) if pole[m].imag == 0 and pole[m].real > 0 else 0.0
        if not view[m, 0] > 0:
            return False
    return True


@inlined
def grow(view: Floats, sample: int) -> None:
    """Compute the powers of the poles."""
    for m in range(len(view)):
        power = power_of(complex(view[m, 1], view[m, 6]), sample)
        view[m, 4], view[m, 5] = power.real, power.imag


@inlined
def moved_to(sample: int, state: Floats, view: Floats, body: Arrays) -> None:
    """Set own states and delayed forces to their values at a sample, computed from the modes."""
    z, line = body[1], body[2]
    grow(view, sample)
    for i in range(state.shape[1]):
        value, age = 0.0, i - len(z) + 1
        for m in range(len(view)):
            value += state[m, i].real * view[m, 4] - state[m, i].imag * view[m, 5]
        if age > 0:
            line[(sample - age) % len(line)] = value
        else:
            z[i] = value


@inlined
def agrees(state: Floats, view: Floats, body: Arrays, sample: int, reproduced: float) -> bool:
    """Return whether a response agrees with its modes at a sample."""
    rows, z = body[0], body[1]
    off, size = 0.0, 0.0
    grow(view, sample)
    for i in range(len(z)):
        place = 0.0
        for m in range(len(view)):
            place += state[m, i].real * view[m, 4] - state[m, i].imag * view[m, 5]
        off += rows[LEVERS, i] * abs(place - z[i])
        size += rows[LEVERS, i] * abs(z[i])
    return off <= reproduced * (1 + sample / ROUNDED_SAMPLES) * size


@inlined
def envelope_end(view: Floats, band: float, sample: float) -> float:
    """Return a time after ``sample`` from which the sum of all mode sizes is inside the band.

    It is at most two samples too late.
    """
    time, slowest = sample, 0
    for m in range(len(view)):
        slowest = m if view[m, 0] < view[slowest, 0] else slowest
    if view[slowest, 2] > band:
        time = max(time, math.log(view[slowest, 2] / band) / view[slowest, 0])
    for _ in range(30):
        total, falls = 0.0, 0.0
        for m in range(len(view)):
            part = view[m, 2] * math.exp(-view[m, 0] * time)
            total += part
            falls += view[m, 0] * part
        # Newton's method on the logarithm, which is convex, approaches from below
        change = math.log(total / band) * total / falls if total > band else 0.0
        time += change
        if change <= 0.5:
            break
    return time + 1 if time > sample else time


@inlined
def outweighs(view: Floats, lead: int, sample: float) -> bool:
    """Return whether a negative mode exceeds the sum of all modes that may be positive during an interval."""
    others = 0.0
    for m in range(len(view)):
        if view[m, 3] == 0:
            others += view[m, 2] * math.exp(-view[m, 0] * sample)
    lasts: bool = others <= OUTWEIGHED * view[lead, 3] * math.exp(-view[lead, 0] * sample)
    return lasts


@inlined
def below_a_peak(view: Floats, peak: float, sample: float) -> float:
    """Return a number of samples in which envelopes keep the motion below a peak, or infinity if they always do.

    The number is at least half of the largest possible number. The envelopes keep the motion below a peak if all modes
    that may rise above the final position are smaller than the peak, or while a real negative mode exceeds them. The
    ratio of a sum of exponentials to one exponential is convex in time, so its present value and one later value
    suffice. Once the other modes are below the peak, the motion can no longer exceed it.
    """
    lead, largest, slowest, total = -1, -1.0, math.inf, 0.0
    for m in range(len(view)):
        size = view[m, 2] * math.exp(-view[m, 0] * sample)
        if view[m, 3] > 0:
            if size > largest:
                lead, largest = m, size
        elif size > 0:
            total += size
            slowest = min(slowest, view[m, 0])
    if total <= peak:
        return math.inf
    if lead < 0 or not outweighs(view, lead, sample):
        return 0.0
    span, free = math.log(total / peak) / slowest, 1.0
    while outweighs(view, lead, sample + free):
        if free >= span:
            return math.inf
        free *= 2
    return free / 2


@inlined
def settle(
    interval: Arrays, body: Arrays, notes: Arrays, ahead: Arrays, requested: Arrays, b: int, cutoff: float
) -> bool:
    """Simulate a response into a band before its end, which is known from modes, and return whether its entry was
    found.

    A response outside the band at the cutoff is not simulated. ``ahead`` contains ``state`` and ``view`` of its modes,
    a sample, and arguments of `climb`.
    """
    state, view, since, longest = ahead
    rows, z, line, _, _ = body
    settled, calm = notes
    last, window = math.ceil(envelope_end(view, requested[0][b], since)), WINDOW_SAMPLES
    if last > cutoff > since:
        moved_to(math.ceil(cutoff), state, view, body)
        if abs(z[0]) > requested[0][b]:
            return False
    while window < min(MAX_WINDOW_SAMPLES, longest * longest // 8):
        first = max(last - window, since)
        if first > since:
            moved_to(first, state, view, body)
        else:
            copy(rows[BEGUN], z)
            copy(rows[BEGUN_LINE], line)
        if abs(z[0]) > requested[0][b]:
            settled[b] = first
        calm[0] = calm[1] = 0.0
        march(interval, rows, (len(z), len(line)), (first, last, b, b + 1), requested)
        if settled[b] >= first or first <= since:
            return True
        last, window = first, 2 * window
    return False


@inlined
def climb(interval: Arrays, body: Arrays, notes: Arrays, ahead: Arrays, requested: Arrays) -> bool:
    """Simulate a response while it may exceed its peak, and return whether it can no longer exceed the peak.

    ``ahead`` is as in `settle`, with the number of samples to simulate.
    """
    state, view, k, longest = ahead
    rows, z, line, _, _ = body
    peak, calm = notes
    copy(rows[BEGUN], z)
    copy(rows[BEGUN_LINE], line)
    last = longest + k
    while k < last:
        free = below_a_peak(view, max(peak[1], requested[5]), k)
        if free == math.inf:
            return True
        if free >= MIN_JUMP_SAMPLES:
            k, last = k + int(free), last + int(free)
            moved_to(k, state, view, body)
        calm[0] = calm[1] = 0.0
        span = (k, min(k + CLIMB_SAMPLES, last), 0, 0)
        k, how = march(interval, rows, (len(z), len(line)), span, requested)
        if how != MOVING:
            return how == STILL
    return False


@compiled(
    f"void({INTERVAL},{MODAL},{WALLS},Tuple(({RULE},f8[::1],Tuple((i8,i8,f8)))),"
    "Tuple((c16[::1],c16[:,::1],c16[:,:,::1])),"
    "Tuple((f8[:,::1],i8[::1],f8[:,::1],c16[:,::1])))"
)
def step_costs(interval: Arrays, modal: Arrays, walls: Arrays, requested: Arrays, given: Arrays, out: Arrays) -> None:
    """Compute the settling times and overshoots of step responses.

    Parameters
    ----------
    interval : tuple
        Result of `interval_motion`.
    modal : tuple
        Result of `modes.modal`.
    walls : tuple
        Result of `_walls`.
    requested : tuple
        Settings of `march` without cutoff; cutoff of each wall; and the largest number of samples of a response, the
        number of samples before its modes are used, and the largest difference between a state and its modes, relative
        to its motion.
    given : tuple
        Poles of some wall minus 1, from which the first search starts. Poles and states of modes, shapes (n, modes) and
        (n, modes, states), if polynomials do not provide them. Otherwise, n = 0.
    out : tuple
        Costs, shape (n, 2 bands + 2), as an output: settling times and overshoot of the samples, then of the motion;
        status, shape (n,); the work array of
        `settling_overshoot`, and complex rows for guesses, poles and modes.
    """
    _, _, curves, timing = interval
    alpha, beta, (_, _, _, start) = walls
    common, cutoffs, (longest, looked, reproduced) = requested
    _, swings, between, memory, _, _ = common
    costs, status, rows, complexes = out
    later = common + (math.inf,)  # noqa: RUF005 (numba)
    own, count, states = len(start), costs.shape[1] // 2 - 1, complexes.shape[1]
    sizes = (own, states - own)
    body = body_of(rows, sizes, curves.shape[1])
    _, z, line, _, curve = body
    settled, entry, peak, calm = notes_of(rows, sizes, count)
    initial, forces, view = rows[START, :states], rows[FORCES, : own + 1], rows[ENTRY + count :]
    guess, former, pole, state = complexes[0], complexes[1], complexes[2], complexes[3:]
    copy(given[0], guess)
    copy(guess, former)
    for n in range(len(alpha)):
        wall, cutoff = (alpha[n], beta[n]), cutoffs[n]
        rule = common + (cutoff,)  # noqa: RUF005 (numba)
        begin(walls, n, body)
        for i in range(states):
            initial[i] = start[i] if i < own else alpha[n]
        for b in range(count):
            settled[b], entry[b, 0] = 0.0, math.nan
        peak[0] = peak[1] = calm[0] = calm[1] = 0.0
        status[n], known, fades, tried, modes, k, how = KNOWN, False, False, False, states, 0, MOVING
        first = looked if swings else PATIENCE * looked
        k, how = march(interval, rows, sizes, (k, min(first, longest), 0, count), rule)
        while how == MOVING:
            if not tried:
                if len(given[1]):
                    copy(given[1][n], pole)
                    for m in range(states):
                        copy(given[2][n, m], state[m])
                else:
                    status[n] = NO_MODES
                    copy(guess, pole)
                    if not (len(modal[0]) and roots(modal[0], modal[1], wall, pole, forces)):
                        break
                    for m in range(states):
                        guess[m], former[m] = 2 * pole[m] - former[m], pole[m]
                    modes = upper_half(pole)
                    shapes(modal, wall, initial, pole[:modes], state)
                tried = True
                fades = modes > 0 and are_complete(state[:modes], initial)
                if not fades and status[n] == NO_MODES:
                    break
                status[n], fades = KNOWN, fades and outlook(rows, own, modal[5], pole, state[:modes], view)
            known = fades and agrees(state[:modes], view[:modes], body, k, reproduced)
            if known or k >= longest:
                break
            k, how = march(interval, rows, sizes, (k, min(2 * k, longest), 0, count), rule)
        if known:
            copy(z, rows[BEGUN, :own])
            copy(line, rows[BEGUN_LINE, : len(line)])
        elif how == LATE or (how == MOVING and status[n] == KNOWN):
            status[n] = UNFINISHED if how == MOVING and calm[0] > memory else UNSETTLED | UNFINISHED
        ahead = (state[:modes], view[:modes], k, longest)
        for b in range(count):
            met = (
                settle(interval, body, (settled, calm), ahead, later, b, cutoff) if known else not status[n] & UNSETTLED
            )
            costs[n, b], costs[n, count + 1 + b] = settled[b] + 1 if met else math.nan, math.nan
            if between and met and entry[b, 0] >= 0:
                j = int(entry[b, 1])
                curve_of(curves, j, entry[b, 5:], (entry[b, 3], entry[b, 4]), curve)
                costs[n, count + 1 + b] = entry[b, 0] + timing[0, j] + passing(curve, entry[b, 2]) * timing[1, j]
        if known and swings and not climb(interval, body, (peak, calm), ahead, rule):
            status[n] |= UNFINISHED
        costs[n, count], costs[n, 2 * count + 1] = peak[1], max(peak[0], peak[1])


@compiled(f"void({INTERVAL},{WALLS},Tuple((f8[::1],i8,i8,f8)),Tuple((f8[::1],f8[:,::1],i8)))")
def late_deviations(interval: Arrays, walls: Arrays, requested: Arrays, out: Arrays) -> None:
    """Compute the largest deviation of each response from a given sample onward.

    ``requested`` contains these samples, shape (n,), the last sample, the memory of the loop, and a share of the
    largest deviation. A response ends when all motion has been below this share for the memory of the loop. ``out``
    contains the largest deviations, shape (n,), a work array, and the delay in samples.
    """
    step, _, curves, _ = interval
    since, longest, memory, share = requested
    largest, rows, delay = out
    body = body_of(rows, (len(walls[2][3]), delay), curves.shape[1])
    _, z, line, moved, _ = body
    for n in range(len(largest)):
        begin(walls, n, body)
        largest[n], k, calm, at, first = 0.0, 0, 0, 0, (z[0], z[1], z[2])
        while k < longest and calm <= memory:
            forces, at = delayed(line, at, seen_by(rows, LAW, z, first))
            first = begun_again(z, moved, advanced(step, z, moved, first, forces))
            k += 1
            place, size = abs(first[0]), 0.0
            for i in range(len(z)):
                size += rows[LEVERS, i] * abs(z[i])
            if k >= since[n]:
                largest[n] = max(largest[n], place)
            calm = calm + 1 if k >= since[n] and max(size, place) <= share * largest[n] else 0


@compiled(f"void({INTERVAL},{WALLS},Tuple((f8[::1],i8,b1)),Tuple((f8[:,:,::1],f8[:,::1],i8)))")
def rises(interval: Arrays, walls: Arrays, requested: Arrays, out: Arrays) -> None:
    """Compute the times at which each response first reaches levels below zero.

    ``requested`` contains the levels, the last sample, and whether the motion between samples is requested. ``out``
    contains the times of the motion and of linearly interpolated samples, shape (2, levels, n), a work array, and the
    delay in samples.
    """
    step, ends, curves, timing = interval
    levels, longest, between = requested
    time, rows, delay = out
    body = body_of(rows, (len(walls[2][3]), delay), curves.shape[1])
    _, z, line, moved, curve = body
    for n in range(time.shape[2]):
        begin(walls, n, body)
        k, left, at, first = 0, len(levels), 0, (z[0], z[1], z[2])
        for m in range(len(levels)):
            time[0, m, n] = time[1, m, n] = math.nan
        place, speed, _ = first
        while k < longest and left:
            forces, at = delayed(line, at, seen_by(rows, LAW, z, first))
            sampled, following = place, advanced(step, z, moved, first, forces)
            for j in range(len(curves)):
                after, speed_after, _ = following
                if 2 * j < len(ends):
                    after = behind(ends, 2 * j, z, first, forces)
                    speed_after = behind(ends, 2 * j + 1, z, first, forces)
                highest = max(place, after)
                if between and (highest >= levels[0] or speed > 0):
                    curve_of(curves, j, z, forces, curve)
                    if speed > 0 and not speed_after > 0:
                        highest = max(highest, motion_at(curve, turn_of(curve))[0])
                    for m in range(len(levels)):
                        if highest >= levels[m] and math.isnan(time[0, m, n]):
                            time[0, m, n] = k + timing[0, j] + passing(curve, levels[m]) * timing[1, j]
                place, speed = after, speed_after
            for m in range(len(levels)):
                if place >= levels[m] and math.isnan(time[1, m, n]):
                    time[1, m, n] = k + (levels[m] - sampled) / (place - sampled)
                    left -= 1
            first = begun_again(z, moved, following)
            k += 1

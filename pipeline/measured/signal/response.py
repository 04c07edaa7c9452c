"""Find the start of the step response in a log, and bound the motion after the end of the log.

The command edge is the edge of the external force, which is reconstructed from the log (`edge`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.base.compiled import compiled
from pipeline.base.errors import ParameterError
from pipeline.measured.signal.edge import NO_ROW as NO_ROW
from pipeline.measured.signal.edge import external_force as external_force
from pipeline.measured.signal.edge import find_edge, level_before
from pipeline.measured.signal.sensor import position_quantum, sensor_floor, white_noise
from pipeline.records.criteria import RISE_LEVELS
from pipeline.records.trials import Floats, Trial


@dataclass(frozen=True)
class RestPositions:
    """Stored part of a `Response`, which is enough to measure the motion at rest.

    Parameters
    ----------
    edge_row : int
        Row of the command edge, or `NO_ROW`.
    position_start, position_final_expected : float
        Rest positions before and after the step [m or rad].
    floor : float
        Smallest visible motion [m or rad].
    """

    edge_row: int
    position_start: float
    position_final_expected: float
    floor: float


@dataclass(frozen=True)
class Response:
    """Edge, rest positions and resolution of a trial. Values are NaN if a reason is given.

    Parameters
    ----------
    edge_row : int
        Row of the command edge k0, counted from 0, or -1 if there is none.
    level : float
        External force before the step [N, Nm]. It is 0 unless the step starts from an operating point.
    steps : int
        Number of jumps of the external force between levels. A log with several jumps has no edge, regardless of its
        metadata.
    position_start : float
        First position, at which the wall force is zero [m, rad].
    position_final_expected : float
        x_0 + F_0/K (6.1) [m, rad], or NaN if K <= 0 or there is no step.
    position_final_measured : float
        Mean over the last tenth of the log [m, rad].
    sensor_quantum : float
        Step of the grid on which all positions lie [m, rad], or 0 if there is no grid, or for an integrated velocity.
    sensor_noise : float
        Standard deviation of the white noise of the positions before the edge [m, rad], or NaN without a baseline.
    floor : float
        Position amplitude that quantum and noise can cause [m, rad], or 0 for an ideal log.
    baseline_motion : float
        Peak-to-peak motion before the step if the sensor cannot cause it [m, rad], otherwise 0.
    reason : str
        Reason for missing values. It is empty if no value is missing.
    edge_reason : str
        Reason why there is no command edge. It is empty if there is one.
    """

    edge_row: int
    level: float
    steps: int
    position_start: float
    position_final_expected: float
    position_final_measured: float
    sensor_quantum: float
    sensor_noise: float
    floor: float
    baseline_motion: float
    reason: str
    edge_reason: str

    @property
    def has_edge(self) -> bool:
        """Whether there is a command edge."""
        return self.edge_row >= 0


def find_response(trial: Trial) -> Response:
    """Find the command edge and the resolution of a trial.

    Parameters
    ----------
    trial : Trial

    Returns
    -------
    Response

    Notes
    -----
    Level and edge are from `edge.find_edge`. The external force is exact for a controller that uses the plain
    difference of positions. With a velocity filter or a force limit, it is wrong once the device moves, but not before.
    The edge is therefore correct for any delay of at least one sample.

    A command with a wrong sign or size, or another signal, has no edge. The wall force alone would also cross half the
    step, but later. Such a log is detected in two ways: the command has not reached half the step by then (chatter
    may be larger, with either sign), or the force first stays beyond half the step on the other side.

    The noise is estimated from the second differences of the baseline, var = 6 sigma^2 for white noise. A device that
    chatters before the step (at high B, one quantum commands newtons) hardly contributes to them if its period is long.
    Chatter with an amplitude a and a period of p samples adds a variance of (2 pi/p)^4 a^2/12, i.e. 1 % of a for p = 35
    and 5 % for p = 16. Faster chatter is treated as noise. With quantisation only, the baseline is constant, and the
    noise is exactly 0.

    Source: Hulin 2017, sec. 6.1.1 (procedure) and eq. 6.1 (final position).
    """
    edge = find_edge(trial)
    quantum = 0.0 if trial.integrated else position_quantum(trial.position)
    noise, floor, motion = _baseline(trial, quantum, edge.row)
    start = float(trial.position[0])
    stepped = trial.stiffness > 0 and trial.step != 0
    return Response(
        edge_row=edge.row,
        level=edge.level,
        steps=edge.steps,
        position_start=start,
        position_final_expected=start + trial.step / trial.stiffness if stepped else np.nan,
        position_final_measured=float(trial.position[-max(trial.rows // 10, 1) :].mean()),
        sensor_quantum=quantum,
        sensor_noise=noise,
        floor=floor,
        baseline_motion=motion,
        reason="; ".join(text for text in (edge.reason, _no_final(trial.stiffness)) if text),
        edge_reason=edge.reason,
    )


def declare_edge(trial: Trial, response: Response, edge_row: int) -> Response:
    """Return the response with the command edge that the metadata of the trial declare.

    Parameters
    ----------
    trial : Trial
    response : Response
    edge_row : int
        Row in which the command first contains the step, counted from 0. It replaces the detected edge, and the rows
        before it are the baseline. With row 0, the log has no baseline, so its noise is unknown. The response is
        returned unchanged for -1, or for several steps.

    Returns
    -------
    Response

    Raises
    ------
    ParameterError
        If the row is outside the log.
    """
    if edge_row == NO_ROW or response.steps > 1:
        return response
    if not 0 <= edge_row < trial.rows:
        raise ParameterError(
            f"declared command edge of trial {trial.trial_id!r}: row {edge_row}; expected 0 to {trial.rows - 1}. "
            "Correct the declared row."
        )
    noise, floor, motion = _baseline(trial, response.sensor_quantum, edge_row)
    return replace(
        response,
        edge_row=edge_row,
        level=level_before(external_force(trial), edge_row, trial.step),
        sensor_noise=noise,
        floor=floor,
        baseline_motion=motion,
        reason=_no_final(trial.stiffness),
        edge_reason="",
    )


def _no_final(stiffness: float) -> str:
    return "" if stiffness > 0 else f"no final position: x_0 + F_0/K needs K > 0, found K = {stiffness:g}"


def _baseline(trial: Trial, quantum: float, edge: int) -> tuple[float, float, float]:
    """Return noise, sensor floor and motion from the rows before the edge [m, rad]."""
    baseline = trial.position[: max(edge, 0)]
    noise = white_noise(baseline)
    floor = sensor_floor(quantum, noise)
    # rounding errors of the displacement may be smaller than those of the positions
    moved = baseline - trial.position[:1]
    spread = float(moved.max(initial=0.0) - moved.min(initial=0.0))
    return noise, floor, spread if spread > floor else 0.0


SETTLED_SAMPLES = 5
"""Smallest number of samples in a band at the end of a log. Fewer samples may be a mere passage through the band."""


def reach(trial: Trial, final: float, first: int, entry: int, growth: float, noise: float) -> tuple[float, float]:
    """Return the largest distance of the later motion from its final position, and its error [m, rad].

    Parameters
    ----------
    trial : Trial
    final : float
        Position about which the response oscillates [m, rad].
    first, entry : int
        Row in which the response begins, and row from which it is inside the required band.
    growth : float
        Growth rate of the slowest mode per sample, or NaN if unknown.
    noise : float
        Standard error of a late reading [m, rad].

    Notes
    -----
    An oscillation of angular frequency w with deviation e and velocity v reaches at most hypot(e, v/w). The longest
    time on one side of the final position is half a period of the slowest oscillation. If the motion never crossed the
    final position, the rise time is used instead. It is 2.2 time constants of a creep, or at least 1.5 radians of a
    heavily damped oscillation. On the inward side, the oscillation decays for another quarter of a period. The last
    half radian of the log is used if it is inside the band. A motion that does not grow is also bounded by its last
    full oscillation.
    """
    first = min(first, trial.rows - 1)
    error = trial.position[first:] - final
    return _reach(error, entry - first, growth, noise, *RISE_LEVELS)


@compiled("UniTuple(f8, 2)(f8[::1], i8, f8, f8, f8, f8)")
def _reach(e: Floats, entry: int, growth: float, noise: float, low: float, high: float) -> tuple[float, float]:
    """Return the largest deviation after the end of a motion, and its error [m, rad], as in `reach`.

    The time r of one radian of the slowest oscillation is 1/pi of the longest time between two zero crossings, or
    follows from the rise time. With the change over a span s of half that time, v/w = (e_k - e_{k-s}) r/s, and an
    oscillation reaches

        hypot(e, v/w)    outwards,        max(|e|, exp(growth pi r/2) hypot(e, v/w))    inwards.

    Parameters
    ----------
    e : float64, shape (rows,)
        Distance from the final position from the first row of the response [m, rad].
    entry : int
        Row from which the motion is inside the band.
    growth, noise : float
        As in `reach`.
    low, high : float
        Fractions of the displacement between which the rise time is measured.
    """
    n = len(e)
    side, last, longest, passes = 0.0, 0, 0, False
    size, farthest, quarter = 0.0, -1.0, 0
    for k in range(n):
        size = max(size, abs(e[k]))
        now = np.sign(e[k]) if abs(e[k]) > 4 * noise else side
        if now * side < 0:
            passes, longest, last = True, max(longest, k - last), k
            farthest = -1.0
        if abs(e[k]) > farthest:  # a quarter of the unfinished period ends at its farthest reading
            farthest, quarter = abs(e[k]), k - last
        side = now
    if passes:
        radian = max(longest, 2 * quarter) / np.pi
    else:
        begin = end = -1
        for k in range(n):
            share = abs(e[k]) / max(size, 2.2250738585072014e-308)
            begin = k if begin < 0 and share <= 1 - low else begin
            end = k if end < 0 and share <= 1 - high else end
        radian = max(end - max(begin, 0), 0) / np.log(9.0)  # the rise time is ln 9 time constants of a creep
    falls = 0.0 if np.isnan(growth) else min(growth, 0.0)
    # damping slows an oscillation down, but the bound is for the undamped oscillation
    radian = max(radian / np.hypot(1.0, radian * falls), 1.0)
    span = int(min(max(np.rint(radian / 2), 1.0), max(n - 1, 1)))
    decay = np.exp(falls * 0.5 * np.pi * radian)
    far = -1.0
    for k in range(max(n - span, entry, 0), n):
        way = (e[k] - e[max(k - span, 0)]) * (radian / span)
        swing = np.hypot(e[k], way)
        if way * e[k] < 0:
            swing = max(abs(e[k]), decay * swing)
        far = max(far, swing)
    whole = n - int(np.ceil(min(2 * np.pi * radian, n + 1.0)))
    if whole >= 0 and not growth > 0:
        widest = 0.0
        for k in range(whole, n):
            widest = max(widest, abs(e[k]))
        far = min(far, widest)
    return far if entry < n else np.inf, noise * np.hypot(1.0, np.sqrt(2.0) * radian / span)

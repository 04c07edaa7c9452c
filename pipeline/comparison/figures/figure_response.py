"""The response behind the figure of the first step response: which trial, its delay bracket, its oscillation period."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.comparison.scene.scene import SceneData
from pipeline.measured.signal.response import find_response
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.measured.thesis import first_change
from pipeline.records.batch import Booleans, Floats
from pipeline.records.figure_records import Figure, Response
from pipeline.records.models import Motion
from pipeline.rendering.labels import UNITS, damping_text, decimal, stiffness_text
from pipeline.store.samples import load_groups

LONGEST_SHOWN = 1 << 14
"""Rows after the command edge that are shown, 16 s at 1 kHz: among more the motion could not be seen."""

CANDIDATES = 8
"""Trials that are looked at: at the lowest stiffness a log may end before its second maximum, eight times that
stiffness has a period a third as long."""
CLEAR = 0.05
"""Height of a maximum above the final position, relative to F_0/K, that counts: a sensor's steps make lower ones."""


def response_figures(data: SceneData, motion: Motion) -> tuple[Figure[Response], ...]:
    """Return the figure of the first response of the first experiment that has one; none where no trial shows a step.

    The lowest stiffness whose log shows two maxima is taken, at its lowest stable damping; where no log does, the
    lowest stiffness of all, without a period. Experiments without operator come first.

    Source: Hulin 2017, Fig. 6.2.
    """
    grips = {stages.experiment: set(stages.trials.column("grip").to_pylist()) for stages in data.experiments}
    for stages in sorted(data.experiments, key=lambda stages: grips[stages.experiment] != {"none"}):
        figure = _figure(stages, motion)
        if figure is not None:
            return (figure,)
    return ()


def _figure(stages: ExperimentStages, motion: Motion) -> Figure[Response] | None:
    k, b = stages.column("response", "stiffness"), stages.column("response", "damping")
    chosen = softest(k, b, stages.verdicts.verdict == "stable")
    if not len(chosen):
        return None
    names = stages.texts("response", "trial_id")
    wanted = pa.array([names[i] for i in chosen])
    kept = stages.trials.filter(pc.is_in(stages.trials.column("trial_id"), value_set=wanted))
    samples = load_groups(stages.processed, kept)
    shown = None
    for place in np.argsort(samples.of_trials("stiffness"), kind="stable").tolist():
        batch = next(one for _, one in samples.pick(np.array([place])))
        response = find_response(batch)
        delays = first_change(batch, response)
        if delays.first_row[0] < 0:
            continue
        edge = int(response.edge_row[0])
        rows = min(int(batch.rows[0]), edge + LONGEST_SHOWN)
        period = oscillation_period(
            batch.time[0, edge:rows] - batch.time[0, edge],
            batch.displacement[0, edge:rows],
            float(batch.step[0] / batch.stiffness[0]),
        )
        if shown is None or period is not None:
            shown = (batch, edge, rows, int(delays.first_row[0]) - edge, period)
        if period is not None:
            break
    if shown is None:
        return None
    batch, edge, rows, observed, period = shown
    stiffness, damping = float(batch.stiffness[0]), float(batch.damping[0])
    sampling_period_s = float(batch.sampling_period_s[0])
    units = UNITS[motion]
    words = [
        f"Trial {batch.trial_id[0]} of experiment {stages.experiment}: K = {stiffness_text(stiffness)} "
        f"{units.stiffness}, B = {damping_text(damping)} {units.damping}."
    ]
    if period is not None:
        words.append(f"The oscillation period is {decimal(1e3 * (period[1] - period[0]), 0)} ms.")
    words.append(
        f"Right, the beginning: the position first changes at t_obs = {decimal(1e3 * observed * sampling_period_s, 3)} "
        "ms, so that the delay lies in the shaded sampling period (6.3). In the manner of Fig. 6.2."
    )
    data = Response(
        batch.time[0, :rows] - batch.time[0, edge],
        batch.displacement[0, :rows],
        batch.command[0, :rows],
        sampling_period_s,
        observed,
        float(batch.step[0] / batch.stiffness[0]),
        period,
    )
    return Figure("response", "first-response", "Step response", " ".join(words), (data,))


def softest(stiffness: Floats, damping: Floats, stable: Booleans) -> np.ndarray:
    """Return the stable trials at the lowest stiffnesses above zero, each at its lowest damping, `CANDIDATES` at most.

    Parameters
    ----------
    stiffness, damping : float64, shape (n,)
    stable : bool, shape (n,)

    Returns
    -------
    int64, shape (m,)
        Indices, softest first.
    """
    usable = np.flatnonzero(stable & (stiffness > 0))
    order = usable[np.lexsort((damping[usable], stiffness[usable]))]
    first = np.diff(stiffness[order], prepend=-np.inf) > 0
    return order[first][:CANDIDATES]


def oscillation_period(time: Floats, displacement: Floats, final: float) -> tuple[float, float] | None:
    """Return the times of the first two maxima of a step response, or None where it does not show two.

    Parameters
    ----------
    time, displacement : float64, shape (n,)
        From the command edge on.
    final : float
        Displacement at rest, not zero.

    Notes
    -----
    A maximum is the middle of the highest samples between two crossings of the final position, and only a stretch above
    it that begins and ends counts.
    """
    relative = displacement / final
    above = np.concatenate([[False], relative > 1, [False]])
    change = np.flatnonzero(np.diff(above.astype(np.int8)))
    starts, ends = change[::2], change[1::2]
    inside = ends < len(relative)  # a stretch that the log cuts off may still rise
    maxima = []
    for start, end in zip(starts[inside].tolist(), ends[inside].tolist(), strict=True):
        lobe = relative[start:end]
        if lobe.max() >= 1 + CLEAR:
            top = np.flatnonzero(lobe == lobe.max())
            maxima.append(float(time[start + top].mean()))
    return (maxima[0], maxima[1]) if len(maxima) > 1 else None

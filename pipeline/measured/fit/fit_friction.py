"""The fit of a window with Coulomb friction beside a jitter: what else may have moved the force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.measured.fit.fit_filter import DELAY, GAIN, predict
from pipeline.measured.fit.fit_noise import over_rows
from pipeline.measured.fit.fit_search import gains_at, inverse, limited, predicted
from pipeline.measured.fit.fit_window import Window
from pipeline.records.batch import Floats

ROUNDS = 4
"""Steps of the search: it begins at the parameters with jitter, and friction moves them by some percent."""

LEAST_GAIN = 0.1
"""Fall of the deviance below which a step is the last: what decides is 8."""


def with_friction(window: Window, parameters: Floats, jitter: Floats) -> tuple[Window, Floats]:
    """Return the window whose force is less the friction that explains the readings best, and the parameters then.

    Parameters
    ----------
    window : Window
    parameters : float64, shape (P, n)
        To begin with.
    jitter : float64, shape (n,)
        Standard deviation of the delay that errors are weighted by [samples].

    Notes
    -----
    The direction of the motion is read from the log, so that friction is a known force of unknown size. It acts at
    once: as part of the command it is put earlier by the delay.
    """
    p, friction = parameters.copy(), np.zeros(parameters.shape[1])
    going = np.ones(len(friction), dtype=np.bool_)
    for _ in range(ROUNDS):
        part = window.select(going)
        p[:, going], friction[going], gain = _step(part, p[:, going], friction[going], jitter[going])
        going[going] = gain > LEAST_GAIN
        if not going.any():
            break
    return replace(window, force=window.force - friction * _direction(window, p[DELAY])), p


def _step(window: Window, p: Floats, friction: Floats, jitter: Floats) -> tuple[Floats, Floats, Floats]:
    """Return parameters and friction after a step of Gauss and Newton, and the fall of the deviance it promises."""
    against = _direction(window, p[DELAY])
    found = replace(window, force=window.force - friction * against)
    # friction does not jitter
    gains = gains_at(window, p, jitter)
    run = predicted(found, p, gains, jitter)
    alone = predict(np.zeros_like(found.position), against, gains, p)
    # the answer to the force is its derivative by the gain, times the gain; friction takes it away
    columns = np.concatenate([run[:, 1:], -p[GAIN] * alone[:, None, 1 + GAIN]], axis=1)
    normal = np.moveaxis(over_rows("kin,kjn->ijn", columns, columns), -1, 0)
    slope = over_rows("kin,kn->in", columns, run[:, 0])
    step = np.einsum("nij,nj->in", inverse(normal), slope.T)
    return limited(p, step[:-1], np.zeros(len(friction))), friction + step[-1], (step * slope).sum(axis=0)


def _direction(window: Window, delay: Floats) -> Floats:
    """Sign of the motion at the rows at which a command would have to be given to act then, shape (N, n)."""
    rows = np.arange(len(window.position))[:, None]
    # behind the last row of a trial there is padding, which says nothing
    known = window.inside & np.append(window.inside[1:], np.zeros_like(window.inside[:1]), axis=0)
    sign = np.sign(np.diff(window.position, axis=0, append=window.position[-1:])) * known
    # while no motion is seen, the device moves as it will be seen to
    following = np.where(sign != 0, rows, len(rows) - 1)
    following = np.minimum.accumulate(following[::-1], axis=0)[::-1]
    sign = np.take_along_axis(sign, following, axis=0)
    late = np.round(np.maximum(delay, 0.0)).astype(np.int64)
    there = np.minimum(rows + late, len(rows) - 1)
    result: Floats = np.where(rows >= window.edge, np.take_along_axis(sign, there, axis=0), 0.0)
    return result

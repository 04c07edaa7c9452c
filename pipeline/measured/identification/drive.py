"""Static model of a drive with a force limit and a gain that depends on the direction and the size of the command."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.records.trials import Floats

DRIVE = ("limit", "asymmetry", "curvature")
"""Parameters of a drive: the largest command, the asymmetry and the curvature. The asymmetry is half the difference
between the gains of positive and negative commands, divided by their mean. The curvature is the share of the force that
is missing at the largest command of the logs."""


def applied_command(command: Floats, numbers: Mapping[str, float]) -> Floats:
    """Return the applied command and its derivatives along the parameters of `DRIVE`, shape (4, R).

    The command u is clipped to the limit, and (u + a |u|) (1 - c u^2) is applied. The gain g becomes g (1 + a) for a
    positive and g (1 - a) for a negative command. It falls with the square of the command, by the curvature c.

    Examples
    --------
    >>> applied_command(np.array([-2.0, 0.5]), {"limit": 1.0, "asymmetry": 0.2}).tolist()
    [[-0.8, 0.6], [-0.8, 0.0], [1.0, 0.5], [0.8, -0.15]]
    """
    limit, asymmetry, curvature = (
        numbers.get("limit", np.inf),
        numbers.get("asymmetry", 0.0),
        numbers.get("curvature", 0),
    )
    clipped = np.clip(command, -limit, limit)
    gain, square = 1 + asymmetry * np.sign(clipped), clipped**2
    share = 1 - curvature * square
    of_limit = np.sign(command) * (np.abs(command) > limit) * gain * (1 - 3 * curvature * square)
    return np.stack([clipped * gain * share, of_limit, np.abs(clipped) * share, -clipped * gain * square])

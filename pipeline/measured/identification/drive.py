"""Static model of a drive with a force limit and a gain that depends on the direction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.records.trials import Floats

DRIVE = ("limit", "asymmetry")
"""Parameters of a drive, which are the largest command and the asymmetry. The asymmetry is half the difference between
the gains of positive and negative commands, divided by their mean."""


def applied_command(command: Floats, numbers: Mapping[str, float]) -> Floats:
    """Return the applied command and its derivatives along the parameters of `DRIVE`, shape (3, R).

    The command u is clipped to the limit, and u + a |u| is applied. The gain g becomes g (1 + a) for a positive and
    g (1 - a) for a negative command.

    Examples
    --------
    >>> applied_command(np.array([-2.0, 0.5]), {"limit": 1.0, "asymmetry": 0.2}).tolist()
    [[-0.8, 0.6], [-0.8, 0.0], [1.0, 0.5]]
    """
    limit, asymmetry = numbers.get("limit", np.inf), numbers.get("asymmetry", 0.0)
    clipped = np.clip(command, -limit, limit)
    gain = 1 + asymmetry * np.sign(clipped)
    return np.stack([clipped * gain, np.sign(command) * (np.abs(command) > limit) * gain, np.abs(clipped)])

"""Static behaviour of a drive: the command that acts, for a largest force and a gain that differs by direction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.records.trials import Floats

DRIVE = ("limit", "asymmetry")
"""Numbers of a drive: largest command, and half the difference of the gains of positive and negative commands, relative
to their mean."""


def applied_command(command: Floats, numbers: Mapping[str, float]) -> Floats:
    """Return the command that acts and its derivatives along `DRIVE`, shape (3, R).

    With u clipped to the limit, u + a |u| acts: the gain is g (1 + a) for positive and g (1 - a) for negative commands.

    Examples
    --------
    >>> applied_command(np.array([-2.0, 0.5]), {"limit": 1.0, "asymmetry": 0.2}).tolist()
    [[-0.8, 0.6], [-0.8, 0.0], [1.0, 0.5]]
    """
    limit, asymmetry = numbers.get("limit", np.inf), numbers.get("asymmetry", 0.0)
    clipped = np.clip(command, -limit, limit)
    gain = 1 + asymmetry * np.sign(clipped)
    return np.stack([clipped * gain, np.sign(command) * (np.abs(command) > limit) * gain, np.abs(clipped)])

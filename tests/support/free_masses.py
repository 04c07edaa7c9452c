"""Logs of a free mass with damping behind two samples of delay, by its exact motion."""

from __future__ import annotations

import numpy as np

MASS, DAMPING, DELAY, T = 0.5, 3.0, 2, 1e-3


def written(path, command, header="", noise=1e-6, seed=1):
    """A log of a mass and a damper behind two samples of delay, exact."""
    rng = np.random.default_rng(seed)
    decay = np.exp(-DAMPING / MASS * T)
    gain = (1 - decay) / DAMPING
    x, v, lines = 0.0, 0.0, []
    for row, force in enumerate(command):
        lines.append(f"{T * row!r},{float(force)!r},{float(x + noise * rng.standard_normal())!r}")
        late = command[max(row - DELAY, 0)]
        x += (1 - decay) * MASS / DAMPING * v + (T - (1 - decay) * MASS / DAMPING) * late / DAMPING
        v = decay * v + gain * late
    path.write_text(header + "time_s,command,position\n" + "\n".join(lines) + "\n", encoding="utf-8")
    return path

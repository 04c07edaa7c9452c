"""Logs of a lab's own layout whose command obeys a wall law, and a profile that reads the wall from their names."""

import numpy as np

PERIOD_S = 0.001

PROFILE = """name = "lab"
format = "delimited"
files = ["*.txt"]
delimiter = ";"
decimal = "."
step_at = "command edge"
name_pattern = 'K(?P<stiffness>[0-9]+[.,]?[0-9]*)_B(?P<damping>[0-9]+[.,]?[0-9]*)'
columns.time = { name = "t", unit = "s" }
columns.command = { name = "F", unit = "N", sign = 1 }
columns.position = { name = "x", unit = "mm", sign = 1 }
[units]
stiffness = "UNIT"
[constants]
device = "bench"
experiment = "1"
step = STEP
sampling_period_s = 0.001
"""


def profile_text(unit="N/mm", step=8.0):
    """Text of a profile; a stiffness in the file names is in `unit`."""
    return PROFILE.replace("UNIT", unit).replace("STEP", repr(step))


def wall_rows(stiffness, damping, *, step=8.0, mass=0.5, rows=400, edge=20):
    """Time [s], command [N] and position [mm] of a mass in front of a wall of N/m and Ns/m, shape (rows, 3)."""
    x = v = before = 0.0
    samples = []
    for row in range(rows):
        command = step * (row >= edge) - stiffness * x - damping * (x - before) / PERIOD_S
        samples.append((round(row * PERIOD_S, 3), command, 1e3 * x))
        before = x
        v += PERIOD_S * (command - 2.0 * v) / mass
        x += PERIOD_S * v
    return np.array(samples)


def wall_log(stiffness, damping, **more):
    """Text of these rows."""
    rows = wall_rows(stiffness, damping, **more).tolist()
    return "\n".join(["t;F;x", *(f"{t:.3f};{force!r};{x!r}" for t, force, x in rows), ""])


def named_logs(count=4, **more):
    """Names and contents of logs; K in a name is in N/mm."""
    rng = np.random.default_rng(0)
    walls = [(float(k), float(b)) for k, b in rng.uniform((1.0, 2.0), (3.0, 9.0), (count, 2)).round(2)]
    return [(f"K{k:g}_B{b:g}.txt", wall_log(1e3 * k, b, **more).encode()) for k, b in walls]

"""Logs of a simulated rig whose force is measured between drive and device, integrated in small steps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.measured.identification.recordings import Recording

T, FINE = 1e-3, 40
MASS, DAMPING = 0.5, 3.0


@dataclass(frozen=True)
class ForceRig:
    """Drive with a gain, a delay and a lag [samples], a limit of the command and an idle time at the start [rows]."""

    gain: float = 0.8
    delay: float = 1.4
    lag: float = 3.0
    limit: float = np.inf
    force_noise: float = 0.01
    position_noise: float = 1e-6
    friction: float = 0.0
    idle_rows: int = 0
    rows: int = 800

    def command(self, seed: int) -> np.ndarray:
        """Random steps after 30 rows without a command."""
        levels = np.random.default_rng(seed).uniform(-4, 4, self.rows // 100)
        command = np.repeat(levels, 100)
        command[:30] = 0
        return command

    def log(self, seed: int) -> Recording:
        """A log of position and measured force under the random steps of a seed."""
        random, u = np.random.default_rng(100 + seed), self.command(seed)
        x, v, f, h = 0.0, 0.0, 0.0, T / FINE
        position, force = np.zeros(self.rows), np.zeros(self.rows)
        decay = np.exp(-1 / (self.lag * FINE)) if self.lag else 0.0
        for row in range(self.rows):
            position[row], force[row] = x, f
            for part in range(FINE):
                late = int(np.floor(row + (part + 0.5) / FINE - self.delay))
                wanted = (
                    self.gain * np.clip(u[max(late, 0)], -self.limit, self.limit) if late >= self.idle_rows else 0.0
                )
                f = wanted + (f - wanted) * decay
                left = f - DAMPING * v
                left -= self.friction * np.sign(v) if v else np.clip(left, -self.friction, self.friction)
                before, v = v, v + h * left / MASS
                x += 0.5 * h * (before + v)
        position += self.position_noise * random.standard_normal(self.rows)
        force += self.force_noise * random.standard_normal(self.rows)
        return Recording(f"run{seed}.csv", T * np.arange(self.rows), u, position, T, force=force)

    def logs(self, count: int = 4) -> list[Recording]:
        """Logs of different random steps."""
        return [self.log(seed) for seed in range(count)]


def write_logs(logs: list[Recording], folder: Path, *, with_force: bool = True) -> Path:
    """Write logs as tables with the columns t, u, x and f."""
    folder.mkdir(parents=True, exist_ok=True)
    for each in logs:
        columns = [each.time, each.command, each.position, *([each.force] if with_force else [])]
        rows = [",".join(map(repr, row)) for row in zip(*(column.tolist() for column in columns), strict=True)]
        names = "t,u,x,f" if with_force else "t,u,x"
        (folder / each.name).write_text("\n".join([names, *rows, ""]), encoding="utf-8")
    return folder

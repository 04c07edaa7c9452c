"""Courses as loggers write them: what a controller does, what its log holds of it, and the digits it is printed with.

It shares no code with the package: exact motion of mass and damping between samples, all trials side by side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from pipeline.records.trials import Trial, Trials


@dataclass(frozen=True)
class Rig:
    """A device: mass, damping, whole delay, step and sensor; the sensor's readings begin at ``start``."""

    mass: float
    damping: float
    delay: int
    step: float
    quantum: float
    noise: float
    start: float = 0.0
    T: float = 1e-3


TURN = 2 * np.pi
RIGS = {
    "falcon": Rig(0.58, 4.0, 4, 8.0, 2e-6, 0.5e-6, 0.12),
    "motor": Rig(1.2e-4, 7e-5, 2, 0.01, TURN / 655360, 2e-6),
    "robot": Rig(0.19, 0.3, 3, 15.0, 2.0**-17, 2e-6, -0.3),
}
"""A sensor of decimals, one of counts in a turn, one of binary counts."""


def walls(rig, n, seed):
    """Stiffness and damping of n trials, most of them stable, some not."""
    random = np.random.default_rng(seed)
    most = 1 / (rig.delay + 1)
    beta = most * random.uniform(0.05, 0.8, n)
    alpha = most * beta * random.uniform(0.05, 0.9, n)
    return alpha * rig.mass / rig.T**2, beta * rig.mass / rig.T


class Plain:
    """The wall law, with the velocity as a mean over samples, through a filter b/a, or by an adaptive window.

    ``seen`` is a filter b/a of the position that all of the wall acts on.
    """

    def __init__(self, rig, K, B, *, samples=1, ba=None, window=0, band=0.0, seen=None):
        self.seen, self.before = seen, np.zeros(len(K))
        self.inside = None if seen is None else np.zeros((max(map(len, seen)) - 1, len(K)))
        self.rig, self.K, self.B, self.samples, self.ba, self.window, self.band = rig, K, B, samples, ba, window, band
        self.state = None if ba is None else np.zeros((max(len(ba[0]), len(ba[1])) - 1, len(K)))

    def velocity(self, x, k):
        T = self.rig.T
        if self.window:
            return self._adaptive(x, k)
        raw = (x[k] - x[max(k - self.samples, 0)]) / (self.samples * T)
        if self.ba is None:
            return raw
        out, self.state = signal.lfilter(*self.ba, raw[None], axis=0, zi=self.state)
        return out[0]

    def _adaptive(self, x, k):
        """First-order adaptive windowing: the longest window whose chord leaves all readings within the band."""
        found = (x[k] - x[max(k - 1, 0)]) / self.rig.T
        open_ = np.ones(len(found), bool)
        for n in range(2, min(self.window, k) + 1):
            slope = (x[k] - x[k - n]) / n
            line = x[k] - np.arange(1, n)[:, None] * slope
            open_ &= (np.abs(line - x[k - n + 1 : k][::-1]) <= self.band).all(axis=0)
            found = np.where(open_, slope / self.rig.T, found)
        return found

    def __call__(self, force, x, k):
        if self.seen is not None:
            out, self.inside = signal.lfilter(*self.seen, (x[k] - x[0])[None], axis=0, zi=self.inside)
            change, self.before = out[0] - self.before, out[0]
            return force - self.K * out[0] - self.B * change / self.rig.T
        return force - self.K * (x[k] - x[0]) - self.B * self.velocity(x, k)


def record(
    rig, n=8, seed=0, *, rows=400, edge=20, late=0, clip=np.inf, slew=np.inf, hold=0.0, hold_log=0.0, ramp=1,
    force=None, K=None, B=None, travel=0.3, error_of=None, slow=1, **law,
):  # fmt: skip
    """A course of n step responses.

    ``late``: rows by which the command is logged late; ``clip`` and ``slew`` bound command and its change, which the
    log shows; ``hold``: share of readings that the sensor repeats, ``hold_log`` those that the log alone repeats;
    ``slow``: samples between new readings; ``error_of``: set point of a position loop whose error is logged.
    """
    random = np.random.default_rng(seed)
    if K is None:
        K, B = walls(rig, n, seed)
    n = len(K)
    T, tau = rig.T, rig.mass / rig.damping
    decay = np.exp(-T / tau)
    grow = tau * (1 - decay)
    law = Plain(rig, K, B, **law)
    x, u = np.zeros((rows, n)), np.zeros((rows, n))
    place, speed = np.zeros(n), np.zeros(n)
    for k in range(rows):
        reading = rig.start + place + rig.noise * random.standard_normal(n)
        x[k] = np.rint(reading / rig.quantum) * rig.quantum if rig.quantum else reading
        held = (random.random(n) < hold) & (k > edge)
        x[k] = np.where(held | (k % slow > 0), x[max(k - 1, 0)], x[k])
        size = rig.step * np.clip((k - edge + 1) / ramp, 0, 1) if force is None else force[k]
        if error_of is not None:
            demand = K * (error_of * (k >= edge) - (x[k] - x[0])) - B * law.velocity(x, k)
        else:
            demand = law(size, x, k)
        demand = np.clip(demand, -clip, clip)
        u[k] = u[max(k - 1, 0)] + np.clip(demand - u[max(k - 1, 0)], -slew, slew)
        acts = u[k - rig.delay] if k >= rig.delay else np.zeros(n)
        place = place + grow * speed + acts / rig.damping * (T - grow)
        speed = decay * speed + acts / rig.damping * (1 - decay)
    far = np.abs(x - rig.start) > travel
    ends = np.where(far.any(axis=0), np.maximum(np.argmax(far, axis=0), 60), rows)
    if error_of is not None:
        x = (x - x[:1]) - error_of * (np.arange(rows) >= edge)[:, None]
    if hold_log:
        held = random.random((rows, n)) < hold_log
        for k in range(edge + 1, rows):
            x[k] = np.where(held[k], x[k - 1], x[k])
    if late:
        u = np.concatenate([np.zeros((late, n)), u[:-late]])
    return Trials.of(
        Trial(f"t{i:04d}", K[i], B[i], rig.step, T, np.arange(end) * T, u[:end, i], x[:end, i])
        for i, end in enumerate(ends.tolist())
    )


def printed(text):
    """A column as read from a file that printed it by a format such as ``%.6g``."""
    return lambda values: np.array([float(text % v) for v in values.ravel()]).reshape(values.shape)


FORMATS = {
    **{f"%.{digits}g": printed(f"%.{digits}g") for digits in (4, 5, 6, 7, 8, 9, 10, 11, 12, 15, 17)},
    **{f"%.{digits}f": printed(f"%.{digits}f") for digits in (6, 9)},
    "float32": lambda values: values.astype(np.float32).astype(float),
    "%.7g of float32": lambda values: printed("%.7g")(values.astype(np.float32).astype(float)),
    "%.9g of float32": lambda values: printed("%.9g")(values.astype(np.float32).astype(float)),
    "mm": lambda values: printed("%.5f")(1e3 * values) * 1e-3,
    "degrees": lambda values: np.deg2rad(printed("%.6f")(np.rad2deg(values))),
}


def written(trials, text, command=None):
    """The course with both columns printed in a format, the command perhaps in another."""
    command = command or (text if text not in ("mm", "degrees") else "%.6g")
    return replace(trials, position=FORMATS[text](trials.position), command=FORMATS[command](trials.command))


def scattered(trials, seed=0):
    """The course with stamps that the operating system scatters; control is exact."""
    off = 0.15 * np.repeat(trials.sampling_period_s, trials.rows)
    return replace(trials, time=trials.time + off * np.random.default_rng(seed).standard_normal(len(trials.time)))


def with_rows(trial, rows, *, shown=True):
    """A trial with some of its rows, by index or mask, whose stamps show that the others are missing, or not."""
    command, position = trial.command[rows], trial.position[rows]
    time = trial.time[rows] if shown else trial.time[: len(command)]
    return replace(trial, time=time, command=command, position=position)


def thinned(trials, share, seed=0, *, shown=True):
    """The course without some rows behind the step, which the stamps show or not."""
    random = np.random.default_rng(seed)
    masks = [(random.random(n) > share) | (np.arange(n) < 25) for n in trials.rows.tolist()]
    return Trials.of(with_rows(trial, keep, shown=shown) for trial, keep in zip(trials, masks, strict=True))


def repeated(trials, share, seed=0, first=30):
    """The course with rows that repeat the one before."""
    random, logs = np.random.default_rng(seed), []
    for trial in trials:
        command, position = trial.command.copy(), trial.position.copy()
        for k in range(first, trial.rows):
            if random.random() < share:
                command[k], position[k] = command[k - 1], position[k - 1]
        logs.append(replace(trial, command=command, position=position))
    return Trials.of(logs)


def write(trials, folder, *, text="%.17g", device="bench"):
    """Write a course as native logs, columns by a printf format or one of `FORMATS`; K and B in the header in full."""
    folder.mkdir(parents=True, exist_ok=True)
    if " " in text or not text.startswith("%"):
        trials, text = written(trials, text), "%.17g"
    for trial in trials:
        names = ("stiffness", "damping", "step", "sampling_period_s")
        header = "".join(f"# {name}: {getattr(trial, name)!r}\n" for name in names)
        columns = (trial.time.tolist(), trial.command.tolist(), trial.position.tolist())
        body = "".join(f"{t:.17g},{text % u},{text % x}\n" for t, u, x in zip(*columns, strict=True))
        start = f"# device: {device}\n# experiment: 1\n{header}time_s,command,position\n"
        (folder / f"{trial.trial_id}.csv").write_text(start + body)


def lab(rig, n, seed=0, **controller):
    """A course as a lab records it: at each damping the stiffness rises until trials are unstable."""
    random = np.random.default_rng(seed)
    columns = max(3, int(np.sqrt(n)))
    beta = np.repeat(np.linspace(0.1, 0.8, columns), n // columns) / (rig.delay + 1)
    rising = np.tile(np.linspace(0.15, 1.6, n // columns), columns) * (1 + 0.02 * random.standard_normal(len(beta)))
    walls = {"K": rising * beta / (rig.delay + 1) * rig.mass / rig.T**2, "B": beta * rig.mass / rig.T}
    return record(rig, seed=seed, **walls, **controller)

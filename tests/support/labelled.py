"""Simulated logs of every kind, each labelled with what happened in it.

A label comes from the construction (a push, a stop, a cut, no step), from the spectral radius of the loop, and from
simulations that run three times as long, one of them without noise and quantum. The classifier has no part in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from columns import stacked

from pipeline.device.parts import Sensor, SimulationParts
from pipeline.device_data.devices import find_experiment, load_device
from pipeline.records.trials import Trials
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import Setup, idealise, setup_of
from pipeline.simulation.simulate import simulate

NEAR = 1e-3
"""Spectral radii within this of 1 are near the boundary: in 400 samples such a motion changes by less than a half."""

BAND = 0.02
SETTLED_SAMPLES = 5
"""Samples in the band that a log must hold to show that the response settled, as for the settling cost."""

LONGER = 3
"""The true course of a trial is read from a simulation this many times as long."""

LATE = 0.03
"""Part of the log, the last one, in which entering the band decides for settled or moving by a hair."""

LASTING = 0.7
"""A motion whose amplitude falls by less than this over two thirds of that simulation is a limit cycle."""


@dataclass(frozen=True)
class Group:
    """Trials of one experiment, as a lab would hand them over together."""

    device: str
    experiment: str
    rows: int
    quantum: float | None = None
    noise: float | None = None
    jitter: tuple[int, ...] | None = None

    @property
    def setup(self) -> Setup:
        device = load_device(self.device)
        made = replace(setup_of(device, find_experiment(device, self.experiment)), rows=self.rows, travel=np.inf)
        stated = {"sensor.quantum": self.quantum, "sensor.noise": self.noise}
        loop = made.loop.replace({name: value for name, value in stated.items() if value is not None})
        jitter = loop.jitter_samples if self.jitter is None else self.jitter
        return replace(made, loop=replace(loop, jitter_samples=jitter))


GROUPS = (
    Group("falcon", "1", 400),
    Group("falcon", "1", 400, jitter=()),
    Group("falcon", "1", 400, quantum=1e-5, noise=0.0, jitter=()),
    Group("falcon", "1", 1000, quantum=0.0, noise=0.0, jitter=()),
    Group("falcon", "6", 400),
    Group("falcon", "6", 250, quantum=2e-5, noise=2e-6),
    Group("falcon", "2", 3000),
    Group("falcon", "1", 1000, quantum=6e-5, noise=0.0, jitter=()),
    Group("lwr", "delay-2", 350),
    Group("lwr", "delay-2", 1000, quantum=0.0, noise=0.0),
    Group("lwr", "delay-2", 350, quantum=2e-5, noise=0.0),
    Group("lwr", "delay-5", 350),
    Group("lwr", "delay-8", 700, noise=4e-6, jitter=(6, 7, 8)),
)


@dataclass(frozen=True)
class Labelled:
    """Trials of one group with their labels; ``kind`` names the construction, ``near`` the boundary."""

    group: Group
    trials: Trials
    label: np.ndarray
    kind: np.ndarray
    near: np.ndarray


def join(parts: list[Trials]) -> Trials:
    """All trials of some parts; ``trial_id`` is the running number."""
    trials = enumerate(trial for part in parts for trial in part)
    return Trials.of(replace(trial, trial_id=str(number)) for number, trial in trials)


def cut(trials: Trials, rows: np.ndarray) -> Trials:
    """The same trials, recorded for fewer rows."""
    return Trials.of(trial.window(0, most) for trial, most in zip(trials, rows.tolist(), strict=True))


def labelled_set(size: int = 200, seed: int = 0, groups: tuple[Group, ...] = GROUPS) -> list[Labelled]:
    """About ``size`` labelled trials of each group."""
    return [_Maker(group, size, seed + 1000 * i).make() for i, group in enumerate(groups)]


class _Maker:
    def __init__(self, group: Group, size: int, seed: int) -> None:
        self.group, self.size, self.seed = group, size, seed
        self.setup = group.setup
        self.loop = self.setup.loop
        self.random = np.random.default_rng(seed)
        self.parts: list[tuple[Trials, np.ndarray, str, np.ndarray]] = []
        self.pool = self._pool()
        self.floor = self.loop.sensor.quantum + 6 * self.loop.sensor.noise

    def make(self) -> Labelled:
        for kind, share in (
            ("stable", 0.25),
            ("cut", 0.06),
            ("diverging", 0.1),
            ("near", 0.08),
            ("boundary", 0.03),
            ("chatter", 0.04),
            ("saturated", 0.1),
            ("leaves", 0.08),
            ("stop", 0.05),
            ("short", 0.06),
            ("push", 0.12),
            ("force", 0.06),
            ("no step", 0.03),
            ("step in row 0", 0.02),
            ("free", 0.05),
            ("free leaves", 0.03),
        ):
            if kind == "chatter" and not (self.loop.sensor.noise == 0 and self.loop.sensor.quantum >= 1e-5):
                continue
            count = max(round(share * self.size), 1)
            trials, label = getattr(self, "_" + kind.replace(" ", "_"))(count)
            known = label != ""
            if known.any():
                close = np.char.startswith(label, "~") | np.isin(kind, ("near", "boundary"))
                self.parts.append((trials.select(known), np.char.lstrip(label[known], "~"), kind, close[known]))
        return Labelled(
            self.group,
            join([p[0] for p in self.parts]),
            np.concatenate([p[1] for p in self.parts]),
            np.concatenate([np.full(len(p[1]), p[2]) for p in self.parts]),
            np.concatenate([p[3] for p in self.parts]),
        )

    def _pool(self):
        """Random (K, B) over twice the stable region, with their spectral radii.

        Where the delay jitters, the spectral radius is that of a long simulation with the same delays.
        """
        falcon = self.group.device == "falcon"
        n = 1500 + 20 * self.size
        B = self.random.uniform(-self.loop.damping if falcon else 0.0, 190.0 if falcon else 60.0, n)
        K = 10 ** self.random.uniform(2.3, 4.6, n)
        K[::2] = self.random.uniform(200.0, 30e3 if falcon else 20e3, n // 2)
        rho = spectral_radius(self.setup, K, B)
        if self.loop.jitter_samples:
            near = np.flatnonzero(np.abs(rho - 1) < 0.02)
            others = self.random.permutation(np.flatnonzero(np.abs(rho - 1) >= 0.02))
            few = min(len(near), 60 + self.size)
            kept = np.concatenate([self.random.permutation(near)[:few], others[:700]])
            K, B, rho = K[kept], B[kept], rho[kept]
            rho[:few] = self._radius(K[:few], B[:few])
        return K, B, rho

    def _radius(self, K, B):
        """Growth per sample of the ideal response with the delays of the log, from its last two thirds."""
        # 400 rows at the least: the growth of a short motion hangs on single delays
        third = max(self.setup.rows, 400) - self.setup.edge_row
        ideal = idealise(self.setup).with_loop(jitter_samples=self.loop.jitter_samples)
        long = replace(ideal, rows=self.setup.edge_row + 3 * third)
        far = np.abs(stacked(simulate(long, K, B, seed=self.seed), "position") - self.setup.centre)
        second, last = (far[:, -2 * third : -third].max(axis=1), far[:, -third:].max(axis=1))
        return np.where(second > 0, last / np.where(second > 0, second, 1.0), 0.0) ** (1 / third)

    def _pick(self, which, count):
        K, B, rho = self.pool
        index = self.random.permutation(np.flatnonzero(which(K, B, rho)))[:count]
        return K[index], B[index]

    def _run(self, K, B, setup=None, **options):
        return simulate(setup or self.setup, K, B, seed=self.seed, **options)

    def _stable_label(self, K, B, rows):
        """Settled, moving or limit cycle of stable loops after ``rows``; empty where it is a matter of taste.

        A ``~`` in front of it marks what the last samples of the log or the last digit of the sensor
        decide.
        """
        long = replace(self.setup, rows=LONGER * self.setup.rows)
        ideal = simulate(long.with_loop(sensor=Sensor()), K, B, seed=self.seed)
        real = self._run(K, B, long)
        band = np.maximum(BAND * self.setup.step / K, self.floor)[:, None]
        far, ideal_far = (np.abs(stacked(trials, "position") - self.setup.centre) for trials in (real, ideal))

        def settled(width, latest):
            inside = ideal_far <= width
            entry = inside.shape[1] - np.argmin(inside[:, ::-1], axis=1)
            return entry <= latest - SETTLED_SAMPLES

        third = self.setup.rows
        late = [np.max(far[:, i * third : (i + 1) * third], axis=1) for i in range(LONGER)]
        column = np.arange(far.shape[1])[None, :]
        end = np.max(np.where((column < rows[:, None]) & (column >= 0.8 * rows[:, None]), far, 0.0), axis=1)
        lasts = (late[2] > LASTING * late[1]) & (late[2] > 1.5 * band[:, 0])
        restless = ~lasts & (late[2] > 0.8 * band[:, 0]) & settled(band, rows)
        label = np.where(settled(band, rows), "settled", "moving").astype("<U13")
        margin = np.maximum(SETTLED_SAMPLES, LATE * rows)
        early = settled(np.maximum(band - self.floor, 0.5 * band), rows - margin)
        sure = early == settled(band + self.floor, rows + margin)
        large = (late[2] > 3 * band[:, 0]) & (end > 1.5 * band[:, 0])
        label[lasts & (end < late[2] / LASTING)] = "limit_cycle"
        # a regular one repeats itself to a tenth; noise does not
        regular = np.minimum(late[1], end) > 0.9 * late[2]
        sure = np.where(label == "limit_cycle", large | regular, sure)
        label = np.where(sure, label, np.char.add("~", label))
        # chatter that touches the edge of the band now and then
        label[restless | (lasts & (end >= late[2] / LASTING))] = ""
        return label

    def _stable(self, count):
        K, B = self._pick(lambda K, B, rho: rho < 1 - NEAR, count)
        return self._run(K, B), self._stable_label(K, B, np.full(len(K), self.setup.rows))

    def _cut(self, count):
        K, B = self._pick(lambda K, B, rho: rho < 1 - NEAR, count)
        start = self.setup.edge_row + 2 * (int(self.loop.delay_samples) + 1) + 30
        rows = self.random.integers(start, start + 120, len(K))
        return cut(self._run(K, B), rows), self._stable_label(K, B, rows)

    def _after(self):
        return self.setup.rows - self.setup.edge_row

    def _diverging(self, count):
        # up to a thousand times the step: further on a person would have pressed the stop
        K, B = self._pick(
            lambda K, B, rho: (rho > 1 + NEAR) & (np.log(np.maximum(rho, 1.0)) * self._after() < 7), count
        )
        return self._run(K, B), self._grows(K, B)

    def _grows(self, K, B):
        """Diverged; with jitter only surely so where the motion within the log itself grows, too."""
        if not self.loop.jitter_samples:
            return np.full(len(K), "diverged")
        free = idealise(self.setup)
        third = self._after() // 3
        trials = self._run(K, B, free.with_loop(jitter_samples=self.loop.jitter_samples))
        far = np.abs(stacked(trials, "position") - self.setup.centre)
        growth = np.log(far[:, -third:].max(axis=1) / far[:, -2 * third : -third].max(axis=1)) / third
        return np.where(growth > NEAR, "diverged", "~diverged")

    def _near(self, count):
        K, B = self._pick(lambda K, B, rho: np.abs(rho - 1) < NEAR, count)
        radius = self._radius(K, B) if self.loop.jitter_samples else spectral_radius(self.setup, K, B)
        change = np.log(radius) * self._after()
        stable = self._stable_label(K, B, np.full(len(K), self.setup.rows))
        # a linear loop that decays has no limit cycle, however slowly it does
        stable = np.where(stable == "limit_cycle", "moving", stable)
        label = np.where(change > 0, "diverged", stable)
        lasting = (np.abs(change) < 0.1) & (np.char.lstrip(stable, "~") != "settled")
        return self._run(K, B), np.where(lasting, "limit_cycle", label)

    def _boundary(self, count):
        """Loops whose amplitude neither grows nor decays, by bisection."""
        _, B = self._pick(lambda K, B, rho: (rho < 1 - NEAR) & (B > 5), count)
        low, high = np.full(len(B), 200.0), np.full(len(B), 1e5)
        for _ in range(60):
            middle = 0.5 * (low + high)
            stable = spectral_radius(self.setup, middle, B) < 1
            low, high = np.where(stable, middle, low), np.where(stable, high, middle)
        # where the delay jitters this is no boundary
        return self._run(low, B), np.full(len(B), "" if self.loop.jitter_samples else "limit_cycle")

    def _chatter(self, count):
        """Stable loops that the quantum keeps in motion, where it is coarse and no noise blurs it."""
        K, B = self._pick(lambda K, B, rho: (rho > 0.95) & (rho < 1 - NEAR), 20 * count)
        trials, label = self._run(K, B), self._stable_label(K, B, np.full(len(K), self.setup.rows))
        cycles = np.flatnonzero(label == "limit_cycle")[:count]
        return trials, np.where(np.isin(np.arange(len(K)), cycles), label, "")

    def _saturated(self, count):
        K, B = self._pick(lambda K, B, rho: (rho < 0.99) | ((rho > 1.003) & (rho < 1.05)), count)
        free = idealise(self.setup)
        peak = np.abs(stacked(self._run(K, B, free), "command")[:, : self.setup.edge_row + 150]).max(axis=1)
        limit = self.setup.step * self.random.uniform(0.5, 1.2)
        hidden = SimulationParts(clipped_command_logged=True)
        trials = self._run(K, B, replace(self.setup, hidden=hidden).with_loop(force_limit=limit))
        clipped = np.array([(np.abs(trial.command) >= limit * (1 - 1e-12)).sum() for trial in trials])
        # an ideal response that stays 5 % below the limit is not touched by it, one 5 % above is for some rows
        label = np.where((peak > 1.05 * limit) & (clipped >= 3), "saturated", "")
        return trials, label

    def _leaves(self, count):
        travel = load_device(self.group.device).limits.travel * self.random.uniform(0.1, 1.0)
        setup = replace(self.setup, travel=travel)
        K, B = self._pick(lambda K, B, rho: (rho > 1.003) & (rho < 1.2), count)
        trials = self._run(K, B, setup)
        return trials, np.where(trials.rows < self.setup.rows, "travel_limit", self._grows(K, B))

    def _stop(self, count):
        travel = load_device(self.group.device).limits.travel * 0.3
        K, B = self._pick(lambda K, B, rho: (rho > 1.01) & (rho < 1.2), count)
        K[: len(K) // 3], B[: len(K) // 3] = 0.0, 0.0
        trials = self._run(K, B, replace(self.setup, stop=travel, rows=max(self.setup.rows, 400)))
        trials = cut(trials, np.full(len(K), self.setup.rows))
        far = np.abs(stacked(trials, "position") - self.setup.centre)
        reach = np.maximum(travel, 1.1 * far[:, :1])
        contact = (far > reach - 0.5 * self.floor - 1e-12).sum(axis=1)
        return trials, np.where(contact >= 4, "travel_limit", np.where(contact == 0, "diverged", ""))

    def _short(self, count):
        K, B = self._pick(lambda K, B, rho: rho < 1.0, count)
        K[: len(K) // 6] = 0.0
        longest = 2 * int(min(self.loop.jitter_samples, default=self.loop.delay_samples)) + 11
        rows = self.setup.edge_row + self.random.integers(5, longest, len(K))
        return cut(self._run(K, B), rows), np.full(len(K), "too_short")

    def _push(self, count):
        K, B = self._pick(lambda K, B, rho: rho < 0.99, count)
        row = np.arange(self.setup.rows)[:, None]
        length = self.random.integers(20, 61, len(K))
        latest = self.setup.rows - 70
        start = self.random.integers(self.setup.edge_row + 20, latest, len(K))
        size = self.random.uniform(0.1, 0.6, len(K)) * self.setup.step * self.random.choice([-1, 1], len(K))
        phase = (row - start) / length
        force = np.where((phase >= 0) & (phase <= 1), size * np.sin(np.pi * phase), 0.0)
        return self._disturbed(K, B, force)

    def _force(self, count):
        """A lasting force: a second step, or one that grows slowly, as a drifting amplifier gives."""
        K, B = self._pick(lambda K, B, rho: rho < 0.99, count)
        row = np.arange(self.setup.rows)[:, None]
        start = self.random.integers(self.setup.edge_row + 20, self.setup.rows - 70, len(K))
        size = self.random.uniform(0.1, 0.6, len(K)) * self.setup.step * self.random.choice([-1, 1], len(K))
        rise = np.where(np.arange(len(K)) % 2 == 0, 1, self.setup.rows - start)
        force = size * np.clip((row - start + 1) / rise, 0.0, 1.0)
        return self._disturbed(K, B, force)

    def _disturbed(self, K, B, force):
        """Disturbed where the force moves a response that would settle by more than the band, else left out."""
        quiet, trials = self._run(K, B), self._run(K, B, disturbance=force)
        moved = np.abs(stacked(trials, "position") - stacked(quiet, "position")).max(axis=1)
        settles = self._stable_label(K, B, quiet.rows) == "settled"
        band = np.maximum(BAND * self.setup.step / K, self.floor)
        # what moves the device by less than two bands is hard to see
        seen = np.where(moved > 2 * band, "disturbed", "~disturbed")
        return trials, np.where(settles & (moved > band), seen, "")

    def _no_step(self, count):
        K, B = self._pick(lambda K, B, rho: rho < 0.99, count)
        late = replace(self.setup, rows=self.setup.rows + 1, edge_row=self.setup.rows)
        trials = self._run(K, B, late)
        return cut(trials, np.full(len(K), self.setup.rows)), np.full(len(K), "no_step")

    def _step_in_row_0(self, count):
        K, B = self._pick(lambda K, B, rho: rho < 0.99, count)
        return self._run(K, B, replace(self.setup, edge_row=0)), np.full(len(K), "no_step")

    def _free(self, count):
        """K = 0: the velocity decays to a constant, or runs away."""
        m, b, T = self.loop.mass, self.loop.damping, self.loop.sampling_period_s
        slowest = 2 * NEAR * m / T
        fastest = 7 * m / (T * self._after())
        size = self.random.uniform(slowest, max(fastest, 1.5 * slowest), count)
        grows = np.arange(count) % 2 == 0
        B = np.where(grows, -b - size, -b + size)
        return self._run(np.zeros(count), B), np.where(grows, "diverged", "moving")

    def _free_leaves(self, count):
        B = -self.loop.damping + self.random.uniform(-5, 5, count)
        setup = replace(self.setup, travel=load_device(self.group.device).limits.travel)
        trials = self._run(np.zeros(count), B, setup)
        return trials, np.where(trials.rows < self.setup.rows, "travel_limit", "")

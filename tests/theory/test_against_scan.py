"""Boundary, verdicts, costs and optima of random loops against a dense scan: eigenvalues and plain simulation in SI.

Nothing of the package's loop or theory is used for the truth: a sample of the loop is written down as a linear step of
positions, filter and forces on their way, whose matrix has the poles and whose powers are the motion.
`SCANNED_LOOPS=400` in the environment scans as many loops of each kind.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from math import floor

import numpy as np
import pytest
from matplotlib.path import Path
from scipy.linalg import expm
from scipy.signal import butter

import pipeline

LOOPS = int(os.environ.get("SCANNED_LOOPS", "24"))
FIRST = int(os.environ.get("SCANNED_FROM", "0"))
FAST = 1
WALLS = 1200
"""Walls of a loop whose poles are told."""

FINE = 48
"""Places of a sample at which the motion is looked at."""

LONGEST = 6000
"""Samples that a response is followed; walls that take longer are not simulated."""


@dataclass
class Plain:
    """A device and its wall law in SI; ``mode`` is far mass, spring, damper, and whether the load is sensed."""

    mass: float
    damping: float
    stiffness: float
    period: float
    delay: float
    lag: float = 0.0
    mode: tuple[float, float, float, bool] | None = None
    b: np.ndarray = field(default_factory=lambda: np.ones(1))
    a: np.ndarray = field(default_factory=lambda: np.ones(1))

    def __post_init__(self) -> None:
        far, spring, damper, load = self.mode or (0.0, 0.0, 0.0, False)
        near = self.mass - far
        # near position and velocity, far position and velocity, force at work, command
        rates = np.zeros((6, 6))
        rates[0, 1] = rates[2, 3] = 1.0
        rates[1, :4] = [-self.stiffness - spring, -self.damping - damper, spring, damper]
        rates[1] /= near
        rates[1, 4 if self.lag else 5] = 1 / near
        if self.mode:
            rates[3, :4] = [spring / far, damper / far, -spring / far, -damper / far]
        if self.lag:
            rates[4, 4:] = -1 / self.lag, 1 / self.lag
        self.rates, self.sensed = rates, 2 if load else 0
        whole = floor(self.delay)
        late = self.delay - whole
        self.holds = [(late, whole + 1), (1 - late, whole)] if late else [(1.0, whole)]
        self.moves = [expm(rates * share * self.period) for share, _ in self.holds]
        self.kept = [0, 1] + [2, 3] * bool(self.mode) + [4] * bool(self.lag)
        self.order = max(len(self.b), len(self.a)) - 1
        self.oldest = self.holds[0][1]

    @property
    def size(self) -> int:
        """States of the device, last position, filter, forces on their way."""
        return 6 + self.order + self.oldest

    def sample(self, state: np.ndarray, K: np.ndarray, B: np.ndarray, step: float) -> list[np.ndarray]:
        """Return device states (with command, n x 6) at the start of each hold, and the next state last; walls (n,)."""
        b, a = (np.pad(c, (0, self.order + 1 - len(c))) for c in (self.b, self.a))
        device, last, held, forces = np.split(state, [5, 6, 6 + self.order], axis=-1)
        position = device[..., self.sensed]
        speed = (position - last[..., 0]) / self.period
        given = b[0] * speed + (held[..., 0] if self.order else 0.0)
        following = np.roll(held, -1, axis=-1)
        if self.order:
            following[..., -1] = 0
            following += b[1:] * speed[..., None] - a[1:] * given[..., None]
        force = -K * position - B * given
        forces = np.concatenate([force[..., None], forces], axis=-1)
        starts = []
        for move, (_, age) in zip(self.moves, self.holds, strict=True):
            now = np.concatenate([device, (step + forces[..., age])[..., None]], axis=-1)
            starts.append(now)
            device = (now @ move.T)[..., :5]
        rest = [position[..., None], following, forces[..., : self.oldest]]
        return [*starts, np.concatenate([device, *rest], axis=-1)]

    def radius(self, K: np.ndarray, B: np.ndarray) -> np.ndarray:
        """Largest modulus of the poles of walls (n,)."""
        unit = np.broadcast_to(np.eye(self.size), (len(K), self.size, self.size))
        rows = self.sample(unit, K[:, None], B[:, None], 0.0)[-1]
        used = [*self.kept, *range(5, self.size)]
        return np.concatenate(
            [np.abs(np.linalg.eigvals(part[:, used][:, :, used])).max(axis=1) for part in np.array_split(rows, 8)]
        )

    def followed(self, K: float, B: float, samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times [samples] and deviations from the end per way, between samples, and those of the samples."""
        step = K + self.stiffness
        state, walls = np.zeros((1, self.size)), (np.array([K]), np.array([B]))
        share = np.arange(1, FINE + 1) / FINE
        paths = [
            np.array([expm(self.rates * duration * s * self.period)[self.sensed] for s in share])
            for duration, _ in self.holds
        ]
        times, away, sampled = [], [], np.empty(samples)
        for k in range(samples):
            sampled[k] = state[0, self.sensed] - 1
            *starts, state = self.sample(state, *walls, step)
            begin = float(k)
            for start, path, (duration, _) in zip(starts, paths, self.holds, strict=True):
                times.append(begin + duration * share)
                away.append(path @ start[0] - 1)
                begin += duration
        return np.concatenate(times), np.concatenate(away), sampled


def drawn(kind: str, seed: int) -> tuple[Plain, pipeline.Loop]:
    """Return a random loop twice: written down here, and by the package."""
    rng = np.random.default_rng([80_423, seed, kind == "device"])
    period, mass = float(10 ** rng.uniform(-3.5, -2.5)), float(10 ** rng.uniform(-2, 1))
    delay = float(rng.choice([rng.integers(0, 9), rng.uniform(0, 9), rng.integers(0, 3)]))
    damping = float(rng.choice([0.0, 10 ** rng.uniform(-4, -0.5)])) * mass / period
    spring = float(rng.choice([0.0, 0.0, 10 ** rng.uniform(-5, -1.5)])) * mass / period**2
    named = {"damping": damping, "stiffness": spring, "delay_samples": delay}
    if kind == "ideal":
        return Plain(mass, damping, spring, period, delay), pipeline.Loop(mass, sampling_period_s=period, **named)
    parts: dict[str, object] = {}
    plain: dict[str, object] = {}
    which = str(rng.choice(["lag", "mode", "difference", "butterworth"]))
    if which == "lag":
        plain["lag"] = parts["actuator_lag_s"] = float(10 ** rng.uniform(-1.5, 0.7) * period)
    elif which == "mode":
        turn, ratio = 2 * np.pi * 10 ** rng.uniform(-2.3, -0.5) / period, float(10 ** rng.uniform(-2.5, -0.5))
        far, load = float(mass * rng.uniform(0.05, 0.8)), bool(rng.random() < 0.5)
        reduced = far * (mass - far) / mass
        plain["mode"] = far, reduced * turn**2, 2 * ratio * turn * reduced, load
        shape = {"frequency_hz": float(turn / (2 * np.pi)), "damping_ratio": ratio, "mass": far}
        parts["mode"] = shape | {"sensor": "load" if load else "motor"}
    elif which == "difference":
        count = int(rng.integers(2, 9))
        plain["b"] = np.ones(count) / count
        parts["velocity"] = {"kind": "difference", "samples": count}
    else:
        order, cutoff = int(rng.integers(1, 3)), float(10 ** rng.uniform(-1.7, -0.4))
        plain["b"], plain["a"] = butter(order, 2 * cutoff)
        parts["velocity"] = {"kind": "butterworth", "order": order, "cutoff_hz": cutoff / period}
    return Plain(mass, damping, spring, period, delay, **plain), pipeline.Loop(
        mass, sampling_period_s=period, **named, **parts
    )


def check_boundary(plain: Plain, loop: pipeline.Loop, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Hold the boundary against eigenvalues all over a box around it; return stable walls well inside."""
    border = loop.boundary(600)
    stiffest, damped = border.attrs["stiffness_max"], border.attrs["damping_max"]
    # islands may lie far off
    levels = border["damping"].dropna().to_numpy()
    lowest = levels[loop.limits(levels)["stiffness"].notna()].min()
    width = damped - lowest
    K = rng.uniform(0, 1.25 * stiffest, WALLS)
    B = rng.uniform(lowest - 0.2 * width, damped + 0.25 * width, WALLS)
    radius = plain.radius(K, B)
    told = loop.points(K, B, ())
    clear = np.abs(radius - 1) > 1e-9
    assert (told["stable"][clear] == (radius[clear] < 1)).all(), loop
    np.testing.assert_allclose(told["spectral_radius"], radius, atol=1e-6)
    # scaled, so that "near the line" means the same along both axes
    ends = (border["damping"].iloc[[-1, 0]] - lowest) / width
    line = np.column_stack([(border["damping"] - lowest) / width, border["stiffness"] / stiffest])
    base = -plain.stiffness / stiffest if border["stiffness"].min() < 0 else 0.0
    outline = Path(np.vstack([line, np.column_stack([ends, [base, base]]), line[:1]]))
    walls = np.column_stack([(B - lowest) / width, K / stiffest])
    far = np.nanmin(np.hypot(*(walls[:, None] - line[None]).transpose(2, 0, 1)), axis=1) > 0.02
    # of a boundary that mostly lies at negative stiffness few points are left here
    several = bool(border["stiffness"].isna().any()) or stiffest < plain.stiffness
    several |= bool(border.attrs["islands"])
    held = loop.limits(B)["stiffness"].fillna(0.0) > K if several else outline.contains_points(walls)
    inside = np.asarray(held) & (walls[:, 1] > 0.01)
    assert (radius[inside & far] < 1 + 1e-9).all(), (loop, "unstable inside", K[inside & far & (radius > 1)][:3])
    outside = far & ~inside & (walls[:, 1] > 0.01) & (radius < 1 - 1e-9)
    islands = np.array([one["damping"] for one in border.attrs["islands"]])
    if len(islands):
        outside &= (islands.min() > B) | (islands.max() < B)
    assert not outside.any(), (loop, "stable outside", K[outside][:3], B[outside][:3])
    good = inside & far & (radius < 1 - 1e-6)
    return K[good], B[good]


def check_costs(plain: Plain, loop: pipeline.Loop, K: float, B: float, radius: float) -> None:
    """Hold settling, overshoot and energies of a wall against its plain simulation."""
    samples = int(min(LONGEST, 60 + 3 * plain.delay + 25 / -np.log(radius)))
    if 25 / -np.log(radius) > LONGEST:
        return
    told = loop.points(K, B).iloc[0]
    times, away, sampled = plain.followed(K, B, samples)
    assert np.abs(away[-FINE:]).max() < 1e-6, loop
    settle = told["settle_2pct"]
    after, before = np.abs(away[times > settle]), np.abs(away[(times <= settle) & (times > settle - 2 / FINE)])
    assert after.max(initial=0) <= 0.02 * (1 + 1e-6), (loop, K, B, settle)
    assert before.max(initial=1.0 if settle <= 1 / FINE else 0.0) >= 0.02 * (1 - 1e-2), (loop, K, B, settle)
    out = np.flatnonzero(np.abs(sampled) > 0.02)
    if np.abs(np.abs(sampled) - 0.02).min() > 1e-9:
        assert told["settle_2pct_discrete"] == out[-1] + 1, (loop, K, B)
    assert away.max() <= told["overshoot"] + 1e-9 <= away.max() + 0.003 * (1 + away.max()), (loop, K, B)
    assert told["overshoot_discrete"] == pytest.approx(max(sampled.max(), 0), abs=1e-9), (loop, K, B)
    stiff = (K + plain.stiffness) * plain.period**2 / plain.mass
    energy = sampled**2 + np.diff(sampled, prepend=sampled[0]) ** 2 / stiff
    for w in range(3):
        expected = float(np.arange(samples) ** w @ energy)
        assert told[f"energy_step_w{w}_discrete"] == pytest.approx(expected, rel=1e-7), (loop, K, B, w)


def check_optimum(loop: pipeline.Loop, criterion: str, K: np.ndarray, B: np.ndarray) -> None:
    """Hold an optimum against stable walls: none is better, and its cost is that of its wall."""
    best = loop.optimum(criterion)
    cost = loop.points(K, B, (criterion,))[criterion]
    assert best.cost is not None, (loop, criterion, best.reason)
    assert cost.min() >= best.cost * (1 - 1e-7), (loop, criterion, best, K[cost.argmin()], B[cost.argmin()])
    if best.reason is None:
        own = loop.points(best.stiffness, best.damping, (criterion,))[criterion][0]
        assert own == pytest.approx(best.cost, rel=1e-6), (loop, criterion, best)


def scan(kind: str, seed: int) -> None:
    plain, loop = drawn(kind, seed)
    rng = np.random.default_rng([seed, 7])
    try:
        loop.boundary(8)
    except pipeline.ParameterError:  # says that no wall is stable
        beta = rng.uniform(0, 2, 400) * plain.mass / plain.period
        alpha = 10 ** rng.uniform(-8, 0, 400) * plain.mass / plain.period**2
        assert (plain.radius(alpha, beta) > 1 - 1e-9).all(), (loop, "has stable walls")
        return
    K, B = check_boundary(plain, loop, rng)
    radius = plain.radius(K, B)
    for i in range(min(12, len(K))):
        check_costs(plain, loop, K[i], B[i], radius[i])
    for criterion in ("settle_2pct", "energy_step_w1_discrete"):
        check_optimum(loop, criterion, K, B)


@pytest.mark.parametrize("kind", ["ideal", pytest.param("device", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "seed", [pytest.param(n, marks=[pytest.mark.slow] if n >= FAST else []) for n in range(FIRST, FIRST + LOOPS)]
)
def test_a_dense_scan_agrees(kind, seed):
    scan(kind, seed)

"""Kinds of real drives, simulated with steps of the sensor and friction: the truth in the interval, or silence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from real_drives import KINDS, Rig, levels, square, two_carts

from pipeline.measured.identification.drive import DRIVE, applied_command
from pipeline.measured.identification.force_limit import exceeds_noise
from pipeline.measured.identification.free_search import EXPLORED_ROWS, WHITE_ERRORS, informative
from pipeline.measured.identification.identified import identified
from pipeline.measured.identification.intervals import Errors
from pipeline.measured.identification.likelihood import Device
from pipeline.measured.identification.open_parts import with_open_parts
from pipeline.measured.identification.recordings import LogUnits
from pipeline.measured.identification.replay import follows, medians, replays
from pipeline.measured.identification.search import refined
from pipeline.measured.identification.segments import segments_of

INTEGRATED = 1e-3
"""Relative error of the small steps of a rig."""

FAST = (
    "plateau",
    "ground spring",
    "gain by direction",
    "gain by size",
    "two carts",
    "load and drift",
    "arm under gravity",
)


def checked(kind: str, seed: int, **unmodelled: object) -> tuple[int, int]:
    """Number of reported parameters of a rig, and of all; each misses its interval by half of it at most."""
    rig, logs = KINDS[kind](seed)
    if unmodelled:
        rig = replace(rig, **unmodelled, reading=0.5 * rig.quantum)
        logs = [rig.log(each.name, each.command, 100 * seed + i) for i, each in enumerate(logs)]
    found = identified(logs)
    reported = 0
    for name, value in rig.truth.items():
        if name in ("positive", "negative"):
            interval = found.drive.get(name)
        elif name in ("torque", "angle"):
            interval = found.gravity.get(name)
        else:
            interval = None if name in found.unidentifiable else found.parameters.get(name)
        if interval is None:
            continue
        reported += 1
        reach = 0.5 * (interval.high - interval.low) + INTEGRATED * abs(value)
        assert interval.low - reach <= value <= interval.high + reach, (kind, seed, name, value, interval)
    has_mode = "mode.frequency_hz" in found.parameters and "mode.frequency_hz" not in found.unidentifiable
    assert "mode.frequency_hz" in rig.truth or not has_mode, (kind, seed, "false mode")
    assert not found.gravity or rig.gravity, (kind, seed, "false gravity")
    if has_mode and "mode" in found.parts:
        assert found.parameters["mode.mass"].low > 0, (kind, seed, "a mode without a load")
    assert set(found.reasons) == found.unidentifiable
    return reported, len(rig.truth)


@pytest.mark.sampled
@pytest.mark.parametrize("kind", FAST)
def test_a_real_drive_is_identified_or_silent(kind):
    reported, known = checked(kind, 1)
    assert reported == known


UNMODELLED = {"switched on late"}
"""Kinds that no part describes: numbers may be missing, and none may be wrong."""

SILENT = pytest.mark.xfail(
    strict=True, reason="on this slow ramp a motion without the command is almost as good, so the judge is silent"
)

SEEDS = [
    *(
        pytest.param(kind, seed, marks=[SILENT] if (kind, seed) == ("saturated", 3) else [])
        for kind in KINDS
        for seed in (2, 3, 4)
    ),
    # a slow force once was a mode of 10 s or without vibration; a decayed response once had no likelihood
    ("drifting", 56),
    ("drifting", 59),
    ("load friction", 53),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), SEEDS)
def test_more_real_drives_are_identified_or_silent(kind, seed):
    reported, known = checked(kind, seed)
    assert reported >= (0.0 if kind in UNMODELLED else 0.6 * known)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed", "unmodelled"),
    [
        ("gain by direction", 41, {"curve": 18.0}),
        ("motor", 42, {"curve": 0.03}),
        ("slow motor", 42, {"friction": 0.0157, "cogging": (0.1, 1.2)}),
    ],
)
def test_a_part_that_no_kind_has_gives_no_false_part(kind, seed, unmodelled):
    """A gain that falls by 3 % is a part of the drive in addition to its asymmetry. A ripple is no mode."""
    reported, known = checked(kind, seed, **unmodelled)
    assert reported == known


@pytest.mark.slow
def test_gravity_whose_torque_may_be_zero_is_not_reported():
    """The rounding errors of a steady speed are a pattern, which gravity and a lag imitate."""
    _, logs = KINDS["saturated"](52)
    found = identified(logs)
    assert found.gravity == {}
    assert found.parts.get("gravity", 0.0) == 0.0
    assert "mass" in found.unidentifiable


@pytest.mark.slow
def test_intervals_include_a_gain_by_size_that_free_runs_do_not_confirm():
    rig, logs = KINDS["motor"](42)
    curved = replace(rig, curve=0.03, reading=0.5 * rig.quantum)
    found = identified([curved.log(each.name, each.command, i) for i, each in enumerate(logs)])
    assert with_open_parts(found.parameters, found.choice) == found.parameters
    numbers = {name: value for name, value in found.choice.fit.device.numbers.items() if name != "curvature"}
    fit = refined(found.choice.segments, replace(found.choice.fit.device, numbers=numbers, effects=None), far=False)
    unseen = replace(found.choice, fit=fit, open=("gain by size",))
    mass = Errors.of(fit).parameter("mass", unseen.units)
    assert not mass.low <= rig.motor <= mass.high
    wide = with_open_parts({"mass": mass}, unseen)["mass"]
    assert wide.low <= rig.motor <= rig.motor / (1 - curved.curve) <= wide.high


def test_a_drive_with_two_gains_gives_two_masses_and_an_interval_over_both():
    rng = np.random.default_rng(9)
    rig = Rig(1e-3, 2e-4, 1e-3, friction=2e-3, gains=(1.3, 0.8), quantum=1e-3)
    logs = [rig.log(str(i), levels(rng, 900, 60, 0.05), i) for i in range(2)]
    found = identified(logs)
    assert found.drive["positive"].value == pytest.approx(2e-4 / 1.3, rel=0.01)
    assert found.drive["negative"].value == pytest.approx(2e-4 / 0.8, rel=0.01)
    mass = found.parameters["mass"]
    assert mass.low <= 2e-4 / 1.3 < 2e-4 / 0.8 <= mass.high
    even = [replace(rig, gains=(1.0, 1.0)).log(str(i), each.command, i) for i, each in enumerate(logs)]
    assert identified(even).drive == {}


def test_derivatives_of_the_applied_command_are_those_of_differences():
    command, numbers = np.linspace(-2, 2, 41), {"limit": 1.03, "asymmetry": -0.3, "curvature": 0.1}
    _, *slopes = applied_command(command, numbers)
    for name, slope in zip(DRIVE, slopes, strict=True):
        ends = (applied_command(command, numbers | {name: numbers[name] + by})[0] for by in (1e-6, -1e-6))
        high, low = ends
        np.testing.assert_allclose((high - low) / 2e-6, slope, atol=1e-6)


@pytest.mark.parametrize(("wrong", "does"), [(1.0, True), (8.0, False)])
def test_a_device_of_the_right_speed_and_the_wrong_inertia_does_not_follow(wrong, does):
    """In position both fit to 99 %: the mean speed is right."""
    rng = np.random.default_rng(3)
    rig = Rig(0.002, 0.003, 0.1, quantum=1e-3)
    logs = [rig.log(str(i), 3 + levels(rng, 1200, 50, 3.0), i) for i in range(2)]
    units = LogUnits.of(logs)
    gain = units.command * units.period**2 / units.position / 0.003
    delta = 0.1 / 0.003 * units.period
    device = Device({"gain": gain / wrong, "delta": delta / wrong, "delay": 0.0})
    assert follows(*medians(replays(logs, units, 3, device))) is does


@pytest.mark.parametrize(("excess", "clips"), [(0.0, False), (0.02, False), (0.2, True)])
def test_a_limit_inside_the_noise_of_a_command_is_none(excess, clips):
    rng = np.random.default_rng(7)
    rig = Rig(0.002, 0.003, 0.1, quantum=1e-3, command_noise=0.02)
    logs = [rig.log(str(i), square(rng, 600, 60, 1.0), i) for i in range(2)]
    units = LogUnits.of(logs)
    segments = segments_of(logs, units, 3, False)
    assert exceeds_noise(segments, (1.0 - excess) / units.command) is clips
    # in a random command, the changes of a row are the command itself
    random = [rig.log(str(i), rng.choice([-1.0, 1.0], 600), i) for i in range(2)]
    assert exceeds_noise(segments_of(random, LogUnits.of(random), 3, False), 0.98)


@pytest.mark.slow
def test_friction_along_the_way_is_named_by_its_place():
    rng = np.random.default_rng(5)
    rig = Rig(0.009, 0.4, 0.9, friction=0.18, spring=160.0, cogging=(10.0, 300.0), quantum=5e-6)
    found = identified([rig.log(str(i), levels(rng, 1200, 60, 2.0), i) for i in range(2)])
    # the numbers hold within wide intervals, and no limit of walls follows from them
    assert set(found.parts) <= {"friction", "stiffness"}
    assert found.parameters["mass"].low < 0.4 < found.parameters["mass"].high
    assert found.parameters["stiffness"].low < 160.0 < found.parameters["stiffness"].high
    assert "position" in found.departure


@pytest.mark.slow
def test_eight_logs_show_a_slow_mode():
    rig, _ = two_carts(1, load_friction=True)
    rng = np.random.default_rng(8)
    found = identified(
        [rig.log(str(i), square(rng, 700, 170, size), i) for i, size in enumerate(rng.uniform(1.5, 2.5, 8))]
    )
    assert found.parts["mode"] > 0
    for name, value in rig.truth.items():
        assert found.parameters[name].value == pytest.approx(value, rel=2e-3), name


def test_a_gain_that_falls_with_the_command_gives_the_mass_of_small_and_of_large_commands():
    rng = np.random.default_rng(4)
    rig = Rig(2e-3, 1e-3, 1e-2, friction=0.05, curve=0.2, quantum=1e-3)
    found = identified([rig.log(str(i), levels(rng, 900, 60, 1.0), i) for i in range(2)])
    share = 0.2 * found.units.command**2
    assert found.drive["small"].value == pytest.approx(1e-3, rel=0.01)
    assert found.drive["curvature"].value == pytest.approx(share, abs=0.02)
    mass = found.parameters["mass"]
    assert mass.low <= 1e-3 < found.drive["large"].value <= mass.high


def test_informative_rows_are_those_with_motion_in_every_order_of_the_logs():
    rng = np.random.default_rng(2)
    rig = Rig(0.004, 0.6, 8.0, quantum=1e-5)
    still = [rig.log(f"still {i}", np.full(6000, 1e-3), i) for i in range(3)]
    moves = [rig.log(f"moves {i}", levels(rng, 6000, 80, 2.0), i) for i in range(2)]
    chosen = []
    for logs in (still + moves, moves[::-1] + still):
        some = informative(segments_of(logs, LogUnits.of(logs), 3, False, WHITE_ERRORS))
        chosen.append({logs[trial].name for trial in some.trial})
        assert EXPLORED_ROWS <= some.rows.sum() < 2 * EXPLORED_ROWS
    assert chosen[0] == chosen[1] <= {"moves 0", "moves 1"}

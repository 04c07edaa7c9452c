"""Logs with a velocity alone: the position is its integral where the profile says so, by the rule that it names."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.base.errors import ProfileError
from pipeline.intake.ingest import ingest
from pipeline.measured.experiment.estimates import mass_estimate
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.profiles.profile_files import load_profile
from pipeline.shell.profile.check import check_lines, check_samples
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

PROFILE = """
name = "lab"
format = "delimited"
files = ["*.csv"]
delimiter = ","
decimal = "."
header = true
step_at = "command edge"
columns.time = {name = "t", unit = "ms"}
columns.command = {name = "tau", unit = "Nm", sign = 1}
columns.position = {name = "omega", unit = "deg/s", sign = -1, integrate = "difference"}
[constants]
device = "motor"
experiment = "1"
motion = "rotation"
stiffness = 0
damping = 0
step = 0.06
sampling_period_s = 0.001
"""
J, b, T, EDGE, QUANTUM = 1.2e-4, 7e-5, 1e-3, 80, 2 * np.pi / 4096


def motor(rows=400):
    """Angle and speed [rad, rad/s] of a motor under a torque step, by the closed solution of J w' = u - b w."""
    u = 0.06 * (np.arange(rows) >= EDGE)
    fade, angle, speed = np.exp(-b / J * T), np.zeros(rows), np.zeros(rows)
    for k in range(rows - 1):
        final = u[max(k - 1, 0)] / b
        angle[k + 1] = angle[k] + final * T + (speed[k] - final) * (1 - fade) * J / b
        speed[k + 1] = final + (speed[k] - final) * fade
    return u, angle, speed


def stored(folder, profile, speed, u, time=None, processed=None):
    """Ingest a log of time, torque and speed; the report and, where it was accepted, the trial."""
    (folder / "lab.toml").write_text(profile)
    t = np.arange(len(u)) if time is None else time
    samples = zip(t.tolist(), u.tolist(), np.rad2deg(speed).tolist(), strict=True)
    rows = "".join(f"{a!r},{c!r},{-w!r}\n" for a, c, w in samples)
    (folder / "log.csv").write_text("t,tau,omega\n" + rows)
    processed = processed or folder / "processed"
    report = ingest([folder / "log.csv"], processed, profile=folder / "lab.toml")
    return report, load_trials(processed, read_trials(processed))


def test_the_difference_of_an_encoder_gives_its_positions_again(tmp_path):
    u, angle, _ = motor()
    read = np.floor(angle / QUANTUM) * QUANTUM
    _, trials = stored(tmp_path, PROFILE, np.diff(read, prepend=0.0) / T, u)
    np.testing.assert_allclose(trials[0].position, read, atol=1e-12)
    np.testing.assert_allclose(trials[0].velocity, np.diff(read, prepend=0.0) / T, atol=1e-9)
    stages = ExperimentStages.stored(tmp_path / "processed", "motor", "1")
    np.testing.assert_allclose(stages.column("response", "sensor_quantum"), QUANTUM, rtol=1e-6)
    (extra,) = stages.trials.column("extra").to_pylist()
    assert '"integrated": "difference"' in extra
    # friction may have held any constant force before one step: only its sum with the command is told
    assert "record steps of two sizes" in mass_estimate(stages).reason


@pytest.mark.slow
def test_two_sizes_of_a_step_tell_the_inertia_by_integrated_speeds(tmp_path):
    u, angle, _ = motor()
    for size in (1, 2):
        read = np.floor(size * angle / QUANTUM) * QUANTUM
        (tmp_path / str(size)).mkdir()
        profile = PROFILE.replace("step = 0.06", f"step = {0.06 * size}")
        stored(tmp_path / str(size), profile, np.diff(read, prepend=0.0) / T, size * u, processed=tmp_path / "both")
    mass = mass_estimate(ExperimentStages.stored(tmp_path / "both", "motor", "1"))
    assert mass.low < J < mass.high
    assert mass.value == pytest.approx(J, rel=2e-3)


def test_a_tachometer_tells_no_quantum_of_the_position(tmp_path):
    """Its readings lie on a grid; the integral does, too, but that is no resolution of a position."""
    u, angle, speed = motor()
    grid = 0.5
    _, trials = stored(tmp_path, PROFILE.replace("difference", "trapezoid"), np.rint(speed / grid) * grid, u)
    np.testing.assert_allclose(trials[0].position, angle, atol=400 * T * grid)
    stages = ExperimentStages.stored(tmp_path / "processed", "motor", "1")
    assert stages.column("response", "sensor_quantum").tolist() == [0.0]


def test_the_trapezoidal_rule_is_exact_for_an_even_acceleration(tmp_path):
    speed = np.cumsum(np.full(50, 0.3))
    _, trials = stored(tmp_path, PROFILE.replace("difference", "trapezoid"), speed, 0.06 * (np.arange(50) > 9))
    k = np.arange(50)
    np.testing.assert_allclose(trials[0].position, (0.3 * k + 0.15 * k**2) * T, rtol=1e-12)


def test_stamps_and_window_count(tmp_path):
    time = np.array([0, 1.2, 1.9, 3.1, 4.0, 5.0])
    profile = PROFILE.replace("[constants]", "[window]\nfrom_row = 1\n[constants]")
    _, trials = stored(tmp_path, profile, np.full(6, 2.0), 0.06 * (np.arange(6) > 2), time)
    np.testing.assert_allclose(trials[0].position, 2e-3 * (time[1:] - time[1]), rtol=1e-12)


@pytest.mark.parametrize("rule", ["difference", "trapezoid"])
def test_over_lost_rows_no_position_is_known(tmp_path, rule):
    u, _, speed = motor(60)
    time = np.delete(np.arange(60), 30)
    report, trials = stored(tmp_path, PROFILE.replace("difference", rule), np.delete(speed, 30), np.delete(u, 30), time)
    (refusal,) = report.quarantined
    assert (refusal.row, len(trials)) == (32, 0)
    assert "rows are missing before 0.031 s" in refusal.reason
    # behind the gap it is known again
    profile = PROFILE.replace("difference", rule).replace("[constants]", "[window]\nfrom_row = 30\n[constants]")
    report, trials = stored(tmp_path, profile, np.delete(speed, 30), np.delete(u, 30), time)
    assert (report.ingested, trials[0].position[0]) == (1, 0.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"deg/s", sign', '"deg", sign', "angular velocity"),
        ('"difference"', '"Simpson"', "'difference' or 'trapezoid'"),
        (
            "columns.command",
            'columns.velocity = {name = "omega", unit = "deg/s", sign = 1}\ncolumns.command',
            "stored as the velocity",
        ),
        ('sign = 1}\ncolumns.position', 'sign = 1, integrate = "difference"}\ncolumns.position', "integrate"),
    ],
)  # fmt: skip
def test_mistakes_of_a_profile(tmp_path, old, new, words):
    assert old in PROFILE
    (tmp_path / "lab.toml").write_text(PROFILE.replace(old, new))
    with pytest.raises(ProfileError, match=words):
        load_profile(tmp_path / "lab.toml")


def test_the_rule_is_part_of_the_profile_and_shown(tmp_path):
    (tmp_path / "lab.toml").write_text(PROFILE)
    (tmp_path / "other.toml").write_text(PROFILE.replace("difference", "trapezoid"))
    one, other = load_profile(tmp_path / "lab.toml"), load_profile(tmp_path / "other.toml")
    assert one.digest != other.digest
    (tmp_path / "log.csv").write_text("t,tau,omega\n" + "".join(f"{k},{0.06 * (k > 3)},{-k}\n" for k in range(30)))
    lines = check_lines(check_samples(one, [tmp_path / "log.csv"]))
    assert any("omega [deg/s, sign -1, integrate difference]" in line for line in lines)

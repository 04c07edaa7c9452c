"""Header against command: other gains are named with factor and cure, and never where the log leaves them open."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.intake.ingest import ingest
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.readers.gain_check import followed_gains, gain_mismatch, wall_gains
from pipeline.readers.log import Log
from pipeline.records.native import NativeHeader
from pipeline.shell.cli import application
from pipeline.store.storage import read_trials

T, MASS, STEP = 0.001, 0.5, 8.0


def motion(k, b, *, seed=0, rows=800, quantum=0.0, mean=1, limit=np.inf, delay=2, noise=0.0):
    """Command and position of a mass behind a delayed wall; the velocity may be a mean, the command clipped."""
    rng = np.random.default_rng(seed)
    x, v = 0.0, 0.0
    seen, sent = [], []
    for row in range(rows):
        reading = x + noise * rng.standard_normal()
        seen.append(quantum * np.round(reading / quantum) if quantum else reading)
        former = seen[max(len(seen) - 1 - mean, 0)]
        u = STEP * (row >= 20) - k * (seen[-1] - seen[0]) - b * (seen[-1] - former) / (mean * T)
        sent.append(float(np.clip(u, -limit, limit)))
        force = sent[-1 - delay] if len(sent) > delay else 0.0
        v += T * (force - 1.5 * v) / MASS
        x += T * v
    return np.array(sent), np.array(seen)


def log(stated, command, position):
    header = NativeHeader("rig", "1", *stated, T)
    return Log(header, np.arange(len(command)) * T, command, position)


@pytest.mark.parametrize("seed", [3, 17, 52])
def test_a_log_that_obeys_its_header_is_never_doubted(seed):
    rng = np.random.default_rng(seed)
    kinds = [{}, {"quantum": 2e-5}, {"mean": 5}, {"limit": 6.0}, {"noise": 1e-6}, {"mean": 3, "quantum": 1e-5}]
    for _ in range(6):
        k, b = rng.uniform(200, 3000), rng.uniform(2, 25)
        for kind in kinds:
            sent, seen = motion(k, b, seed=seed, **kind)
            assert followed_gains(log((k, b, STEP), sent, seen)) is None, (k, b, kind)


@pytest.mark.parametrize(
    ("stated", "names"),
    [
        ((3.2, 18.0, STEP), {"stiffness": 1000}),
        ((3200.0, 0.018, STEP), {"damping": 1000}),
        ((3200.0, 18.0, 4.0), {"step": 2}),
        ((3.2, 0.018, STEP), {"stiffness": 1000, "damping": 1000}),
        ((2800.0, 18.0, STEP), {"stiffness": 3200 / 2800}),
    ],
)
def test_what_differs_is_named_with_its_factor(stated, names):
    found = followed_gains(log(stated, *motion(3200.0, 18.0, seed=5)))
    assert found is not None
    assert found.factors == pytest.approx(names, rel=0.02)


def test_a_unit_that_was_forgotten_is_found_through_a_filter():
    found = followed_gains(log((1.2, 0.008, STEP), *motion(1200.0, 8.0, seed=5, mean=4, quantum=1e-5)))
    assert found is not None
    assert found.factors["stiffness"] == pytest.approx(1000, rel=0.2)


@pytest.mark.parametrize(
    ("columns", "cure"),
    [
        ((1, 1, 1000), "position times 0.001, or # stiffness: 3.2; # damping: 0.018"),
        ((1, 50, 1), "command times 0.02, or # stiffness: 1.6e+05; # damping: 900; # step: 400"),
        ((1e6, 1, 1), "time_s times 1e-06, or # damping: 1.8e+07"),
    ],
)
def test_a_column_that_is_not_in_si_is_named_before_the_header(columns, cure):
    time, command, position = columns
    sent, seen = motion(3200.0, 18.0, seed=5)
    found = log((3200.0, 18.0, STEP), command * sent, position * seen)
    native = next(each for each in shipped_profiles() if each.format == "native")
    warning = gain_mismatch(native, replace(found, time=time * found.time))
    assert warning.endswith(f"Remedy: {cure}")


PROFILE = """
name = "lab"
format = "delimited"
files = ["*.csv"]
decimal = "."
step_at = "command edge"
name_pattern = "K(?P<stiffness>[0-9.]+)_B(?P<damping>[0-9.]+?)[.]csv"
columns.time = { name = "t", unit = "s" }
columns.command = { name = "f", unit = "N", sign = 1 }
columns.position = { name = "x", unit = "m", sign = 1 }
constants = { device = "rig", experiment = "1", step = 8, sampling_period_s = 0.001 }
"""


@pytest.fixture
def lab(tmp_path):
    """A lab whose file names state K in N/mm, and a profile that does not say so."""
    (tmp_path / "logs").mkdir()
    for k in (1.2, 2.4):
        sent, seen = motion(1000 * k, 14.0)
        samples = enumerate(zip(sent.tolist(), seen.tolist(), strict=True))
        rows = "".join(f"{n * T:.4f},{u!r},{x!r}\n" for n, (u, x) in samples)
        (tmp_path / "logs" / f"K{k}_B14.csv").write_text("t,f,x\n" + rows)
    (tmp_path / "lab.toml").write_text(PROFILE)
    return tmp_path


def check(lab):
    return CliRunner().invoke(application(), ["profile", "check", str(lab / "lab.toml"), str(lab / "logs")])


def test_check_ends_with_an_error_that_names_factor_and_cure(lab):
    done = check(lab)
    assert done.exit_code == 1
    assert "factor 1000" in done.output
    assert 'stiffness = "N/mm"' in done.output
    (lab / "lab.toml").write_text(PROFILE + 'units = { stiffness = "N/mm" }\n')
    done = check(lab)
    assert (done.exit_code, "obeys" in done.output) == (0, False)


def test_ingest_stores_with_a_mark_and_a_warning(lab):
    report = ingest([lab / "logs"], lab / "processed", lab / "lab.toml")
    assert (report.ingested, report.quarantined) == (2, ())
    assert len(report.warnings) == 2
    for warning in report.warnings:
        assert "factor 1000" in warning.warning
        assert 'stiffness = "N/mm"' in warning.warning
    for extra in read_trials(lab / "processed").column("extra").to_pylist():
        assert "factor 1000" in json.loads(extra)["other_gains"]


@pytest.mark.parametrize(("name", "factor"), [("stiffness", 10.0), ("damping", 10.0)])
def test_the_wall_of_an_unstable_trial_is_known_by_its_step_before_it_grows(name, factor):
    """Later jumps of its command are larger than its step."""
    time, command, position = (np.zeros(400) for _ in range(3))
    time[:] = 1e-3 * np.arange(400)
    x = v = before = 0.0
    waiting = [0.0] * 3
    for row in range(400):
        command[row] = 4.0 * (row >= 40) - 12000.0 * x - 15.0 * (x - before) / 1e-3
        position[row], before = x, x
        waiting.append(command[row])
        v += 1e-3 * (waiting.pop(0) - 3.0 * v) / 0.55
        x += 1e-3 * v
    assert np.abs(np.diff(command)).max() > 2 * 4.0, "it grows"
    stated = {"stiffness": 12000.0, "damping": 15.0, "step": 4.0}
    header = NativeHeader("bench", "1", **stated, sampling_period_s=1e-3)
    assert followed_gains(Log(header, time, command, position)) is None
    wrong = NativeHeader("bench", "1", **(stated | {name: factor * stated[name]}), sampling_period_s=1e-3)
    found = followed_gains(Log(wrong, time, command, position))
    assert found is not None
    assert found.found == {name: pytest.approx(stated[name], rel=1e-6)}


@pytest.mark.parametrize("growth", [5.0, 20.0, 35.0])
def test_a_step_is_found_in_a_motion_that_grows_far_beyond_it(growth):
    """The motion of an unstable wall is its own exponential; the command of a wall law follows from it."""
    time = np.arange(400) * 1e-3
    late = np.maximum(time - 0.03, 0.0)
    position = np.round(1e-3 * np.expm1(growth * late) * np.sin(90.0 * late), 5)
    velocity = np.append(0.0, np.diff(position)) / 1e-3
    command = 0.05 * (time >= 0.03) - 8.0 * position - 0.01 * velocity
    found = wall_gains(time, command, position)
    assert found == pytest.approx((8.0, 0.01, 0.05), rel=1e-6)
    released = wall_gains(time, command - 0.05 * (time >= 0.03), position)
    assert released == pytest.approx((8.0, 0.01, 0.0), rel=1e-6)

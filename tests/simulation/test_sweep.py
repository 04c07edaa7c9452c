"""The sweep against testing one trial after the other, and what it leaves on disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import ROOT

from pipeline.base.errors import DeviceError, ParameterError, PipelineError, UsageError
from pipeline.device.parts import Sensor, SimulationParts
from pipeline.device_data.devices import find_experiment, load_device, read_device
from pipeline.measured.signal.verdict import Verdict
from pipeline.records.models import Device
from pipeline.records.native import parse_header
from pipeline.records.trials import Trial
from pipeline.simulation import procedure
from pipeline.simulation import sweep as sweep_module
from pipeline.simulation.radius import spectral_radius
from pipeline.simulation.setup import idealise, setup_of
from pipeline.simulation.simulate import simulate
from pipeline.simulation.sweep import TRUTH_FILE, SimulatedSweep, run_sweep, write_sweep

FALCON, LWR = load_device("falcon"), load_device("lwr")


Judge = Callable[[Trial], Verdict]


def verdict_of(text: str) -> Verdict:
    return Verdict(text, np.nan, "")


def judge_by_noise(trial: Trial) -> Verdict:
    """Verdict that depends on the noise of the log and is not monotonic in K: hard for speculation."""
    motion = np.abs(np.diff(trial.position))
    if trial.rows < 100:
        return verdict_of("unstable")
    early, late = motion[-80:-40].max(), motion[-40:].max()
    return verdict_of("unstable" if late > early else "undecided" if late > 0.9 * early else "stable")


def judge_by_theory(device: Device, experiment: str) -> Judge:
    setup = setup_of(device, find_experiment(device, experiment))

    def judge(trial: Trial) -> Verdict:
        # 1e-9: at K = 0 and B = -b the radius is 1 exactly, but for the rounding of an eigenvalue
        radius = spectral_radius(setup, np.array([trial.stiffness]), np.array([trial.damping]))[0]
        return verdict_of("unstable" if radius > 1 + 1e-9 else "stable")

    return judge


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., SimulatedSweep]:
    """`run_sweep` with another judge of the logs."""

    def sweep(judge: Judge, *given: Any, **options: Any) -> SimulatedSweep:
        monkeypatch.setattr(sweep_module, "judge", judge)
        return run_sweep(*given, **options)

    return sweep


def sequential(device: Device, experiment: str, judge: Judge, coarsen: int, seed: int) -> list[tuple[float, float]]:
    """Pairs (K, B) of a lab that tests one trial after the other, in plain loops."""
    e = find_experiment(device, experiment)
    setup = setup_of(device, e)
    tested: list[tuple[float, float]] = []

    def unstable(K: float, B: float) -> bool:
        tested.append((K, B))
        (trial,) = simulate(setup, np.array([K]), np.array([B]), stream=f"{device.name}/{e.name}", seed=seed)
        return judge(trial).verdict == "unstable"

    step = e.stiffness_step * coarsen
    B = e.damping_first
    while e.damping_last >= B:
        stable = 0
        while not unstable((stable + 1) * step, B):
            stable += 1
        for part in (0.2, 0.4, 0.6, 0.8):
            if unstable((stable + part) * step, B):
                break
        B += e.damping_step * coarsen
    stable = -1
    while not unstable(0.0, -(stable + 1) * e.damping_step):
        stable += 1
    for part in (0.2, 0.4, 0.6, 0.8):
        if unstable(0.0, -(stable + part) * e.damping_step):
            break
    return tested


@pytest.mark.parametrize(("device", "experiment", "coarsen"), [(FALCON, "6", 9), (LWR, "delay-5", 10)])
def test_course_equals_testing_one_after_the_other(
    run: Callable[..., SimulatedSweep], device: Device, experiment: str, coarsen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = sequential(device, experiment, judge_by_noise, coarsen, 5)
    for wave in (1, 3, 12):
        monkeypatch.setattr(procedure, "WAVE", wave)
        sweep = run(judge_by_noise, device, experiment, seed=5, coarsen=coarsen)
        trials = sweep.trials
        assert np.allclose(np.stack((trials.stiffness, trials.damping), axis=1), expected, rtol=1e-12, atol=1e-12)
    assert set(sweep.verdict) == {"stable", "unstable", "undecided"}
    assert set(sweep.passes) == {1, 2}


@pytest.mark.parametrize(
    ("device", "experiment", "size"), [(FALCON, "1", 2320), (FALCON, "6", 1080), (LWR, "delay-2", 1420)]
)
def test_size_of_an_ideal_course(
    run: Callable[..., SimulatedSweep], device: Device, experiment: str, size: int
) -> None:
    sweep = run(judge_by_theory(device, experiment), device, experiment, ideal=True)
    # sizes from DEFINITIONS ("about"); one more fine or K = 0 trial for each of 40 dampings would be 3 %
    assert len(sweep.trials) == pytest.approx(size, rel=0.015)
    assert len(set(sweep.trials.trial_id)) == len(sweep.trials)


def test_limits_are_bracketed_to_a_fifth_of_the_step(run: Callable[..., SimulatedSweep]) -> None:
    sweep = run(judge_by_theory(FALCON, "2"), FALCON, "2", ideal=True, coarsen=6)
    K, B, unstable = sweep.trials.stiffness, sweep.trials.damping, sweep.verdict == "unstable"
    for damping in np.unique(B[K > 0]):
        here = (damping == B) & (K > 0)
        assert K[here & unstable].min() - K[here & ~unstable].max() == pytest.approx(6 * 200 / 5)
    free = K == 0
    assert B[free & unstable].max() == pytest.approx(-2.4)  # b = 2: the first step of 0.8 beyond the limit
    assert B[free & ~unstable].min() == pytest.approx(-1.6)


def test_where_no_damping_at_zero_stiffness_is_stable_the_limit_is_enclosed(
    run: Callable[..., SimulatedSweep],
) -> None:
    def judge(trial: Trial) -> Verdict:
        return verdict_of("unstable" if trial.stiffness > 0 or trial.damping < 0.5 else "stable")

    sweep = run(judge, LWR, "delay-2", coarsen=40, ideal=True)
    free = sweep.trials.stiffness == 0
    assert sweep.trials.damping[free] == pytest.approx([0.0, 0.8, 0.6, 0.4])
    assert sweep.verdict[free].tolist() == ["unstable", "stable", "stable", "unstable"]


def test_a_course_without_end_is_given_up(run: Callable[..., SimulatedSweep], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procedure, "LONGEST_CLIMB", 24)
    with pytest.raises(ParameterError, match=r"no unstable trial after 24 steps \(K = 4800, B = 0\)"):
        run(lambda _: verdict_of("stable"), FALCON, "1")


def test_options_replace_the_devices_values(run: Callable[..., SimulatedSweep]) -> None:
    seen: list[int] = []
    options = {"sensor": Sensor(quantum=1e-5), "jitter_samples": (4,), "duration_s": 0.3, "coarsen": 9}
    sweep = run(judge_by_noise, FALCON, "6", progress=seen.append, **options)
    assert (sweep.setup.loop.sensor, sweep.setup.loop.jitter_samples) == (Sensor(quantum=1e-5), (4,))
    assert sweep.trials.rows.max() == 300
    assert seen == sorted(seen)
    assert seen[-1] == len(sweep.trials)
    ideal = run(judge_by_theory(FALCON, "6"), FALCON, "6", ideal=True, coarsen=9)
    assert ideal.setup == idealise(setup_of(FALCON, find_experiment(FALCON, "6")))


def test_wrong_requests_are_refused() -> None:
    with pytest.raises(DeviceError, match="no experiment '9'"):
        run_sweep(FALCON, "9")
    with pytest.raises(ParameterError, match="coarsen = 0"):
        run_sweep(FALCON, "1", coarsen=0)
    with pytest.raises(ParameterError, match=r"duration = 1000000000.0 s: expected at most 20 s \(20000 samples\)"):
        run_sweep(FALCON, "1", duration_s=1e9)


@pytest.fixture(scope="module")
def small() -> SimulatedSweep:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_module, "judge", judge_by_noise)
        return run_sweep(FALCON, "6", seed=2, coarsen=9)


def test_logs_hold_the_trials_to_the_last_bit(small: SimulatedSweep, tmp_path: Path) -> None:
    assert write_sweep(small, tmp_path) == len(small.trials)
    folder = tmp_path / "falcon" / "6"
    assert {p.name for p in folder.iterdir()} == {f"{i}.csv" for i in small.trials.trial_id} | {TRUTH_FILE}
    for trial in small.trials:
        lines = (folder / f"{trial.trial_id}.csv").read_text().splitlines()
        header = parse_header(lines)
        body = lines.index("time_s,command,position") + 1
        values = np.array([[float(cell) for cell in line.split(",")] for line in lines[body:]])
        assert (header.stiffness, header.damping) == (trial.stiffness, trial.damping)
        assert (header.device, header.experiment, header.grip) == ("falcon", "6", "firm")
        assert (header.step, header.sampling_period_s, header.simulated) == (8.0, 0.001, True)
        assert values.shape == (trial.rows, 3)
        assert np.array_equal(values[:, 0], trial.time)
        assert np.array_equal(values[:, 1], trial.command)
        assert np.array_equal(values[:, 2], trial.position)


def test_truth_says_what_was_simulated(small: SimulatedSweep, tmp_path: Path) -> None:
    write_sweep(small, tmp_path)
    truth = json.loads((tmp_path / "falcon" / "6" / TRUTH_FILE).read_text())
    assert truth["plant"] == {"mass": 1.0, "damping": 34.0, "stiffness": 0.0}
    assert (truth["delay_samples"], truth["jitter_samples"], truth["seed"]) == (4.0, [3, 4, 5], 2)
    assert (truth["quantum"], truth["noise"], truth["edge_row"], truth["complete"]) == (2e-6, 5e-7, 20, True)
    assert list(truth["logs"]) == [f"{name}.csv" for name in small.trials.trial_id]
    first = truth["logs"]["B000_K003600_p1.csv"]
    assert (first["stiffness"], first["damping"], first["verdict"]) == (3600.0, 0.0, small.verdict[0])
    assert first["rows"] == small.trials.rows[0]


@pytest.mark.parametrize(
    ("loop", "hidden", "left_out"),
    [
        ({}, {}, []),
        ({"velocity": {"kind": "foaw", "bound": 1e-5}}, {}, ["velocity"]),
        ({"velocity": {"kind": "levant", "acceleration": 100.0}}, {}, ["velocity"]),
        ({"jitter_samples": (3, 4, 5)}, {}, ["jitter"]),
        ({"friction": {"coulomb": 0.2}, "force_limit": 9.0}, {"one_sided_wall": True, "held_samples": 0.1}, None),
    ],
    ids=["linear", "foaw", "levant", "jitter", "others"],
)
def test_truth_names_what_its_spectral_radius_leaves_out(
    small: SimulatedSweep, tmp_path: Path, loop: dict[str, Any], hidden: dict[str, Any], left_out: list[str] | None
) -> None:
    setup = small.setup.with_loop(**{"jitter_samples": (), "force_limit": None} | loop)
    sweep = replace(small, setup=replace(setup, hidden=SimulationParts(**hidden)))
    write_sweep(sweep, tmp_path)
    truth = json.loads((tmp_path / "falcon" / "6" / TRUTH_FILE).read_text())
    expected = ["friction", "force_limit", "one_sided_wall", "held_samples"] if left_out is None else left_out
    assert truth["spectral_radius_left_out"] == expected


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where its logs go."""
    found = tmp_path / "falcon" / "6"
    found.mkdir(parents=True)
    return found


def test_an_earlier_simulation_is_replaced_only_on_request(small: SimulatedSweep, tmp_path: Path, folder: Path) -> None:
    write_sweep(small, tmp_path)
    own = folder / "my_own.csv"
    own.write_text("recorded by hand")
    with pytest.raises(UsageError, match="overwrite=True"):
        write_sweep(small, tmp_path)
    few = small.trials.select(np.arange(5))
    half = replace(small, trials=few, passes=small.passes[:5], verdict=small.verdict[:5])
    assert write_sweep(half, tmp_path, overwrite=True) == 5
    listed = {f"{name}.csv" for name in few.trial_id}
    assert {p.name for p in folder.iterdir()} == listed | {TRUTH_FILE, own.name}
    assert own.read_text() == "recorded by hand"


def test_a_log_that_is_not_listed_is_never_replaced(small: SimulatedSweep, tmp_path: Path, folder: Path) -> None:
    own = folder / f"{small.trials.trial_id[3]}.csv"
    own.write_text("recorded by hand")
    for overwrite in (False, True):
        with pytest.raises(UsageError, match=own.name):
            write_sweep(small, tmp_path, overwrite=overwrite)
    assert [p.name for p in folder.iterdir()] == [own.name]
    assert own.read_text() == "recorded by hand"


@pytest.mark.parametrize("text", ["{", "[]", '{"logs": 3}', "{}"])
def test_a_foreign_truth_file_stops_the_replacement(
    small: SimulatedSweep, tmp_path: Path, folder: Path, text: str
) -> None:
    (folder / TRUTH_FILE).write_text(text)
    with pytest.raises(UsageError, match="is not a list of simulated logs"):
        write_sweep(small, tmp_path, overwrite=True)
    assert (folder / TRUTH_FILE).read_text() == text


def test_a_listed_path_outside_the_folder_is_left_alone(small: SimulatedSweep, tmp_path: Path, folder: Path) -> None:
    outside = tmp_path / "keep.csv"
    outside.write_text("keep")
    notes = folder / "notes.txt"
    notes.write_text("keep")
    (folder / TRUTH_FILE).write_text(json.dumps({"logs": ["../../keep.csv", str(outside), "notes.txt"]}))
    write_sweep(small, tmp_path, overwrite=True)
    assert outside.exists()
    assert notes.exists()


def test_a_broken_run_leaves_complete_logs_that_the_next_run_replaces(
    small: SimulatedSweep, tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, written = Path.write_bytes, []

    def full_disk(path: Path, data: bytes) -> int:
        written.append(path)
        if len(written) == 8:
            real(path, data[:100])
            raise OSError(28, "No space left on device", str(path))
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(PipelineError, match="No space left"):
        write_sweep(small, tmp_path)
    monkeypatch.undo()
    assert json.loads((folder / TRUTH_FILE).read_text())["complete"] is False
    found = sorted(p.name for p in folder.iterdir() if p.name != TRUTH_FILE)
    assert found == sorted(f"{name}.csv" for name in small.trials.trial_id[:7])  # whole logs, no temporary file
    assert write_sweep(small, tmp_path, overwrite=True) == len(small.trials)
    assert json.loads((folder / TRUTH_FILE).read_text())["complete"] is True


def test_a_device_file_with_all_parts_is_simulated_and_its_truth_holds_them(tmp_path: Path) -> None:
    text = (ROOT / "schemas" / "devices" / "falcon.toml").read_text(encoding="utf-8")
    parts = """
[loop]
velocity = { kind = "butterworth", order = 2, cutoff_hz = 60.0 }
actuator_lag_s = 0.002
mode = { frequency_hz = 40.0, damping_ratio = 0.03, mass = 0.1 }
friction = { coulomb = 0.2 }

[simulation]
lost_rows = 0.02
"""
    file = tmp_path / "own.toml"
    file.write_text(text.replace("\n[[experiment]]", f"{parts}\n[[experiment]]", 1), encoding="utf-8")
    sweep = run_sweep(read_device(file), "1", coarsen=30, duration_s=0.2)
    write_sweep(sweep, tmp_path)
    truth = json.loads((tmp_path / "falcon" / "1" / TRUTH_FILE).read_text())
    assert truth["loop"]["mode"]["frequency_hz"] == 40.0
    assert truth["loop"]["friction"]["coulomb"] == 0.2
    assert truth["simulation"]["lost_rows"] == 0.02
    first = sweep.trials[0]
    lines = (tmp_path / "falcon" / "1" / f"{first.trial_id}.csv").read_text().splitlines()
    stamps = [float(line.split(",")[0]) for line in lines[lines.index("time_s,command,position") + 1 :]]
    assert np.array_equal(stamps, first.time)
    assert max(np.diff(stamps)) > 0.0015


def test_mistakes_in_what_only_the_simulator_knows_are_named_together(tmp_path: Path) -> None:
    text = (ROOT / "schemas" / "devices" / "falcon.toml").read_text(encoding="utf-8")
    file = tmp_path / "wrong.toml"

    def message(table: str) -> str:
        file.write_text(text.replace("\n[[experiment]]", f"\n[simulation]\n{table}\n[[experiment]]", 1))
        with pytest.raises(DeviceError) as found:
            read_device(file)
        return str(found.value)

    several = message("lost_rows = 0.9\nramp_samples = 0\nclock_eror = 0.1\n")
    for key in ("simulation.lost_rows", "simulation.ramp_samples", "simulation.clock_eror"):
        assert key in several
    together = message(
        "lost_rows_hidden = true\nclipped_command_logged = true\nlater_steps = [{time_s=9.0, size=1.0}]\n"
    )
    for key in ("lost_rows_hidden", "clipped_command_logged", "later_steps[1].time_s"):
        assert f"simulation.{key}" in together

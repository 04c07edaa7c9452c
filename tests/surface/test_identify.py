"""From files to a device file: `pipeline.identify`, `pipeline identify`."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from free_masses import DAMPING, DELAY, MASS, T, written
from real_drives import KINDS
from typer.testing import CliRunner

import pipeline
from pipeline.base.errors import LogError, ParameterError
from pipeline.device_data.devices import read_device
from pipeline.measured.stages.stage_device import identification
from pipeline.shell.cli import application
from pipeline.shell.commands.cli_device import identified_lines
from pipeline.surface import identify as surface
from pipeline.surface.identify import wall_loop


@pytest.fixture(scope="module")
def staircase(tmp_path_factory):
    command = np.repeat(np.random.default_rng(2).uniform(-4, 4, 12), 100)
    return written(tmp_path_factory.mktemp("logs") / "free.csv", command, "# motion: translation\n")


@pytest.fixture(scope="module")
def found(staircase):
    return pipeline.identify(staircase)


def test_a_log_without_wall_names_and_period_is_enough(found):
    table = found.estimates.set_index("name")
    assert table.loc["mass", "value"] == pytest.approx(MASS, rel=1e-3)
    assert table.loc["damping", "value"] == pytest.approx(DAMPING, rel=5e-3)
    assert table.loc["delay", "value"] == pytest.approx(DELAY * T, rel=5e-3)
    assert (table["low"] <= table["value"]).all()
    assert (table["value"] <= table["high"]).all()
    assert found.document["replay"]["fit_percent"] > 99


def test_a_wrong_sign_is_an_error_and_no_device(staircase, tmp_path):
    head, names, rows = staircase.read_text().partition("time_s,command,position\n")
    turned = [f"{t},{-float(force)!r},{x}" for t, force, x in (row.split(",") for row in rows.splitlines())]
    (tmp_path / "turned.csv").write_text(head + names + "\n".join(turned) + "\n")
    with pytest.raises(ParameterError, match=r"moves against its command.*`sign`"):
        pipeline.identify(tmp_path / "turned.csv")


def test_of_wall_trials_a_free_run_is_said_to_drift(staircase, found, tmp_path):
    assert found.document["replay"]["behind_walls"] is False
    head, names, rows = staircase.read_text().partition("time_s,command,position\n")
    (tmp_path / "wall.csv").write_text(f"{head}# stiffness: 500\n{names}{rows}")
    document = pipeline.identify(tmp_path / "wall.csv").document
    assert document["replay"]["behind_walls"] is True
    assert "free runs drift" in document["loop"]["reason"]
    assert "drift" not in found.document["loop"]["reason"]


def test_logs_that_are_not_used_are_named_with_their_reason(staircase, tmp_path):
    head, names, rows = staircase.read_text().partition("time_s,command,position\n")
    (tmp_path / "wall.csv").write_text(f"{head}# stiffness: 500\n{names}{rows[: len(rows) // 2]}\n")
    document = pipeline.identify([staircase, tmp_path / "wall.csv"]).document
    (unused,) = document["logs_left_out"]
    assert Path(unused["log"]).name == "free.csv"
    assert "without a wall" in unused["reason"]
    assert any(line.startswith("1 log left out") and "free.csv" in line for line in identified_lines(document))


def test_the_walls_are_those_of_the_linear_loop(found):
    truth = pipeline.Loop(MASS, DAMPING, T, DELAY).boundary().attrs["stiffness_max"]
    top = found.document["boundary"]["stiffness_max"]
    assert top["value"] == pytest.approx(truth, rel=0.02)
    assert found.loop.boundary().attrs["stiffness_max"] == pytest.approx(top["value"], rel=1e-6)


def test_a_device_file_is_one_that_theory_takes(found, tmp_path):
    found.write(tmp_path / "motor.toml")
    device = read_device(tmp_path / "motor.toml")
    (experiment,) = device.experiments
    assert experiment.mass == pytest.approx(MASS, rel=1e-3)
    assert experiment.delay_samples == pytest.approx(DELAY, rel=5e-3)
    assert "95 %" in (tmp_path / "motor.toml").read_text(encoding="utf-8")


def test_a_load_bears_no_more_damping_than_both_sides(found):
    keys = ("frequency_hz", "damping_ratio", "mass", "load_damping", "sensor_at_load")
    mode = {key: {"value": 5.0, "low": 4.0, "high": 6.0} for key in keys}
    document = found.document | {"loop": found.document["loop"] | {"mode": mode}}
    for damping, of_load in ((4.0, 4.0), (-0.1, 0.0), (9.0, 5.0)):
        assert wall_loop(document, mass=6.0, damping=damping).mode.load_damping == of_load


def test_the_command_prints_the_document_and_writes_the_file(staircase, tmp_path):
    out = tmp_path / "motor.toml"
    arguments = ["identify", str(staircase), "--out", str(out), "--json"]
    result = CliRunner().invoke(application("identify"), arguments)
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    device = read_device(out)
    assert document["boundary"]["sampling_period_s"] == device.sampling_period_s
    assert document["boundary"]["delay_samples"] == pytest.approx(device.experiments[0].delay_samples, rel=1e-3)


@pytest.mark.slow
def test_a_device_that_another_force_moves_is_not_predicted(tmp_path):
    random = np.random.default_rng(5)
    command = np.repeat(random.uniform(-0.3, 0.3, 12), 50)
    hand = np.repeat(random.uniform(-4, 4, 60), 10)
    log = written(tmp_path / "held.csv", command + hand)
    rows = [line.split(",") for line in log.read_text(encoding="utf-8").splitlines()[1:]]
    lines = [f"{t},{own!r},{x}" for (t, _, x), own in zip(rows, command.tolist(), strict=True)]
    log.write_text("time_s,command,position\n" + "\n".join(lines) + "\n", encoding="utf-8")
    found = pipeline.identify(log)
    assert not found.document["loop"]["adequate"]
    said = CliRunner().invoke(application("identify"), ["identify", str(log)])
    assert "is not explained by the command" in said.output
    mass = found.estimates.set_index("name").loc["mass"]
    assert np.isnan(mass["value"]) or mass["low"] <= MASS <= mass["high"]


def test_a_constant_command_gives_no_device_file(tmp_path):
    log = written(tmp_path / "pushed.csv", np.full(400, 2.0))
    found = pipeline.identify(log)
    assert found.loop is None
    assert "delay" in found.document["assumed_none"]
    with pytest.raises(ParameterError, match="delay"):
        found.write(tmp_path / "no.toml")
    assert not (tmp_path / "no.toml").exists()


def test_steps_that_noise_hides_are_asked_for_larger_and_not_for_again(tmp_path):
    logs = [
        written(tmp_path / f"{i}.csv", np.append(np.zeros(30), np.full(270, size)), noise=0.01, seed=i)
        for i, size in enumerate((2.0, -2.0, 4.0, -4.0))
    ]
    found = pipeline.identify(logs)
    assert "delay" not in found.document["assumed_none"]
    with pytest.raises(ParameterError, match="To identify the delay, record larger steps"):
        found.write(tmp_path / "no.toml")


def test_a_refused_log_is_named(tmp_path):
    log = tmp_path / "bad.csv"
    log.write_text(
        "# motion: rotation\ntime_s,command,position\n0,1,0\n0.001,x,0\n0.002,1,0\n0.003,1,0\n", encoding="utf-8"
    )
    with pytest.raises(LogError, match=r"bad\.csv, row 4: .*number"):
        pipeline.identify(log)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({9: "abc,1,0"}, "row 11: time_s must be a number, found 'abc'"),
        ({9: "0.009,1,oops"}, "row 11: position must be a number, found 'oops'"),
        ({row: f"x{row},0,0" for row in range(50)}, "row 2: time_s must be a number, found 'x0'"),
    ],
)
def test_an_unreadable_number_of_a_log_without_header_is_named_with_its_row(tmp_path, changed, expected):
    rows = [changed.get(row, f"{row * 1e-3:g},1,{1e-6 * row**2:g}") for row in range(50)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time_s,command,position", *rows]) + "\n")
    with pytest.raises(LogError, match=re.escape(expected)):
        pipeline.identify([path])


@pytest.mark.slow
def test_identify_and_compare_give_equal_numbers_from_the_same_logs(noisy):
    """Whatever the order of the logs: both take the same rows of each, and rank them by walls and samples."""
    stored, _ = identification(noisy.stages("1"))
    logs = sorted(noisy.raw.rglob("*.csv"))
    for paths in (logs, logs[::-1]):
        result = pipeline.identify(paths).evidence.identification
        assert result.parameters == stored.parameters
        assert result.parts == stored.parts
        assert result.choice.fit.device.noise == stored.choice.fit.device.noise
        np.testing.assert_array_equal(result.covariance, stored.covariance)


@pytest.mark.parametrize("moved", [1, -1])
def test_walls_whose_command_is_that_of_another_row_are_refused(tmp_path, moved):
    """Their delay would be wrong by a sample, and the limit with it: `compare` names no wall, either."""
    logs = []
    for number, (K, B) in enumerate([(300.0, 5.0), (500.0, 8.0), (700.0, 11.0)]):
        x, v, command = np.zeros(401), 0.0, np.zeros(400)
        for row in range(400):
            step = 4.0 * (row >= 20)
            command[row] = step - K * x[row] - B * (x[row] - x[max(row - 1, 0)]) / T
            force = command[max(row - DELAY, 0)]
            x[row + 1], v = x[row] + T * v + 0.5 * T**2 * force / MASS, v + T * (force - DAMPING * v) / MASS
        rows = np.stack([T * np.arange(398), np.roll(command, moved)[1:399], x[1:399]], axis=1).tolist()
        header = (
            f"# device: arm\n# experiment: 1\n# stiffness: {K}\n# damping: {B}\n# step: 4\n# sampling_period_s: {T}\n"
        )
        lines = [",".join(map(repr, row)) for row in rows]
        logs.append(tmp_path / f"{number}.csv")
        logs[-1].write_text("\n".join([header + "time_s,command,position", *lines, ""]))
    expected = r"shifted by rows relative to the position|follows the wall law with the position"
    with pytest.raises(ParameterError, match=expected):
        pipeline.identify(logs)


def test_a_file_that_no_profile_reads_is_named_and_the_others_are_identified(tmp_path):
    for number, size in enumerate((2.0, -2.0, 4.0)):
        written(tmp_path / f"{number}.csv", np.append(np.zeros(30), np.full(270, size)), seed=number)
    (tmp_path / "notes.xyz").write_text("no log")
    (tmp_path / "lab.toml").write_text("no log")
    found = pipeline.identify(tmp_path).document
    assert found["trials"] == 3
    assert [Path(each["path"]).name for each in found["refused"]] == ["notes.xyz"]
    shown = CliRunner().invoke(application("identify"), ["identify", str(tmp_path)])
    assert shown.exit_code == 3
    assert "notes.xyz: no profile claims a file of this name" in shown.output
    assert CliRunner().invoke(application("identify"), ["identify", str(tmp_path), "--ignore", "*.xyz"]).exit_code == 0
    with pytest.raises(LogError, match=r"notes\.xyz: no profile claims"):
        pipeline.identify(tmp_path / "notes.xyz")


def test_a_copy_of_a_log_counts_once_and_is_named(tmp_path):
    for number, size in enumerate((2.0, -2.0, 4.0)):
        written(tmp_path / f"{number}.csv", np.append(np.zeros(30), np.full(270, size)), seed=number)
    alone = pipeline.identify(tmp_path).document
    (tmp_path / "copy.csv").write_bytes((tmp_path / "1.csv").read_bytes())
    found = pipeline.identify(tmp_path).document
    assert (found["trials"], [Path(name).name for name in found["copies"]]) == (3, ["copy.csv"])
    assert found["parameters"] == alone["parameters"]
    shown = CliRunner().invoke(application("identify"), ["identify", str(tmp_path)])
    assert "1 log with the same samples as another log counts only once" in shown.output


def test_a_refused_log_among_others_is_named_once(tmp_path):
    for number, size in enumerate((2.0, -2.0, 4.0)):
        written(tmp_path / f"{number}.csv", np.append(np.zeros(30), np.full(270, size)), seed=number)
    bad = written(tmp_path / "bad.csv", np.full(40, 2.0))
    bad.write_text(bad.read_text().replace("2.0,", "x,", 1))
    shown = CliRunner().invoke(application("identify"), ["identify", str(tmp_path)])
    (line,) = (line for line in shown.output.splitlines() if line.startswith("Refused"))
    assert line.count("bad.csv") == 1
    assert "found 'x'" in line


@pytest.mark.slow
def test_an_arm_swings_under_gravity(tmp_path):
    rig, logs = KINDS["arm under gravity"](4)
    for log in logs:
        rows = "\n".join(
            f"{float(t)!r},{float(u)!r},{float(x)!r}"
            for t, u, x in zip(log.time, log.command, log.position, strict=True)
        )
        (tmp_path / f"{log.name}.csv").write_text(
            f"# motion: rotation\ntime_s,command,position\n{rows}\n", encoding="utf-8"
        )
    found = pipeline.identify(tmp_path)
    document, page = found.document, tmp_path / "arm.html"
    found.write_report(page)
    assert "The device would hang at rest at" in page.read_text(encoding="utf-8")
    for name, value in (("torque", rig.gravity), ("angle", 0.0)):
        number = document["gravity"][name]
        assert number["low"] <= value <= number["high"], name
    assert document["gravity"]["torque"]["high"] < 1.02 * rig.gravity
    assert "gravity" in document["left_out"]
    assert "Gravity acts with up to" in "\n".join(identified_lines(document))
    assert "# Omitted: gravity of" in surface.device_text(document, "arm")

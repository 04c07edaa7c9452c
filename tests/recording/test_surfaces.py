"""The same sentence about a fault of a recording on every surface, and no limit on any where it is unsafe."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from any_experiment import Rig, Trial, recorded
from served import page, serving

import pipeline
from pipeline.service.settings import Settings
from pipeline.shell.cli import run as run_here

RIG = Rig(mass=0.5, damping=3.0, delay=2.4, noise=1e-6)
WALLS = [(500.0, 5.0), (1500.0, 20.0), (3000.0, 20.0), (9000.0, 20.0)]

PROFILE = """name = "lab"
format = "delimited"
files = ["*.csv"]
decimal = "."
comment = "#"
step_at = "command edge"
name_pattern = 'K(?P<stiffness>[0-9]+)_B(?P<damping>[0-9]+)'
[columns]
time = { name = "time_s", unit = "s" }
command = { name = "command", unit = "N", sign = 1 }
position = { name = "position", unit = "m", sign = 1 }
[constants]
device = "dev"
experiment = "1"
step = 4
sampling_period_s = 0.001
"""


def late(time, command, position):
    return time, np.concatenate([np.zeros(15), command[:-15]]), position


def joined(time, command, position):
    rows = np.arange(len(time))
    return time, command, np.interp(rows, rows[::4], position[::4])


def frozen(time, command, position):
    x = position.copy()
    first = int(np.abs(np.diff(x)).argmax()) - 2
    x[first : first + 12] = x[first]
    return time, command, x


def lost(time, command, position):
    kept = ~np.isin(np.arange(len(time)), [100, 101, 180])
    return time[kept], command[kept], position[kept]


def wrapped(time, command, position):
    """Turn the sensor so that the motion crosses the end of its turn."""
    return time, command, np.mod(position - position[0] - 0.3 * np.abs(position - position[0]).max(), 2 * np.pi)


def stopped(time, command, position):
    x = position.copy()
    first = int(np.argmax(x - x[0] > 0.6 * (x - x[0]).max()))
    x[first:] = x[first]
    return time, command, x


def repeated(time, command, position):
    """Repeat every seventh row."""
    source = np.arange(len(time))
    source[7::7] -= 1
    return time, command[source], position[source]


FAULTS = {
    "none": lambda t, u, x: (t, u, x),
    "noncausal": late,
    "sampling_period": lambda t, u, x: (t, u, x),
    "interpolated_rows": joined,
    "frozen_position": frozen,
    "wrong_sign": lambda t, u, x: (t, u, -x),
    "constant_position": lambda t, u, x: (t, u, 0 * x),
    "too_few_rows": lambda t, u, x: (t[:6], u[:6], x[:6]),
    "missing_rows": lost,
    "wrapped_angle": wrapped,
    "travel_stop": stopped,
    "repeated_rows": repeated,
    "coarse_sensor": lambda t, u, x: (t, u, np.round(x / 2e-3) * 2e-3),
}
"""By code: what it makes of the columns of a log."""

ROTATING = {"wrapped_angle"}
"""Faults of angles."""

STATED = {"sampling_period": 0.0005}
"""Sampling period that headers and profile state, where it is another one [s]."""

UNSAFE = {"noncausal", "sampling_period", "interpolated_rows", "frozen_position", "wrong_sign"}


def call(*arguments):
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as leaving:
        run_here([str(each) for each in arguments])
    return int(leaving.value.code or 0), out.getvalue(), err.getvalue()


def document(*arguments):
    status, out, err = call(*arguments, "--json")
    assert status in {0, 3}, err
    return json.loads(out)


def profile_for(code):
    text = PROFILE.replace("0.001", str(STATED.get(code, 0.001)))
    if code not in ROTATING:
        return text
    return text.replace('"N"', '"Nm"').replace('"m"', '"rad"') + 'motion = "rotation"\n'


def logs_with(code, folder, *, rotating=False):
    """Write the logs of a fault, natively and for the profile of a lab; return both folders."""
    folder.mkdir(exist_ok=True)
    native, plain, period = folder / "logs", folder / "lab", STATED.get(code, 0.001)
    motion = {"motion": "rotation" if rotating or code in ROTATING else "translation"}
    native.mkdir()
    plain.mkdir()
    for i, (K, B) in enumerate(WALLS):
        time, command, position = FAULTS[code](*recorded(RIG, Trial(K, B, 4.0, rows=260, edge=40), i))
        rows = [",".join(map(repr, row)) for row in zip(*(c.tolist() for c in (time, command, position)), strict=True)]
        head = {
            "device": "dev",
            "experiment": "1",
            "stiffness": K,
            "damping": B,
            "step": 4.0,
            "sampling_period_s": period,
            **motion,
        }
        lines = ["time_s,command,position", *rows, ""]
        (native / f"{i}.csv").write_text("\n".join([*(f"# {key}: {value}" for key, value in head.items()), *lines]))
        (plain / f"K{K:.0f}_B{B:.0f}.csv").write_text("\n".join(lines))
    return native, plain


@pytest.mark.parametrize(
    "code",
    [
        "noncausal",
        *(pytest.param(code, marks=pytest.mark.slow) for code in FAULTS if code not in {"noncausal", "none"}),
    ],
)
def test_a_fault_is_told_alike_on_every_surface(code, tmp_path):
    native, plain = logs_with(code, tmp_path)
    store, first = ["--processed", str(tmp_path / "processed")], native / "0.csv"
    (finding,) = [each for each in pipeline.read_log(first).attrs["findings"] if each.code == code]
    sentence = finding.sentence
    assert finding.is_unsafe == (code in UNSAFE)

    warnings = document("ingest", native, *store)["warnings"]
    assert (code, sentence) in {(each["code"], each["warning"]) for each in warnings}
    assert sentence in call("look", first, "--out", tmp_path / "look.html")[1]
    (tmp_path / "lab.toml").write_text(profile_for(code))
    status, out, _ = call("profile", "check", tmp_path / "lab.toml", plain / "K500_B5.csv")
    assert status in {0, 1}  # 1 where the command obeys another wall, too
    assert sentence in out

    status, out, err = call("identify", native, "--json")
    assert sentence in err or sentence in {each["sentence"] for each in json.loads(out)["findings"]}
    compared = document("compare", "--device", "dev", *store, "--report", tmp_path / "report.html")
    (experiment,) = compared["experiments"]
    assert (code, sentence) in {(each["code"], each["sentence"]) for each in experiment["recording"]}
    status_of_plan, plan, why = call("plan", "--device", "dev", "--json", *store)
    trial = pipeline.trials(tmp_path / "processed")["trial_id"][0]
    with serving(Settings(tmp_path / "processed", tmp_path / "reports", renew=False)) as client:
        about = client.get(f"trials/{trial}").content
        shown = page(client, f"/trials/{trial}")
        _answer, job = client.upload([("again.csv", first.read_bytes().replace(b": dev", b": other"))])
    assert code in {each["code"] for each in about["findings"]}
    assert about["findings"][0]["sentence"].split("'")[0] in shown
    assert (code, sentence) in {(each["code"], each["warning"]) for each in job["result"]["warnings"]}

    if code in UNSAFE - {"frozen_position"}:  # which costs the logs that have it
        assert status == 1
        assert experiment["causes"][0]["code"] == code
        assert experiment["loop_boundary"] is None
        assert experiment["passive"] is None
        assert all(each["value"] is None for each in experiment["estimates"].values())
        assert all(point["estimate"] is None and point["stable"] is None for point in experiment["boundary"])
        assert (compared["answer"]["wall"], compared["answer"]["next"]) == (None, None)
        assert (status_of_plan, plan) == (1, "")
        assert finding.remedy in why
        assert sentence in (tmp_path / "report.html").read_text().replace("&#39;", "'").replace(
            "\N{NO-BREAK SPACE}", " "
        )


@pytest.mark.slow
def test_the_numbers_of_a_repaired_recording_are_those_of_the_clean_one(tmp_path):
    experiments = {}
    for code in ("none", "wrapped_angle"):
        native, _ = logs_with(code, tmp_path / code, rotating=True)
        store = ["--processed", str(tmp_path / code / "processed")]
        warnings = document("ingest", native, *store)["warnings"]
        assert {each["code"] for each in warnings} == ({code} - {"none"})
        (experiments[code],) = document("compare", "--device", "dev", *store)["experiments"]
    clean, repaired = experiments["none"], experiments["wrapped_angle"]
    estimates = {name: each for name, each in clean["estimates"].items() if each["value"] is not None}
    assert {"delay_samples", "mass", "damping"} <= set(estimates)
    for name, estimate in estimates.items():
        assert estimate["low"] <= repaired["estimates"][name]["value"] <= estimate["high"]
    assert len(clean["loop_boundary"]) == len(repaired["loop_boundary"]) > 0
    for one, other in zip(clean["loop_boundary"], repaired["loop_boundary"], strict=True):
        assert one["low"] <= other["stiffness"] <= one["high"]
    assert repaired["verdicts"] == clean["verdicts"]


def test_one_wrong_log_among_good_ones_costs_that_log(tmp_path):
    native, _ = logs_with("none", tmp_path)
    found = document("identify", native)
    rows = late(*recorded(RIG, Trial(800.0, 10.0, 4.0, rows=260, edge=40), 9))
    text = (native / "0.csv").read_text().split("time_s")[0].replace("500.0", "800.0").replace("5.0", "10.0")
    lines = [",".join(map(repr, row)) for row in zip(*(c.tolist() for c in rows), strict=True)]
    (native / "late.csv").write_text("\n".join([f"{text}time_s,command,position", *lines, ""]))
    (native / "broken.csv").write_text((native / "1.csv").read_text().replace("stiffness: 1500.0", "stiffness: soft"))
    status, out, _err = call("identify", native, "--json")
    again = json.loads(out)
    assert status == 3
    assert [Path(each["path"]).name for each in again["refused"]] == ["broken.csv"]
    assert "noncausal" in {each["code"] for each in again["findings"]}
    assert again["trials"] == found["trials"]
    mass = [next(row["value"] for row in each["parameters"] if row["name"] == "mass") for each in (found, again)]
    assert mass[0] == pytest.approx(mass[1], rel=1e-9)


@pytest.mark.parametrize("text", ["unwrap = true", "unwrap = 360"])
def test_a_profile_states_the_modulus_of_an_angle(text, tmp_path):
    turned = np.concatenate([np.zeros(40), 0.02 * np.arange(160.0) ** 2])
    rows = [f"{k / 1000},{4.0 * (k >= 40)},{x % 360}" for k, x in enumerate(turned)]
    (tmp_path / "K0_B0.csv").write_text("\n".join(["time_s,command,position", *rows, ""]))
    profile = PROFILE.replace('unit = "m", sign = 1', f'unit = "deg", sign = 1, {text}').replace('"N"', '"Nm"')
    (tmp_path / "lab.toml").write_text(profile + 'motion = "rotation"\n')
    log = pipeline.read_log(tmp_path / "K0_B0.csv", profile=tmp_path / "lab.toml")
    assert log["position"].to_numpy() == pytest.approx(np.deg2rad(turned), abs=1e-9)
    assert [each.code for each in log.attrs["findings"]] == ["wrapped_angle"]


def test_the_same_samples_under_another_header_are_noted(tmp_path):
    native, _ = logs_with("none", tmp_path)
    (native / "copy.csv").write_text((native / "1.csv").read_text().replace("stiffness: 1500.0", "stiffness: 1501.0"))
    warnings = document("ingest", native, "--processed", tmp_path / "processed")["warnings"]
    (warning,) = [each for each in warnings if each["code"] == "same_samples"]
    assert Path(warning["path"]).name == "copy.csv"
    assert "1.csv" in warning["warning"]
    assert [each["code"] for each in document("identify", native)["findings"]] == ["same_samples"]


def test_a_frozen_position_in_one_log_leaves_the_others(tmp_path):
    native, _ = logs_with("none", tmp_path)
    whole = document("identify", native)
    time, command, position = frozen(*recorded(RIG, Trial(1500.0, 20.0, 4.0, rows=260, edge=40), 1))
    head = (native / "1.csv").read_text().split("time_s")[0]
    lines = [",".join(map(repr, row)) for row in zip(time.tolist(), command.tolist(), position.tolist(), strict=True)]
    (native / "1.csv").write_text("\n".join([f"{head}time_s,command,position", *lines, ""]))
    found = document("identify", native)
    assert found["trials"] == whole["trials"] - 1
    assert {each["code"] for each in found["findings"]} == {"frozen_position"}

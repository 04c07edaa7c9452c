"""Shipped devices against the published parameters; a wrong file is refused, every wrong field named."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from places import SHARED

from pipeline import Loop
from pipeline.base.errors import DeviceError
from pipeline.base.provenance import USER_FOLDER_VARIABLE, schema_folder
from pipeline.device_data.devices import find_experiment, known_devices, load_device, read_device
from pipeline.simulation import tested_grid as grids

TABLES = SHARED / "reference" / "tables"
FALCON = schema_folder() / "devices" / "falcon.toml"


def altered(tmp_path: Path, *changes: tuple[str, str], name: str = "falcon.toml") -> Path:
    text = FALCON.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_the_shipped_devices_are_known() -> None:
    devices = known_devices()
    assert list(devices) == ["falcon", "falcon-real", "lwr"]
    assert [e.name for e in devices["falcon"].experiments] == list("1234567")
    assert [e.name for e in devices["lwr"].experiments] == [f"delay-{d}" for d in range(2, 9)]
    assert devices["lwr"].motion == "rotation"
    assert "hypothesis" in devices["falcon-real"].title


@pytest.mark.skipif(not TABLES.is_dir(), reason="published tables (../shared) are not here")
def test_parameters_are_those_of_table_6_2() -> None:
    with (TABLES / "6_2_device_parameters.csv").open() as stream:
        published = list(csv.DictReader(stream))
    checked = 0
    for row in published:
        device = load_device("lwr" if row["device"] == "lwr" else "falcon")
        names = [e.name for e in device.experiments] if row["experiments"] == "lwr" else row["experiments"].split(";")
        for name in names:
            experiment = find_experiment(device, name)
            known = float(row["mass"]), float(row["damping"]), row["grip"]
            assert (experiment.mass, experiment.damping, experiment.grip) == known
            checked += 1
    assert checked == 14


@pytest.mark.skipif(not TABLES.is_dir(), reason="published tables (../shared) are not here")
def test_tables_name_the_published_criteria_and_experiments() -> None:
    with (TABLES / "D_experiments.csv").open() as stream:
        rows = [r for r in csv.DictReader(stream) if not r["condition"].startswith("theory")]
    layouts = {t.name: t for name in ("falcon", "lwr") for t in load_device(name).tables}
    for table in sorted({r["table"] for r in rows}):
        published = [r for r in rows if r["table"] == table]
        assert set(layouts[table].criteria) == {r["criterion"] for r in published}
        numbered = {r["condition"] for r in published if r["condition"].startswith("experiment_")}
        if numbered:
            assert {f"experiment_{e}" for e in layouts[table].experiments} == numbered


def test_delay_in_samples_contains_the_added_delay() -> None:
    for experiment in load_device("lwr").experiments:
        assert experiment.delay_samples == 2 + experiment.added_delay_samples == float(experiment.name[-1])
        assert experiment.jitter_samples == ()


def test_an_unknown_device_or_experiment_lists_the_known_ones() -> None:
    with pytest.raises(DeviceError, match=r"'omega' is not known; known devices are falcon, falcon-real, lwr"):
        load_device("omega")
    with pytest.raises(DeviceError, match=r"no experiment '8'; it has 1, 2, 3, 4, 5, 6, 7"):
        find_experiment(load_device("falcon"), "8")


def test_a_users_device_joins_and_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    altered(tmp_path, ('name = "falcon"', 'name = "mine"'), name="mine.toml")
    altered(tmp_path, ("step = 8.0", "step = 5.0"))
    monkeypatch.setenv(USER_FOLDER_VARIABLE, str(tmp_path))
    assert list(known_devices()) == ["falcon", "falcon-real", "lwr", "mine"]
    assert load_device("falcon").step == 5.0
    monkeypatch.setenv(USER_FOLDER_VARIABLE, str(tmp_path / "missing"))
    with pytest.raises(DeviceError, match=rf"missing: {USER_FOLDER_VARIABLE} must name a folder"):
        known_devices()


def test_two_files_of_one_name_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    altered(tmp_path, name="a.toml")
    altered(tmp_path, name="b.toml")
    monkeypatch.setenv(USER_FOLDER_VARIABLE, str(tmp_path))
    with pytest.raises(DeviceError, match=r"b\.toml: field name: found 'falcon', which a\.toml also defines"):
        known_devices()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("mass = 0.58", "mass = -1.0"), r"experiment\[1\]\.mass \(experiment '1'\): found -1\.0; .*greater than 0"),
        (("mass = 0.58", 'mass = "0.58"'), r"experiment\[1\]\.mass .*found '0\.58'; .*valid number"),
        (("step = 8.0", "step = true"), r"step: found True; .*valid number"),
        (("mass = 0.58\n", ""), r"experiment\[1\]\.mass .*found nothing; field required"),
        (("travel = 0.05", "travle = 0.05"), r"limits\.travle: found 0\.05; Extra"),
        (("step = 8.0", "step = nan"), r"step: found nan; .*finite number"),
        (('grip = "none"', 'grip = "soft"'), r"experiment\[1\]\.grip .*found 'soft'; .*'comfortable'"),
        (("damping_last = 184.0", "damping_last = -4.0"), r"experiment\[1\] .*damping_last \(-4\.0\) is below"),
        (("delay_samples = 4", "delay_samples = -4"), r"experiment\[1\]\.delay_samples .*found -4; "),
        (("jitter_samples = [3, 4, 5]", "jitter_samples = [3, 4.5]"), r"jitter_samples\[2\] .*found 4\.5; "),
        (('name = "2"', 'name = "1"'), r"entire file: experiment names must be unique.*'1'"),
        (
            ('theory_from = "1"', 'theory_from = "9"'),
            r"table D\.1 names experiments that are not defined: \['9'\]",
        ),
        (('"overshoot"]', '"overshot"]'), r"table\[1\] \(table 'D\.1'\): unknown criteria \['overshot'\]"),
        (("baseline_s = 0.02", "baseline_s = 0.5"), r"baseline_s \(0\.5\) must be shorter"),
        (("[sensor]", "[sensor"), r"not valid TOML"),
    ],
)
def test_a_wrong_file_is_refused_with_field_found_and_reason(
    tmp_path: Path, change: tuple[str, str], expected: str
) -> None:
    with pytest.raises(DeviceError, match=expected) as refused:
        read_device(altered(tmp_path, change))
    assert str(tmp_path / "falcon.toml") in str(refused.value)


def test_all_wrong_fields_are_named_at_once(tmp_path: Path) -> None:
    path = altered(tmp_path, ("mass = 0.58", "mass = 0"), ("travel = 0.05", "travel = -1"), ("quantum = 2e-6", "q = 1"))
    with pytest.raises(DeviceError, match=r"3 field\(s\)") as refused:
        read_device(path)
    for field in (r"experiment[1].mass", "limits.travel", "sensor.q"):
        assert field in str(refused.value)


def test_a_copied_file_that_bears_the_old_name_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    altered(tmp_path, name="mine.toml")
    monkeypatch.setenv(USER_FOLDER_VARIABLE, str(tmp_path))
    with pytest.raises(DeviceError, match=r"mine\.toml: field name: found 'falcon', expected 'mine'; correct it"):
        load_device("mine")
    with pytest.raises(DeviceError, match=r'Put a device file \(\.toml\) with name = "other" into a folder'):
        load_device("other")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"none\.toml: device file cannot be read \(No such file"):
        read_device(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("place", "with_it"),
    [
        ("[limits]", "[controller]\nvelocity_filter_s = 0.004\n\n[limits]"),
        ("[limits]", "[loop]\nvelocity_filter_s = 0.004\n\n[limits]"),
        ("[[experiment]]", "[[experiment]]\nvelocity_filter_s = 0.004"),
    ],
)
def test_the_former_filter_is_refused_with_what_replaced_it(tmp_path: Path, place: str, with_it: str) -> None:
    path = altered(tmp_path, (place, with_it))
    with pytest.raises(DeviceError, match=r"(?s)1 field\(s\).*velocity_filter_s has been replaced: .*butterworth"):
        read_device(path)


def test_four_numbers_are_a_device_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text("mass = 0.5\ndamping = 3.0\nsampling_period_s = 0.001\ndelay_samples = 2.4\n", encoding="utf-8")
    device = read_device(path)
    assert (device.name, device.title, device.duration_s) == ("arm", "arm", 1.0)
    (experiment,) = device.experiments
    assert (experiment.mass, experiment.damping, experiment.delay_samples) == (0.5, 3.0, 2.4)
    grid = grids.tested_grid(device, experiment)
    largest = Loop(0.5, 3.0, 0.001, 2.4).boundary().attrs["stiffness_max"]
    assert 20 <= largest / grid.stiffness_step <= 80
    path.write_text("damping = 3.0\ndelay_samples = 2.4\n", encoding="utf-8")
    with pytest.raises(DeviceError, match=r"(?s)sampling_period_s: found nothing.*experiment\[1\]\.mass"):
        read_device(path)


def test_other_toml_files_beside_device_files_are_left_alone(tmp_path, monkeypatch):
    (tmp_path / "mine.toml").write_text("mass = 0.2\ndamping = 1\nsampling_period_s = 0.001\ndelay_samples = 2\n")
    profile = (schema_folder() / "profiles" / "simulink.toml").read_text()
    for name, text in (("lab.toml", profile), ("pyproject.toml", '[project]\nname = "x"\n'), ("empty.toml", "")):
        (tmp_path / name).write_text(text)
    monkeypatch.setenv(USER_FOLDER_VARIABLE, str(tmp_path))
    if_empty = "empty.toml: invalid device file"
    with pytest.raises(DeviceError, match=if_empty):
        known_devices()
    (tmp_path / "empty.toml").unlink()
    assert "mine" in known_devices()
    assert {"lab", "x", "pyproject"}.isdisjoint(known_devices())
    # a device file with a mistake is named
    (tmp_path / "wrong.toml").write_text("masss = 0.2\nsampling_period_s = 0.001\n")
    with pytest.raises(DeviceError, match=r"wrong\.toml: invalid device file"):
        known_devices()

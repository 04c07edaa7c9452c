"""`pipeline identify --force`: device and drive from logs with a measured force."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from force_rigs import MASS, ForceRig, write_logs
from typer.testing import CliRunner

import pipeline
from pipeline.device_data.devices import read_device
from pipeline.rendering.report.report_parts import take_apart
from pipeline.shell.cli import application
from pipeline.surface.identify import with_forces

COLUMNS = ("--time", "t:s", "--position", "x:m", "--json")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    return write_logs(ForceRig(rows=500).logs(3), tmp_path_factory.mktemp("logs"))


def document_of(*arguments):
    result = CliRunner().invoke(application("identify"), ["identify", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def document(logs, pages):
    outputs = ("--report", pages / "motor.html", "--out", pages / "motor.toml")
    return document_of(logs, *COLUMNS, "--command", "u:N", "--force", "f:N", *outputs)


@pytest.fixture(scope="module")
def rows(document):
    return {row["name"]: row for row in document["parameters"]}


def test_parameters_are_those_of_device_and_drive(document, rows):
    for name, truth in (("mass", MASS), ("force_gain", 0.8), ("actuator_lag", 3e-3), ("delay", 1.4e-3)):
        assert rows[name]["told"]
        assert rows[name]["low"] <= truth <= rows[name]["high"], name
    assert document["measured_force"]["reason"] is None
    assert document["measured_force"]["fit_percent"] > 95


def test_walls_are_those_of_the_command(document, logs, pages):
    alone = document_of(logs, *COLUMNS, "--command", "u:N")
    assert alone["measured_force"] is None
    assert "force_gain" not in {row["name"] for row in alone["parameters"]}
    walls, expected = (each["boundary"]["stiffness_max"] for each in (document, alone))
    assert walls["low"] <= expected["value"] <= walls["high"]
    assert document["loop"]["mass"]["value"] == pytest.approx(MASS / 0.8, rel=1e-2)
    device = read_device(pages / "motor.toml")
    assert device.experiments[0].mass == pytest.approx(MASS / 0.8, rel=1e-2)
    assert "Force per unit of the command" in (pages / "motor.toml").read_text(encoding="utf-8")


def test_the_page_names_force_gain_and_methods(pages):
    page = (pages / "motor.html").read_text(encoding="utf-8")
    cells = take_apart(page).cells
    assert "measured force" in cells["parameters/force_gain/method"]
    assert "likelihood" in cells["parameters/mass/method"]
    assert "by measured force" in page


def test_a_command_in_volts_has_a_gain_in_newtons_per_volt(logs):
    document = document_of(logs, *COLUMNS, "--command", "u:V", "--force", "f:N")
    rows = {row["name"]: row for row in document["parameters"]}
    assert rows["force_gain"]["unit"] == "N/V"
    assert rows["mass"]["unit"] == "kg"
    assert rows["mass"]["low"] <= MASS <= rows["mass"]["high"]
    assert document["motion"] == "translation in V"


def test_the_profile_key_is_the_option(logs, tmp_path):
    saved = tmp_path / "bench.toml"
    first = document_of(logs, *COLUMNS, "--command", "u:N", "--force", "f:N", "--save-profile", saved)
    found = pipeline.identify(logs, saved)
    assert found.document["parameters"] == first["parameters"]
    assert first["measured_force"]["used"]


def test_a_force_that_does_not_move_the_device_is_named_and_not_used(tmp_path):
    random, made = np.random.default_rng(1), ForceRig(rows=500).logs(2)
    hand = [replace(each, force=np.cumsum(0.1 * random.standard_normal(len(each.force)))) for each in made]
    folder = write_logs(hand, tmp_path / "logs")
    document = document_of(folder, *COLUMNS, "--command", "u:N", "--force", "f:N", "--report", tmp_path / "page.html")
    rows = {row["name"]: row for row in document["parameters"]}
    assert not document["measured_force"]["used"]
    assert rows["mass"]["value"] == pytest.approx(MASS / 0.8, rel=5e-3)
    assert not rows["force_gain"]["told"]
    assert rows["force_gain"]["reason"] == document["measured_force"]["reason"]
    assert "measured force" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_the_force_is_used_only_if_each_log_has_it():
    first, second = ForceRig(rows=200).logs(2)
    plain = [replace(each, force=None) for each in (first, second)]
    logs = {each.name: SimpleNamespace(time=each.time, force=each.force) for each in (first, second)}
    assert all(each.force is not None for each in with_forces(plain, list(logs.items())))
    logs[second.name].force = None
    assert all(each.force is None for each in with_forces(plain, list(logs.items())))


def test_a_force_column_that_is_absent_or_in_another_unit_is_refused(logs):
    for text, words in (("g:N", "g"), ("f:mm", "expected")):
        arguments = ["identify", str(logs), *COLUMNS[:-1], "--command", "u:N", "--force", text]
        result = CliRunner().invoke(application("identify"), arguments)
        assert result.exit_code != 0
        assert words in str(result.exception)

"""`check` names what is wrong with a machine, and what to do."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from pipeline.shell import cli, installation
from pipeline.shell.installation import examine


def states(checks):
    return {check.name: check.state for check in checks}


def test_a_machine_that_passes_its_tests_lacks_nothing_that_is_needed(tmp_path):
    found = states(examine(tmp_path / "processed"))
    assert "wrong" not in found.values()
    assert {"numpy", "pyarrow", "pandas", "typer", "writing and locks", "MATLAB 7.3 files"} <= set(found)
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"


def test_an_old_or_missing_package_comes_with_its_remedy(tmp_path, monkeypatch):
    real = importlib.metadata.version

    def version(name: str) -> str:
        if name == "mat-io":
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.26.4" if name == "numpy" else real(name)

    monkeypatch.setattr(installation, "version", version)
    found = {check.name: check for check in examine(tmp_path)}
    assert (found["numpy"].state, found["numpy"].help) == ("wrong", "pip install 'numpy>=2.0'")
    assert "1.26.4" in found["numpy"].found
    assert found["MATLAB 7.3 files"].state == "missing"
    assert found["MATLAB 7.3 files"].help == "pip install '.[mat]' in the project's folder"


def test_a_disk_without_permission_is_wrong(tmp_path, monkeypatch):
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path))

    monkeypatch.setattr(installation.tempfile, "TemporaryDirectory", refused)
    found = {check.name: check for check in examine(tmp_path / "a" / "b")}
    assert found["writing and locks"].state == "wrong"
    assert "--processed" in found["writing and locks"].help


def test_a_device_file_that_cannot_be_read_is_named(tmp_path, monkeypatch):
    (tmp_path / "bad.toml").write_text('name = "bad"\n')
    monkeypatch.setenv("PIPELINE_DEVICES", str(tmp_path))
    result = CliRunner().invoke(cli.app, ["check", "--processed", str(tmp_path), "--json"])
    assert result.exit_code == 1
    found = {check["name"]: check for check in json.loads(result.stdout)["installation"]}
    assert found["devices"]["state"] == "wrong"
    assert "bad.toml" in found["devices"]["found"]


@pytest.mark.parametrize(("words", "expected"), [("pipeline che", "check"), ("pipeline theory opt", "optimum")])
def test_the_shell_completes_commands(words, expected):
    environment = {"_PIPELINE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    code = "import sys; from pipeline.shell.cli import run; sys.argv = ['pipeline']; run()"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | environment, capture_output=True, text=True, check=True
    )
    assert expected in done.stdout.split()

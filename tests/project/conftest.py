"""The command line as tests of the whole call it."""

import pytest

from pipeline.shell.cli import run


@pytest.fixture
def call(capsys, monkeypatch, tmp_path):
    """Run the command line in an empty folder; returns exit status, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def run_here(*arguments):
        with pytest.raises(SystemExit) as leaving:
            run([str(a) for a in arguments])
        out, err = capsys.readouterr()
        return leaving.value.code or 0, out, err

    return run_here

"""Shells complete commands."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(("words", "expected"), [("pipeline che", "check"), ("pipeline theory opt", "optimum")])
def test_the_shell_completes_commands(words, expected):
    environment = {"_PIPELINE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    code = "import sys; from pipeline.shell.cli import run; sys.argv = ['pipeline']; run()"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | environment, capture_output=True, text=True, check=True
    )
    assert expected in done.stdout.split()

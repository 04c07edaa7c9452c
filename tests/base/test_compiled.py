"""Machine code is made once and kept where that is possible; the numbers are the same everywhere."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from places import ROOT

MODULE = """
from pipeline.base.compiled import compiled

@compiled("f8(f8[::1])", "c16(c16[::1])")
def squares(values):
    total = 0 * values[0]
    for value in values:
        total += value * value
    return total
"""
USE = (
    "import numpy as np, loops; x = np.arange(1, 9) / 7; print(float(loops.squares(x)), complex(loops.squares(x * 1j)))"
)
UNWANTED = ("NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "XDG_CACHE_HOME", "HOME", "LOCALAPPDATA")


@pytest.fixture
def started(tmp_path):
    """Start a process that uses a compiled module, with some variables; any warning is an error in it."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "loops.py").write_text(MODULE)
    path = os.pathsep.join([str(tmp_path / "code"), str(ROOT), os.environ.get("PYTHONPATH", "")])
    usual = {name: value for name, value in os.environ.items() if name not in UNWANTED} | {"PYTHONPATH": path}

    def start(use=USE, **variables):
        words = [sys.executable, "-B", "-W", "error", "-c", use]
        environment = usual | {name: str(value) for name, value in variables.items()}
        return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)

    return start


def printed(process):
    """What a process prints; it ends well and without a word of warning."""
    out, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (0, "")
    return out


def kept(folder):
    """Files of machine code in a folder, with the time at which each was written."""
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*.nb?")}


def test_several_processes_at_once_compile_once(started, tmp_path):
    folder = tmp_path / "new" / "cache"
    several = [started(NUMBA_CACHE_DIR=folder) for _ in range(3)]
    assert len({printed(each) for each in several}) == 1
    first = kept(folder)
    assert len(first) == 3  # one index, and one file for each signature
    printed(started(NUMBA_CACHE_DIR=folder))
    assert kept(folder) == first


@pytest.mark.parametrize("variable", ["HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"])
def test_machine_code_is_in_the_folder_of_the_user(started, tmp_path, variable):
    used = {"XDG_CACHE_HOME": sys.platform == "linux", "LOCALAPPDATA": sys.platform == "win32"}
    printed(started(**({"HOME": tmp_path / "home"} | {variable: tmp_path / "own"})))
    assert bool(list((tmp_path / "own").rglob("haptic-pipeline"))) == used.get(variable, True)
    assert not list((tmp_path / "code").rglob("*.nb?"))


def test_a_folder_that_takes_no_files_is_no_error(started, tmp_path):
    (tmp_path / "file").write_text("")
    expected = printed(started(NUMBA_DISABLE_JIT=1, HOME=tmp_path))
    assert printed(started(NUMBA_CACHE_DIR=tmp_path / "file" / "folder")) == expected
    assert printed(started(HOME=tmp_path / "file")) == expected
    assert not list(tmp_path.rglob("*.nb?"))


@pytest.mark.parametrize("ending", [".nbi", ".nbc", ".lock"])
def test_damaged_files_are_no_error(started, tmp_path, ending):
    expected = printed(started(NUMBA_CACHE_DIR=tmp_path / "cache"))
    for path in [*(tmp_path / "cache").rglob(f"*{ending}")]:
        path.write_bytes(b"\x80damaged")
    assert printed(started(NUMBA_CACHE_DIR=tmp_path / "cache")) == expected


def test_without_compiling_nothing_is_kept_and_numbers_are_the_same(started, tmp_path):
    expected = printed(started(NUMBA_CACHE_DIR=tmp_path / "cache"))
    assert printed(started(NUMBA_DISABLE_JIT=1, HOME=tmp_path / "home")) == expected
    assert not (tmp_path / "home").exists()


def test_folder_of_numba_itself_stays(started, tmp_path):
    use = USE + "; import numba; assert numba.config.CACHE_DIR == ''"
    printed(started(use, HOME=tmp_path))


@pytest.mark.parametrize(
    "name", ["pipeline.measured.identification.kernels", "pipeline.measured.identification.identified"]
)
def test_an_import_loads_no_compiler(started, name):
    assert printed(started(f"import sys, {name}; print('numba' in sys.modules)")) == "False\n"

"""Machine code is made once and kept where that is possible; the numbers are the same everywhere."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from places import ROOT

MODULE = """
from pipeline.base.compiled import compiled, inlined

@inlined
def square(value):
    return value * value

@compiled("f8(f8[::1])")
def squares(values):
    total = 0 * values[0]
    for value in values:
        total += square(value)
    return total
"""
USE = "import numpy as np, loops; print(loops.squares(np.arange(1, 9) / 7))"
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
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*.o")}


def test_several_processes_at_once_compile_once(started, tmp_path):
    folder = tmp_path / "new" / "cache"
    several = [started(NUMBA_CACHE_DIR=folder) for _ in range(3)]
    assert len({printed(each) for each in several}) == 1
    first = kept(folder)
    assert len(first) == 1
    printed(started(NUMBA_CACHE_DIR=folder))
    assert kept(folder) == first


@pytest.mark.parametrize("variable", ["HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"])
def test_machine_code_is_in_the_folder_of_the_user(started, tmp_path, variable):
    used = {"XDG_CACHE_HOME": sys.platform == "linux", "LOCALAPPDATA": sys.platform == "win32"}
    printed(started(**({"HOME": tmp_path / "home"} | {variable: tmp_path / "own"})))
    assert bool(list((tmp_path / "own").rglob("haptic-pipeline"))) == used.get(variable, True)
    assert not list((tmp_path / "code").rglob("*.o"))


def test_a_folder_that_takes_no_files_is_no_error(started, tmp_path):
    (tmp_path / "file").write_text("")
    expected = printed(started(NUMBA_DISABLE_JIT=1, HOME=tmp_path))
    assert printed(started(NUMBA_CACHE_DIR=tmp_path / "file" / "folder")) == expected
    assert printed(started(HOME=tmp_path / "file")) == expected
    assert not list(tmp_path.rglob("*.o"))


@pytest.mark.skipif(sys.platform != "linux", reason="has no file system that takes no files from anybody")
def test_a_file_system_that_takes_no_files_is_no_error(started, tmp_path):
    expected = printed(started(NUMBA_DISABLE_JIT=1, HOME=tmp_path))
    assert printed(started(NUMBA_CACHE_DIR="/proc")) == expected


def test_a_changed_function_that_is_inlined_is_compiled_again(started, tmp_path):
    folder, file = tmp_path / "cache", tmp_path / "code" / "loops.py"
    expected = printed(started(NUMBA_CACHE_DIR=folder))
    file.write_text(MODULE.replace("return value * value", "return value * value * 2"))
    assert float(printed(started(NUMBA_CACHE_DIR=folder))) == 2 * float(expected)


LISTENED = "from pipeline.base.compiled import load_compiled, on_compiling; on_compiling(print, {}); import loops; "


@pytest.mark.parametrize(("after_s", "message"), [(0, "compiling, once\n"), (60, "")])
def test_compiling_is_said_once_where_it_takes_long(started, tmp_path, after_s, message):
    use = LISTENED.format(after_s) + "load_compiled(); "
    assert printed(started(use, NUMBA_CACHE_DIR=tmp_path / "cache")) == message


def test_functions_of_some_modules_are_loaded_alone(started, tmp_path):
    use = "import sys, loops; from pipeline.base.compiled import load_compiled; "
    use += "load_compiled('loop', 'loops.more'); print('numba' in sys.modules); load_compiled('loops')"
    assert printed(started(use, NUMBA_CACHE_DIR=tmp_path / "cache")) == "False\n"
    assert len(kept(tmp_path / "cache")) == 1


PLAIN = [
    "tests/loop/test_free_run.py",
    "tests/measured/identification/test_compiled_loops.py",
    "tests/simulation/test_parts.py",
    "tests/simulation/test_velocity.py",
]
"""Tests of compiled functions that are fast in plain Python, too."""


@pytest.mark.slow
def test_a_part_of_the_suite_passes_without_compiling():
    words = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-k",
        "not energy and not dense and not tangents",
        *PLAIN,
    ]
    done = subprocess.run(words, cwd=ROOT, env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("ending", [".o", ".lock"])
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

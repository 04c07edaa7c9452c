"""Stored functions are called as machine code without numba, with the numbers of plain Python."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from places import ROOT

from pipeline.base.compiled import KEPT_DAYS
from pipeline.base.machine_code import signature_of

MODULE = """
from pipeline.base.compiled import compiled, inlined

@inlined
def scaled(values, factor):
    return values[0] * factor

@compiled("void(Tuple((f8[:,::1],UniTuple(f8,2))),Tuple((i8,b1)),f8[::1],c16[::1])")
def combine(given, asked, out, turned):
    table, (first, second) = given
    count, plain = asked
    for i in range(count):
        out[i] = scaled(table[i], first) + second if plain else -table[i, 1]
        turned[i] = out[i] * 1j
"""
USE = """
import sys, numpy as np, sums
out, turned = np.zeros(3), np.zeros(3, complex)
sums.combine((np.arange(6.0).reshape(3, 2), (0.1, 7.0)), (3, {plain}), out, turned)
print(out.tolist(), turned.tolist(), "numba" in sys.modules)
"""


@pytest.fixture
def printed(tmp_path):
    """What a process prints that calls a function of a module in a folder."""
    (tmp_path / "sums.py").write_text(MODULE)

    def run(plain=True, use=USE, **variables):
        path = os.pathsep.join([str(tmp_path), str(ROOT)])
        environment = os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path / "kept")} | variables
        words = [sys.executable, "-B", "-W", "error", "-c", use.format(plain=plain)]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120, check=True)
        return done.stdout.strip()

    return run


@pytest.mark.parametrize("plain", [True, False])
def test_numbers_are_those_of_plain_python_and_numba_is_imported_once(printed, plain):
    expected = printed(plain, NUMBA_DISABLE_JIT="1").removesuffix(" False")
    assert printed(plain) == f"{expected} True"
    assert printed(plain) == f"{expected} False"


CONSTANT = """
import sys, numpy as np, sums
from pipeline.base.constants import Constants
table, out, turned = np.arange(6.0).reshape(3, 2), np.zeros(3), np.zeros(3, complex)
given = Constants((table, (0.1, 7.0)))
for _ in range(2):
    sums.combine(given, (3, {plain}), out, turned)
    print(out.tolist(), turned.tolist(), end=" ")
    table[1] *= 3
"""


@pytest.mark.parametrize("plain", [True, False])
def test_constants_are_passed_like_other_arguments(printed, plain):
    found = printed(plain, CONSTANT)
    assert found == printed(plain, CONSTANT, NUMBA_DISABLE_JIT="1")
    assert found.count("]") == 4
    first, second = found[: len(found) // 2], found[len(found) // 2 :]
    assert first != second, "a number of an array may change"


def test_a_damaged_file_is_compiled_again(printed, tmp_path):
    first = printed()
    (file,) = (tmp_path / "kept").glob("*.o")
    file.write_bytes(file.read_bytes()[:-40])
    assert printed() == first
    assert len([*(tmp_path / "kept").glob("*.o")]) == 1


def test_each_version_of_a_function_keeps_its_machine_code(printed, tmp_path):
    first = printed()
    (tmp_path / "sums.py").write_text(MODULE.replace("* factor", "* factor * 2"))
    assert printed() != first
    (tmp_path / "sums.py").write_text(MODULE)
    assert printed() == first.replace(" True", " False"), "without numba, because its machine code is still there"


def test_machine_code_of_former_versions_is_removed_after_some_months(printed, tmp_path):
    printed()
    (old,) = (tmp_path / "kept").glob("*.o")
    os.utime(old, (0, time.time() - 86400 * (KEPT_DAYS + 1)))
    (tmp_path / "sums.py").write_text(MODULE.replace("* factor", "* factor * 2"))
    printed()
    assert not old.exists()
    assert len([*(tmp_path / "kept").glob("*.o")]) == 1


RETURNS = """
from pipeline.base.compiled import compiled
import numpy as np

@compiled("Tuple((f8[:,::1],f8[::1],i8,f8))(f8[::1],i8)")
def tables(values, count):
    table = np.zeros((count, len(values)))
    for i in range(count):
        table[i] = i * values
    row = table[-1] if count else np.zeros(0)
    return table, row, count, values[0] + values[-1]
"""
USE_TABLES = """
import gc, sys, numpy as np, sums
{plain}
for count in (0, 3):
    table, row, number, total = sums.tables(np.arange(4.0), count)
    print(table.tolist(), row.tolist(), number, total)
del table
gc.collect()
others = [np.full(12, 7.0) for _ in range(1000)]
print(row.tolist(), "numba" in sys.modules)
"""


def test_arrays_of_a_function_live_as_long_as_they_are_used(printed, tmp_path):
    (tmp_path / "sums.py").write_text(RETURNS)
    expected = printed("", use=USE_TABLES, NUMBA_DISABLE_JIT="1")
    assert "[0.0, 2.0, 4.0, 6.0] 3 3.0" in expected
    assert printed("", use=USE_TABLES) == expected.replace("False", "True")
    assert printed("", use=USE_TABLES) == expected


LIBRARY = """
from pipeline.base.compiled import compiled

@compiled("f8(f8[:,::1])")
def tables(values):
    return values.reshape(-1)[0]
"""
USE_LIBRARY = """
import numpy as np, sums
try:
    sums.tables(np.ones((2, 2)))
except TypeError as error:
    print(error)
"""


def test_a_function_of_the_library_of_numba_is_refused(printed, tmp_path):
    (tmp_path / "sums.py").write_text(LIBRARY)
    assert printed(use=USE_LIBRARY).startswith("sums.tables: calls numba_attempt_nocopy_reshape of")


GROWTH = """
import resource, numpy as np, sums
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
values = np.arange(1e5)
sums.tables(values, 10)
before = peak()
for _ in range(100):
    sums.tables(values, 10)
print(peak() - before < before)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="has no count of the memory of a process")
def test_arrays_of_a_function_are_freed(printed, tmp_path):
    (tmp_path / "sums.py").write_text(RETURNS)
    assert printed(use=GROWTH) == "True"


WRONG = """
import numpy as np, sums
try:
    sums.combine((np.zeros({shape}{kind}), (0.1, 7.0)), (0, True), np.zeros(3), np.zeros(3, complex))
except TypeError as error:
    print(error)
"""


@pytest.mark.sampled
@pytest.mark.parametrize(("shape", "kind"), [("6", ""), ("(3, 2)", ", int"), ("(2, 3)", ", order='F'")])
def test_an_array_of_another_form_is_refused(printed, shape, kind):
    assert printed(use=WRONG.format(shape=shape, kind=kind, plain="")).startswith("expected a C-contiguous array")


def test_an_array_is_passed_by_its_address_shape_and_strides():
    table, values = np.zeros((2, 3)), []
    arguments = signature_of("void(f8[:,::1])").arguments
    arguments.append((table,), values)
    assert values == [0, 0, 6, 8, table.ctypes.data, 2, 3, 24, 8]
    assert len(arguments.types) == len(values)

"""A function in another process returns, raises, or is ended; the next call has a process that works."""

import sys

import pytest

from pipeline.base.errors import LogError
from pipeline.base.isolated import IsolationError, run_isolated

WAIT_S = 120.0
"""Longer than a busy machine needs to start a process [s]."""


def test_results_and_errors_come_back():
    assert run_isolated("math:sqrt", 4.0, wait_s=WAIT_S) == 2.0
    with pytest.raises(ValueError, match="domain"):
        run_isolated("math:sqrt", -1.0, wait_s=WAIT_S)
    with pytest.raises(LogError) as error:
        run_isolated("misbehaving:refuse", "log", b"", wait_s=WAIT_S)
    assert error.value.row == 7


@pytest.mark.sampled
@pytest.mark.skipif(sys.platform != "linux", reason="limits of a process are those of Linux")
@pytest.mark.parametrize(
    ("function", "limits", "words"),
    [
        ("hang", {"processor_s": 0.3}, "does not end in time"),
        ("hang", {"wait_s": 10.0}, "does not end in time"),
        ("crash", {}, "crashes .status -11"),
    ],
)
def test_a_process_that_hangs_or_crashes_is_replaced(function, limits, words):
    with pytest.raises(IsolationError, match=words):
        run_isolated(f"misbehaving:{function}", "log", b"", **{"wait_s": WAIT_S, **limits})
    assert run_isolated("math:sqrt", 9.0, wait_s=WAIT_S) == 3.0


@pytest.mark.skipif(sys.platform != "linux", reason="limits of a process are those of Linux")
def test_memory_is_limited():
    with pytest.raises(MemoryError):
        run_isolated("misbehaving:starve", "log", b"", wait_s=WAIT_S, memory=64 << 20)


def test_a_call_sees_the_environment_and_the_folder_of_now(monkeypatch, tmp_path):
    assert run_isolated("os:getenv", "LAB_OF_THE_TEST", wait_s=WAIT_S) is None
    monkeypatch.setenv("LAB_OF_THE_TEST", "north")
    monkeypatch.chdir(tmp_path)
    assert run_isolated("os:getenv", "LAB_OF_THE_TEST", wait_s=WAIT_S) == "north"
    assert run_isolated("os:getcwd", wait_s=WAIT_S) == str(tmp_path)
    monkeypatch.delenv("LAB_OF_THE_TEST")
    assert run_isolated("os:getenv", "LAB_OF_THE_TEST", wait_s=WAIT_S) is None

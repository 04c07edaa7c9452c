"""Pools of which nothing is left: not when their block fails, and not when their parent is gone (test_killed)."""

import multiprocessing
import os
import time

import pytest

from pipeline.base.process_pool import process_pool


def test_what_still_computes_ends_with_a_block_that_fails():
    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt), process_pool(2) as pool:  # noqa: PT012 - the block is what is tested
        assert pool.submit(os.getpid).result() != os.getpid()
        waiting = [pool.submit(time.sleep, 3600) for _ in range(4)]
        began = time.monotonic()
        raise KeyboardInterrupt
    assert time.monotonic() - began < 30
    assert all(call.done() for call in waiting)
    assert set(multiprocessing.active_children()) <= before


def test_workers_do_without_pandas():
    with process_pool(1) as pool, pytest.raises(ModuleNotFoundError, match="left out here"):
        pool.submit(__import__, "pandas").result()

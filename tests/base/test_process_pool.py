"""Pools of which nothing is left: not when their block fails, and not when their parent is gone (test_killed)."""

import multiprocessing
import os
import time

import pytest

from pipeline.base.process import process_pool


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


def test_workers_load_pandas_only_for_who_asks():
    with process_pool(1) as pool:
        assert not pool.submit(
            eval, "__import__('pipeline.records.tables') and __import__('pyarrow').array([1]) is None"
        ).result()
        assert "pandas" not in pool.submit(eval, "list(__import__('sys').modules)").result()
        assert pool.submit(eval, "__import__('pyarrow').table({'a': [1]}).to_pandas()['a'].sum()").result() == 1
        assert pool.submit(eval, "__import__('pandas').DataFrame({'a': [1]})['a'].sum()").result() == 1

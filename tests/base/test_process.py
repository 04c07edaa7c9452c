"""Ends that signals ask for; pools of which nothing is left, also when their block fails (parents: test_killed)."""

import multiprocessing
import os
import signal
import time

import pytest

from pipeline.base.process import Ended, ending_on_signals, process_pool


def broken_off():
    """Do as extension modules of numpy while they are loaded."""
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except BaseException as error:
        raise ImportError("numpy._core.multiarray failed to import") from error


def test_an_import_that_a_signal_broke_off_is_an_end_not_an_error():
    former = signal.getsignal(signal.SIGTERM)
    with pytest.raises(Ended) as end, ending_on_signals():
        broken_off()
    assert end.value.number == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is former


def test_errors_that_no_signal_caused_stay():
    with pytest.raises(ImportError, match="no such"), ending_on_signals():
        raise ImportError("no such module")


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

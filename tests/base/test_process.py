"""Ends that signals ask for, whatever becomes of the exception on its way."""

import os
import signal

import pytest

from pipeline.base.process import Ended, ending_on_signals


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

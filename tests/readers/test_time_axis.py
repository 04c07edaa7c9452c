"""Time stamps: each way of counting gives the seconds that were simulated; gaps, drops and jitter are those put in."""

import numpy as np
import pytest

from pipeline.base.errors import LogError
from pipeline.profiles.profile_model import TimeSource
from pipeline.readers.log import step_flags
from pipeline.readers.rows import add_seconds, in_order

PERIOD = 1e-3


def source(**keys) -> TimeSource:
    return TimeSource.model_validate({"name": "t", "unit": "ms"} | keys)


def table_of(values):
    return {"time": np.asarray(values), "row": np.arange(len(values)) + 10}


def stamps(values, **keys):
    """Return columns with time in seconds, and how often a counter started again."""
    table = table_of(values)
    return table | add_seconds(source(**keys), table, PERIOD, "a.csv, column 't' (columns.time)") | table


@pytest.mark.parametrize("dtype", [np.int64, np.float64])
@pytest.mark.parametrize("wrap", [2**16, 2**32])
def test_a_wrapped_counter_equals_one_that_goes_on(wrap, dtype):
    rng = np.random.default_rng(3)
    truth = wrap - 5000 + np.concatenate(([0], np.cumsum(rng.integers(1, wrap // 3, size=40))))
    found = stamps((truth % wrap).astype(dtype), kind="counter", unit="us", wrap=wrap)
    assert found["wraps"] == int(truth[-1] // wrap) - int(truth[0] // wrap) > 3
    np.testing.assert_allclose(found["time"], (truth - truth[0]) * 1e-6, rtol=1e-15)
    assert found["raw_time"].tolist() == (truth % wrap).tolist()


def test_a_counter_above_its_wrap_is_refused():
    with pytest.raises(LogError, match=r"counter is 65536; expected 0 to 65536.*where the counter restarts") as error:
        stamps([65535, 65536], kind="counter", wrap=65536)
    assert error.value.row == 11


def test_sampled_time_needs_no_stamps_and_agrees_with_coarse_ones():
    without = {"row": np.arange(4)}
    add_seconds(TimeSource(kind="sampled"), without, PERIOD, "a")
    assert "raw_time" not in without
    np.testing.assert_allclose(without["time"], [0, 1e-3, 2e-3, 3e-3], rtol=1e-15)
    coarse = np.floor(np.arange(100) * 1.0 / 10) * 10 + 500  # 1 ms samples, stamps printed to 10 ms
    found = stamps(coarse, kind="sampled")
    np.testing.assert_allclose(found["time"], np.arange(100) * 1e-3, rtol=1e-15)
    assert found["raw_time"].tolist() == coarse.tolist()
    late = coarse.copy()
    late[60:] += 20  # twenty samples were lost
    with pytest.raises(LogError, match=r"its row implies 0.06 s.*If samples are missing"):
        stamps(late, kind="sampled")


def test_sampled_time_sees_one_lost_sample_where_each_stamp_differs():
    lost = np.delete(np.arange(30.0), 12)  # ms, one for each sample but the thirteenth
    with pytest.raises(LogError, match=r"its row implies 0\.012 s"):
        stamps(lost, kind="sampled")
    dates = np.delete(1.7e9 + np.arange(30) * 1e-3, 12)  # in floats, right to 0.24 us
    with pytest.raises(LogError, match=r"its row implies 0\.012 s"):
        stamps(dates, kind="sampled", unit="s")
    # late by less than one period, and back in time
    late = np.arange(30.0) + np.random.default_rng(1).uniform(0, 0.99, 30)
    assert len(stamps(np.sort(late), kind="sampled")["time"]) == 30


def test_rows_with_one_stamp_keep_their_order_when_sorted():
    time = np.random.default_rng(2).integers(0, 5, size=400).astype(float)
    order, _ = in_order(source(order="sort"), table_of(time), "a")
    assert all((np.diff(order[time[order] == stamp]) > 0).all() for stamp in range(5))


def test_flags_are_those_put_into_the_time():
    rng = np.random.default_rng(7)
    full = np.arange(1000) * PERIOD
    kept = np.sort(rng.permutation(999)[:600])  # 40 % dropped
    jittered = full + np.where(np.arange(1000) % 2, 0.2, -0.2) * PERIOD
    far = np.array([0.0, 0.5, 1.0])
    trials = [full, full[np.concatenate(([0], kept[kept > 0]))], jittered, far]
    time, rows = np.concatenate(trials), np.array([len(trial) for trial in trials])
    ideal, dropped, shaken, sparse = step_flags(time, rows, np.full(4, PERIOD))
    assert (ideal["gaps"], ideal["dropped"], ideal["dropped_fraction"]) == (0, 0, 0.0)
    # rounding of k T: a few units of 1e-16 of 1 s
    assert ideal["jitter_max_s"] < 1e-15
    assert ideal["mean_step_s"] == pytest.approx(PERIOD, rel=1e-12)
    present = trials[1]
    missing = round((present[-1] - present[0]) / PERIOD) + 1 - len(present)
    assert dropped["dropped"] == missing
    assert dropped["gaps"] == sum(step > 1.5 * PERIOD for step in np.diff(present).tolist())
    assert dropped["dropped_fraction"] == pytest.approx(missing / (missing + len(present)))
    assert dropped["longest_step_s"] == pytest.approx(max(np.diff(present).tolist()))
    assert shaken["jitter_rms_s"] == pytest.approx(0.4 * PERIOD, rel=1e-9)
    assert shaken["jitter_max_s"] == pytest.approx(0.4 * PERIOD, rel=1e-9)
    assert sparse == {
        "gaps": 2,
        "dropped": 998,
        "dropped_fraction": pytest.approx(998 / 1001),
        "longest_step_s": 0.5,
        "mean_step_s": None,
        "jitter_rms_s": None,
        "jitter_max_s": None,
    }


def test_flags_of_one_trial_do_not_depend_on_its_neighbours():
    rng = np.random.default_rng(9)
    trials = [np.cumsum(rng.uniform(0.2e-3, 3e-3, size=n)) for n in (2, 57, 9)]
    together = step_flags(np.concatenate(trials), np.array([2, 57, 9]), np.full(3, PERIOD))
    alone = [step_flags(trial, np.array([len(trial)]), np.array([PERIOD]))[0] for trial in trials]
    assert together == alone

"""Responses in a page: what comes back from the coded ones, and that nothing visible is lost."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from trial_pages import decode

from pipeline.records.trial_codec import (
    COLUMNS,
    LEVELS,
    WHOLE,
    code,
    pack,
    pack_within,
    step_size,
    unpack,
    visible_rows,
)

SIGNALS = arrays(np.float64, st.integers(2, 60), elements=st.floats(-1e3, 1e3))


@given(SIGNALS, st.sampled_from([0.0, 1e-3, 2.0]))
def test_a_signal_comes_back_within_half_a_step(values, quantum):
    step = step_size(values, quantum)
    assert step >= max(quantum, np.ptp(values) / LEVELS)
    # rounding to whole steps errs by half a step; the factor leaves room for rounding of the product itself
    assert np.abs(decode(code(values, step), step) - values).max() <= 0.5001 * step + 1e-12


def test_multiples_of_a_quantum_come_back_exactly():
    quantum = 2e-6
    counts = np.array([0, 3, -2, 300, 299, 5, 5, 5])
    values = counts * quantum
    step = step_size(values, quantum)
    assert step == quantum
    assert np.rint(decode(code(values, step), step) / quantum).astype(int).tolist() == counts.tolist()


def test_gaps_repeat_the_value_before_and_nothing_is_none():
    assert decode(code(np.array([1.0, np.nan, 3.0]), 1.0), 1.0).tolist() == [1, 1, 3]
    assert code(np.full(4, np.nan), 1.0) is None
    assert step_size(np.full(4, np.nan), 0.0) == 1.0
    assert step_size(np.zeros(4), 0.0) == 1.0


def test_an_oscillation_is_predicted_by_its_past():
    """What is left of two decaying oscillations is rounding: a few steps, where the signal has hundreds."""
    n = np.arange(400)
    values = np.exp(-n / 150) * np.cos(0.4 * n) + 0.3 * np.exp(-n / 60) * np.sin(0.15 * n)
    coded = code(values, 1e-3)
    # rounding errors of half a step come in by the coefficients of the past, whose sizes add up to about 12
    assert np.abs(coded["r"][8:]).max() <= 7
    assert np.abs(decode(coded, 1e-3) - values).max() <= 0.5001e-3


def test_short_responses_keep_every_row():
    assert visible_rows((np.zeros(COLUMNS + WHOLE),), 5, COLUMNS + WHOLE) is None


@pytest.mark.parametrize("rows", [731, 2000, 10_007])
def test_thinning_keeps_the_envelope_of_each_column_of_pixels_and_the_onset(rows):
    rng = np.random.default_rng(4)
    log, model = np.cumsum(rng.normal(size=rows)), np.sin(np.arange(rows) / 3)
    edge = 23
    kept = visible_rows((log, model), edge, rows)
    assert kept is not None
    assert len(kept) <= 4 * COLUMNS + WHOLE + 2
    assert np.isin(np.arange(edge, edge + WHOLE), kept).all()
    assert (kept[0], kept[-1]) == (0, rows - 1)
    for column in range(COLUMNS):
        inside = np.arange(-(-column * rows // COLUMNS), -(-(column + 1) * rows // COLUMNS))
        shown = kept[(kept >= inside[0]) & (kept <= inside[-1])]
        for signal in (log, model):
            assert signal[shown].min() == signal[inside].min()
            assert signal[shown].max() == signal[inside].max()


def test_thinning_takes_a_signal_that_ends_early():
    model = np.where(np.arange(1500) < 400, 1.0, np.nan)
    assert visible_rows((np.zeros(1500), model), 0, 1500) is not None


@given(st.lists(st.dictionaries(st.text(), st.integers() | st.text() | st.none()), max_size=4))
def test_packing_comes_back(content):
    assert unpack(pack(content)) == content
    assert unpack(pack_within(content, None)[0]) == content


def test_as_many_entries_as_the_budget_allows_and_no_more():
    rng = np.random.default_rng(1)
    asked = []

    def entries():
        for number in range(200):
            asked.append(number)
            yield {"i": number, "x": rng.integers(-99, 99, 50).tolist()}

    packed, count = pack_within(entries(), 5000)
    assert 5 < count < 100
    assert len(packed) <= 5000 < len(packed) + 200  # the next entry, of some 100 bytes, did not fit
    assert len(asked) == count + 1
    assert [entry["i"] for entry in unpack(packed)] == list(range(count))
    assert pack_within([{"x": "much" * 99}], 8) == (pack([]), 0)


@pytest.mark.parametrize("spread", [0, 3, 10**9])
def test_the_first_entry_that_does_not_fit_is_the_last_asked_for(spread):
    """Also where zlib holds back much of what it was given: zeros, and what it cannot make shorter."""
    rng = np.random.default_rng(2)
    entries = [{"x": rng.integers(0, spread + 1, int(rows)).tolist()} for rows in rng.integers(0, 3000, 40)]
    sizes = [len(pack_within(entries[:count], None)[0]) for count in range(1, len(entries) + 1)]
    for budget in (
        *range(sizes[0], sizes[-1], max(sizes[-1] // 25, 1)),
        *(size + more for size in sizes[::7] for more in (-1, 0)),
    ):
        fitting = next((count for count, size in enumerate(sizes) if size > budget), len(sizes))
        assert pack_within(entries, budget)[1] == fitting, budget


def test_no_number_that_json_does_not_know():
    with pytest.raises(ValueError, match="JSON"):
        pack([float("nan")])
    assert json.loads(json.dumps(unpack(pack({"a": "<script>"})))) == {"a": "<script>"}

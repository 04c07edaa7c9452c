"""Definitions of other tools: their published numbers, a plain evaluation, and the numbers they get wrong."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal
from simulated import FALCON, simulate

from pipeline.base.errors import ParameterError
from pipeline.measured.cost import settling_overshoot
from pipeline.measured.cost.step_metrics import DEFINITIONS, TOOLS, reconcile
from pipeline.measured.signal.response import find_response
from pipeline.measured.signal.verdict import Verdicts, judge
from pipeline.records.batch import TrialBatch

EDGE = 20
STABLE = Verdicts(np.array(["stable"], dtype="<U9"), np.array([np.nan]), ("",))


def logged(y, final, T=1e-3, start=0.0):
    """A log whose positions are a given response, on a wall that brings it to the final value."""
    position = start + np.concatenate([np.zeros(EDGE), y])[None, :]
    rows = position.shape[1]
    # any wall will do for the tools: F_0 = 1, K = 1/final, B = 0
    command = np.where(np.arange(rows) >= EDGE, 1.0, 0.0) - (position - start) / final
    return TrialBatch(
        ("t",), np.array([1 / final]), np.array([0.0]), np.array([1.0]), np.array([T]), np.array([rows]),
        T * np.arange(rows)[None, :], command, position,
    )  # fmt: skip


def metrics(batch, verdicts=STABLE, **more):
    return reconcile(batch, find_response(batch), verdicts, 0, **more)


@pytest.mark.parametrize(
    ("numerator", "denominator", "band", "settling", "overshoot"),
    [
        ([1, 5, 5], [1, 1.65, 5, 6.5, 2], 0.02, 27.9762, 0.074915),
        ([8, 18, 32], [1, 6, 14, 24], 0.02, 3.4972, 0.265302),
        ([8, 18, 32], [1, 6, 14, 24], 0.005, 4.8896, 0.265302),
    ],
)
def test_numbers_printed_in_the_documentation_of_matlab(numerator, denominator, band, settling, overshoot):
    """Documentation of stepinfo: examples with 2 % (R2021a and later) and with 0.5 %."""
    T, final = 2e-3, numerator[-1] / denominator[-1]
    t = np.arange(0, 120, T)
    _, y = signal.step((numerator, denominator), T=t)
    found = metrics(logged(y, final, T), band=band)
    for name in ("matlab_final_value", "matlab_peak_error"):
        # MATLAB interpolates, but on a coarser grid of its own choice, which misses the peak by a little
        assert found.settling[name].value[0] * T == pytest.approx(settling, rel=1e-3)
        assert found.overshoot[name].value[0] == pytest.approx(overshoot, rel=5e-3)
    sampled = found.settling["python_control"].value[0]
    assert sampled == np.ceil(found.settling["matlab_final_value"].value[0])


def plain(y, band):
    """Settling in samples by the words of each definition, over a plain list."""
    final = y[-1]
    width = {"matlab_final_value": band * abs(final), "matlab_peak_error": band * max(abs(v - final) for v in y)}
    width["python_control"] = width["matlab_final_value"]
    result = {}
    for name, w in width.items():
        k = len(y)
        while k > 0 and (abs(y[k - 1] - final) < w if name == "python_control" else abs(y[k - 1] - final) <= w):
            k -= 1
        if name != "python_control" and 0 < k < len(y):
            edge = final + np.copysign(w, y[k - 1] - final)
            result[name] = k - 1 + (edge - y[k - 1]) / (y[k] - y[k - 1])
        else:
            result[name] = float(k)
    return result


def test_a_plain_evaluation_gives_the_same():
    K, B = np.array([4469.0, 3000.0, 6000.0, 1500.0, 9000.0]), np.array([73.05, 100.0, 60.0, 40.0, 110.0])
    batch = simulate(K, B, **FALCON, rows=900)
    response = find_response(batch)
    found = reconcile(batch, response, judge(batch, response), 4)
    thesis = settling_overshoot.settling(batch, response, judge(batch, response), 4).samples["settle_2pct"]
    np.testing.assert_array_equal(found.settling["thesis"].value, thesis)
    for i in range(len(K)):
        y = batch.displacement[i, EDGE:].tolist()
        for name, value in plain(y, 0.02).items():
            assert found.settling[name].value[i] == pytest.approx(value, rel=1e-12)
            assert found.overshoot[name].value[i] == pytest.approx(max(max(y) / y[-1] - 1, 0.0), abs=1e-15)
    # ideal responses that have come to rest: what remains between thesis and python-control is the delay
    np.testing.assert_array_equal(found.settling["python_control"].value - thesis, 4)


def test_definitions_differ_where_the_error_exceeds_the_step():
    """A response that first runs away from its final value: its peak error is three times the step."""
    k = np.arange(600)
    y = 1 - np.exp(-k / 40) * (1 + 3 * np.sin(k / 10))
    found = metrics(logged(y, 1.0))
    peak, final = (found.settling[name].value[0] for name in ("matlab_peak_error", "matlab_final_value"))
    assert peak < final - 20
    assert set(found.settling) == set(DEFINITIONS) == {"thesis", *TOOLS}


def test_agrees_with_python_control():
    control = pytest.importorskip("control", reason="python-control is not installed")
    batch = simulate([4469.0, 6000.0], [73.05, 60.0], **FALCON, rows=900)
    response = find_response(batch)
    found = reconcile(batch, response, judge(batch, response), 4)
    for i in range(2):
        y = batch.displacement[i, EDGE:]
        info = control.step_info(y, T=np.arange(len(y)))
        assert found.settling["python_control"].value[i] == info["SettlingTime"]
        assert found.overshoot["python_control"].value[i] == pytest.approx(info["Overshoot"] / 100)


def test_a_step_from_5_to_6_has_37_per_cent():
    k = np.arange(400)
    wave = 1 - np.exp(-k / 30) * np.cos(k / 10)
    y = wave * 1.0
    found = metrics(logged(y, 1.0, start=5.0))
    for metric in found.overshoot.values():
        assert metric.value[0] == pytest.approx(y.max() - 1, rel=1e-4)
        assert metric.value[0] > 0.3  # raw positions relative to 6 would give a sixth of it


def every_reason(batch, verdicts=None, **more):
    response = find_response(batch)
    found = reconcile(batch, response, judge(batch, response) if verdicts is None else verdicts, 4, **more)
    for metrics_ in (found.settling, found.overshoot):
        for metric in metrics_.values():
            assert (np.isnan(metric.value) == [bool(text) for text in metric.reason]).all()
    return found


def test_no_number_where_tools_give_a_wrong_one():
    # noise as large as the band: a tool returns the end of the log
    coarse = simulate([9000.0], [110.0], **FALCON, quantum=1e-5, noise=1e-5, rows=900)
    for name in TOOLS:
        assert every_reason(coarse).settling[name].reason[0]
    # still swinging, or creeping, at the end: any response is settled at its own last sample
    swinging = simulate([12000.0], [90.0], **FALCON, rows=160)
    creeping = simulate([200.0], [150.0], **FALCON)
    for batch in (swinging, creeping):
        found = every_reason(batch)
        for name in TOOLS:
            assert "final value" in found.settling[name].reason[0]
            assert found.overshoot[name].reason[0]
    # no final value to divide by
    free = every_reason(simulate([0.0], [20.0], **FALCON))
    unstable = every_reason(simulate([20000.0], [60.0], **FALCON))
    for name in DEFINITIONS:
        assert "no final position" in free.settling[name].reason[0]
        assert "unstable" in unstable.settling[name].reason[0]
    back = metrics(logged(np.sin(np.arange(500) / 9) * np.exp(-np.arange(500) / 20), 1.0))
    assert (
        "final displacement" in back.settling["python_control"].reason[0] or back.settling["python_control"].reason[0]
    )
    brief = every_reason(simulate([4000.0], [70.0], **FALCON, rows=60))
    for name in TOOLS:
        assert brief.settling[name].reason[0]


def test_noisy_logs_still_have_numbers():
    K, B = np.array([3500.0, 3000.0, 4000.0]), np.array([80.0, 70.0, 90.0])
    batch = simulate(K, B, **FALCON, quantum=2e-6, noise=5e-7)
    found = every_reason(batch)
    ideal = every_reason(simulate(K, B, **FALCON))
    for name in DEFINITIONS:
        # noise moves a crossing by a few samples, a last sample by a few micrometres of 2 mm
        np.testing.assert_allclose(found.settling[name].value, ideal.settling[name].value, atol=8)
        np.testing.assert_allclose(found.overshoot[name].value, ideal.overshoot[name].value, atol=5e-3)


@pytest.mark.parametrize("band", [0.0, 1.0, -0.1])
def test_band_out_of_range(band):
    with pytest.raises(ParameterError, match="settling band"):
        metrics(logged(1 - np.exp(-np.arange(300) / 20), 1.0), band=band)

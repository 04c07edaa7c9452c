"""Published conditions: each formula in a limit case that its paper or the exact loop knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline import Loop, PipelineError, published_limits
from pipeline.theory.passivity import required_damping

RIG = Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=4)


def limits(loop: Loop, damping: object, **sensor: float) -> dict[str, np.ndarray]:
    table = published_limits(loop, damping, **sensor)
    assert table.notna().drop(columns="stiffness").all(axis=None)
    return {name: np.asarray(rows["stiffness"]) for name, rows in table.groupby("condition")}


def test_conditions_for_slow_motion_are_the_slope_of_the_exact_limit_at_the_origin() -> None:
    slow = Loop(100.0, 0.5, 0.001, 2.5)  # alpha = 1e-5: far from where the boundary bends
    found = limits(slow, [0.0, 1.0, 2.0])
    assert found["Hulin et al. 2006, linear"] == pytest.approx(found["exact"], rel=1e-4)
    assert found["Minsky et al. 1990"] == pytest.approx(found["exact"], rel=1e-4)
    undelayed = limits(Loop(100.0, 0.5, 0.001, 0), [0.0, 1.0])
    assert undelayed["Gil et al. 2004"] == pytest.approx(undelayed["exact"], rel=1e-4)
    held = Loop(100.0, 0.5, 0.001, 2.5, operator={"mass": 1.0, "damping": 2.0, "stiffness": 300.0})
    hand = limits(held, [1.0])
    assert hand["Minsky et al. 1990"] == pytest.approx(hand["Hulin et al. 2006, linear"] - 300.0)
    assert hand["Hulin et al. 2006, linear"] == pytest.approx(hand["exact"], rel=1e-4)


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 4.0])
def test_passivity_with_delay_is_that_of_the_package(delay: float) -> None:
    loop = Loop(0.58, 4.0, 0.001, delay)
    B = np.array([-3.0, 0.0, 1.0, 3.5])
    K = limits(loop, B)["Hulin et al. 2014"]
    needed = required_damping(loop.normalised_loop, K / loop.units.stiffness, B / loop.units.damping)
    assert needed * loop.units.damping == pytest.approx(4.0, rel=1e-6)
    most = loop.passive()["damping"].max()  # b, but more with a fractional delay
    assert most == pytest.approx(4.0, rel=1e-6) or delay % 1
    assert limits(loop, [-4.1, 1.01 * most])["Hulin et al. 2014"].tolist() == [0.0, 0.0]


def test_passivity_with_a_fractional_delay_is_no_interpolation() -> None:
    """Whole delays leave 6000 and 2000; the sum over aliases in 0.3 samples is 3484, not 3750."""
    device = Loop(0.5, 3.0, 0.001, 0.3)
    assert limits(device, [0.0])["Hulin et al. 2014"][0] == pytest.approx(3484.41, rel=1e-5)
    at = device.passive().attrs
    assert limits(device, [at["damping_at_stiffness_max"]])["Hulin et al. 2014"][0] == pytest.approx(
        at["stiffness_max"], rel=1e-6
    )
    beyond = replace(device, mode={"frequency_hz": 60.0, "damping_ratio": 0.02, "mass": 0.15, "sensor": "load"})
    assert np.isnan(limits(beyond, [0.0])["Hulin et al. 2014"][0])
    assert limits(replace(device, damping=0.0), [0.0])["Hulin et al. 2014"][0] == 0.0


def test_without_delay_passivity_is_that_of_colgate_and_schenkel() -> None:
    found = limits(Loop(0.58, 4.0, 0.001, 0), [-3.0, 0.0, 2.0, 5.0], coulomb=0.5, quantum=1e-4)
    assert found["Hulin et al. 2014"] == pytest.approx(found["Colgate and Schenkel 1997"], rel=1e-6)
    assert found["Colgate and Schenkel 1997"] == pytest.approx([2000.0, 8000.0, 4000.0, 0.0])
    both = found["Abbott and Okamura 2005, Diolaiti et al. 2006"]
    assert both[1] == pytest.approx(8000.0)  # 2 b/T; 2 f_c/quantum is 10,000
    assert np.isnan(both[[0, 2, 3]]).all()
    coarse = limits(Loop(0.58, 4.0, 0.001, 0), [0.0], coulomb=0.5, quantum=1e-3)
    assert coarse["Abbott and Okamura 2005, Diolaiti et al. 2006"] == pytest.approx(1000.0)


def test_a_bare_mass_with_one_sample_of_delay_is_salcudean_and_vlaar_exactly() -> None:
    found = limits(Loop(0.58, 0.0, 0.001, 1), [50.0, 150.0])
    assert found["Salcudean and Vlaar 1997"] == pytest.approx(found["exact"], rel=1e-12)
    # the published optimum by settling time of d = 1, alpha = 0.0449 and beta = 0.3037, is inside
    assert limits(RIG, [0.3037 * 580])["Salcudean and Vlaar 1997"] > 0.0449 * 580_000


def test_a_negative_sensor_is_refused() -> None:
    with pytest.raises(PipelineError, match="quantum"):
        published_limits(RIG, 0.0, quantum=-1e-6)

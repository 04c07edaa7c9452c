"""`pipeline.Loop` with friction: the limit for a step beside the linear one, as numbers and as a picture."""

import numpy as np
import pytest
from fine_loop import Body, run

import pipeline

STICKY = {"mass": 0.5, "damping": 3.0, "sampling_period_s": 0.001, "delay_samples": 4, "friction": {"coulomb": 0.6}}


def test_a_second_simulator_grows_beyond_the_limit_for_the_step_and_not_below():
    limits = pipeline.Loop(**STICKY).limits([60.0], step=8.0)
    assert limits["stiffness_step"][0] > 1.05 * limits["stiffness"][0]
    for share, grows in ((0.95, False), (1.05, True)):
        position, _ = run(
            Body(0.5, 3.0, coulomb=0.6, stiction=0.6),
            K=share * limits["stiffness_step"][0],
            B=60.0,
            T=0.001,
            external=np.full(300, 8.0),
            delay=(4, 1),
            b=np.ones(1),
            a=np.ones(1),
        )
        assert (np.ptp(position[-60:]) > np.ptp(position[60:120])) == grows


@pytest.mark.parametrize("gain", [0.4, 2.0])
@pytest.mark.parametrize("motion", ["translation", "rotation"])
def test_gain_and_hand_count_in_the_limit_for_a_step(gain, motion):
    """A loop with hand and gain has the limits of the device that its wall feels."""
    hand = {"mass": 0.2, "damping": 4.0, "stiffness": 50.0}
    loop = pipeline.Loop(**STICKY, motion=motion, force_gain=gain, operator=hand)
    felt = loop.apparent()
    assert felt.friction.coulomb == pytest.approx(0.6 / gain)
    limits = [each.limits([40.0], step=8.0) for each in (loop, pipeline.Loop.of(felt))]
    np.testing.assert_allclose(limits[0], limits[1], rtol=1e-6)
    assert limits[0].attrs["left_out"] == ["friction"]


@pytest.mark.parametrize("ending", ["svg", "pdf", "png"])
def test_a_picture_is_written_by_its_ending(tmp_path, ending):
    path = tmp_path / f"loop.{ending}"
    pipeline.Loop(**STICKY).picture(path, step=8.0)
    begin = {"svg": b"<svg", "pdf": b"%PDF", "png": b"\x89PNG"}[ending]
    assert path.read_bytes().startswith(begin)
    if ending == "svg":
        assert all(text in path.read_text() for text in ("limit without friction", "limit for a step of 8 N"))


@pytest.mark.parametrize(("step", "samples"), [(0.0, 400), (-1.0, 400), (np.inf, 400), (8.0, 3)])
def test_a_step_out_of_range_is_refused(step, samples):
    with pytest.raises(pipeline.PipelineError, match="positive, finite step"):
        pipeline.Loop(**STICKY).limits([40.0], step=step, samples=samples)


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(pipeline.PipelineError, match=r"\.svg, \.pdf or \.png"):
        pipeline.Loop(**STICKY).picture(tmp_path / "loop.gif")

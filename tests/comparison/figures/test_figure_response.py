from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
import simulated

from pipeline.comparison.compare_experiment import motion_of
from pipeline.comparison.figures.figure_response import oscillation_period, response_figures, softest
from pipeline.comparison.scene.scene import open_scene
from pipeline.rendering.figures import response_drawing


def second_order(frequency: float, decay: float, end: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Step response of a second-order system with final value 2, sampled at 1 ms."""
    t = np.arange(0, end, 1e-3)
    return t, 2 * (1 - np.exp(-decay * t) * (np.cos(frequency * t) + decay / frequency * np.sin(frequency * t)))


@pytest.mark.parametrize("decay", [0.5, 3.0])
def test_period_is_that_of_the_damped_oscillation(decay: float) -> None:
    t, x = second_order(30.0, decay)
    first, second = oscillation_period(t, x, 2.0) or (0.0, 0.0)
    # maxima stand at pi/w and 3 pi/w; half a sample is what the sampling leaves open
    assert (first, second) == pytest.approx((np.pi / 30, 3 * np.pi / 30), abs=6e-4)
    assert oscillation_period(t, -x, -2.0) == (first, second)
    steps = np.round(x / 0.02) * 0.02  # a quantum of 1 % of the final value makes plateaus of some samples
    assert oscillation_period(t, steps, 2.0) == pytest.approx((first, second), abs=3e-3)


def test_no_period_without_two_whole_maxima() -> None:
    t, x = second_order(30.0, 0.5)
    assert oscillation_period(t[:250], x[:250], 2.0) is None, "the log ends in the second rise"
    assert oscillation_period(*second_order(30.0, 60.0), 2.0) is None, "hardly any overshoot"


def test_softest_stable_walls_each_at_its_least_damping() -> None:
    k, b = np.array([0.0, 400, 200, 200, 200, 600]), np.array([0.0, 4, 8, 0, 4, 0])
    assert softest(k, b, np.array([1, 1, 1, 0, 1, 1], dtype=bool)).tolist() == [4, 1, 5]
    assert len(softest(k, b, np.zeros(6, dtype=bool))) == 0


def test_first_response_of_a_device_shows_its_delay_and_its_period(falcon) -> None:
    data = open_scene("falcon", falcon.processed, None, None)
    (figure,) = response_figures(data, motion_of(data))
    (shown,) = figure.panels
    assert shown.first_change == simulated.FALCON["delay"] + 1  # d_obs = floor(d + 1) (6.2)
    stiffness, damping = (float(v) for v in re.findall(r"[KB] = ([\d.]+)", figure.caption))
    edge = int(np.argmin(np.abs(shown.time)))
    assert shown.final == pytest.approx(shown.command[edge] / stiffness, rel=1e-9)
    assert np.ptp(shown.position[: edge + shown.first_change]) < np.ptp(shown.position) * 1e-3
    assert shown.period is not None
    # the wall's spring on the mass, with the delay as lost damping: K t_r of (3.25)
    mass, viscous = simulated.FALCON["mass"], simulated.FALCON["b"]
    decay = (viscous + damping - stiffness * 4.5e-3) / (2 * mass)
    period = 2 * np.pi / np.sqrt(stiffness / mass - decay**2)
    assert shown.period[1] - shown.period[0] == pytest.approx(period, rel=0.03)  # second order of a loop of seventh


def test_drawing_marks_edge_first_change_and_bracket(falcon) -> None:
    data = open_scene("falcon", falcon.processed, None, None)
    (figure,) = response_figures(data, motion_of(data))
    (shown,) = figure.panels
    whole, close = drawn = response_drawing.responses(figure, "translation")
    assert drawn == response_drawing.responses(figure, "translation")
    words = ["".join(e.itertext()) for e in ElementTree.fromstring(close).iter("text")]
    assert f"first change, t_obs = {shown.first_change} ms" in words
    assert "T_osc" in whole
    assert f"the delay lies between {shown.first_change - 1} and {shown.first_change} ms" in close
    without = response_drawing.responses(replace(figure, panels=(replace(shown, period=None),)), "rotation")[0]
    assert "T_osc" not in without
    assert "displacement [mrad]" in without
    assert len(whole) + len(close) < 12_000  # of 1.2 MB for the figures of a report, one in a hundred


def test_no_first_response_without_a_stable_wall(falcon) -> None:
    data = open_scene("falcon", falcon.processed, None, None)
    stages = data.experiments[0]
    verdicts = stages.verdicts
    stages.__dict__["verdicts"] = replace(verdicts, verdict=np.full_like(verdicts.verdict, "unstable"))
    assert response_figures(replace(data, experiments=(stages,)), "translation") == ()

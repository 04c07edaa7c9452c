"""The band holds every theory inside the intervals."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.base.errors import ParameterError
from pipeline.comparison.scores.theory_band import ParameterBox, theory_band
from pipeline.loop.loop import Normalised
from pipeline.theory.limits import stiffness_limit

BOX = ParameterBox((0.55, 0.61), (2.0, 6.0), (3.0, 5.0), 1e-3)
FIRM = ParameterBox((0.9, 1.1), (30.0, 38.0), (3.5, 4.5), 1e-3)
DAMPING = np.arange(0.0, 190.0, 4.0)


def limits_at(box: ParameterBox, m: float, b: float, d: float) -> np.ndarray:
    scale = Normalised(m, box.sampling_period_s)
    return np.maximum(stiffness_limit(scale.loop(0.0, b, d), DAMPING / scale.damping), 0.0) * scale.stiffness


@pytest.mark.parametrize("box", [BOX, FIRM], ids=["falcon", "firm grip"])
def test_band_holds_a_thousand_random_theories(box):
    low, high = theory_band(box, DAMPING)
    rng = np.random.default_rng(5)
    for m, b, d in zip(
        *(rng.uniform(*x, 1000) for x in (box.mass, box.viscous_damping, box.delay_samples)), strict=True
    ):
        limit = limits_at(box, m, b, d)
        # the extremum over m between two of the masses that are tried: less than 1e-3 of the limit
        assert (limit >= low * (1 - 1e-3)).all()
        assert (limit <= high * (1 + 1e-3)).all()


def test_band_is_no_wider_than_theories_inside_it():
    low, high = theory_band(BOX, DAMPING)
    corners = np.stack([limits_at(BOX, m, b, d) for m in BOX.mass for b in BOX.viscous_damping for d in (3.0, 5.0)])
    assert low == pytest.approx(corners.min(axis=0), rel=1e-3)
    assert high == pytest.approx(corners.max(axis=0), rel=1e-3)


@pytest.mark.parametrize("name", ["viscous_damping", "delay_samples"])
def test_limit_is_monotone_in_damping_and_delay(name):
    values = np.linspace(0.0, 40.0, 41) if name == "viscous_damping" else np.linspace(1.0, 8.0, 71)
    found = np.stack([limits_at(BOX, 0.58, x, 4.0) if name[0] == "v" else limits_at(BOX, 0.58, 4.0, x) for x in values])
    steps = np.diff(found, axis=0) * (1 if name == "viscous_damping" else -1)
    assert steps.min() >= -1e-6  # N/m: rounding of limits of 1e4
    assert steps.max() > 1.0


def test_reversed_interval_is_refused():
    with pytest.raises(ParameterError, match="mass"):
        theory_band(ParameterBox((0.6, 0.5), (2.0, 6.0), (3.0, 5.0), 1e-3), DAMPING)

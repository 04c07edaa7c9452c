"""`pipeline.Loop`: what theory says in normalised parameters, in SI."""

import mpmath as mp
import numpy as np
import pytest
from general_devices import ManyDigits
from independent import simulate
from pandas.testing import assert_frame_equal
from simulated import spectral_radius

import pipeline
from pipeline.base.errors import ParameterError
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.optimum import optimal_point

FALCON = pipeline.Loop(mass=0.58, damping=4.0, sampling_period_s=0.001, delay_samples=4)


def test_spectral_radius_is_that_of_the_independent_loop():
    K, B = np.array([500.0, 3000.0, 30000.0]), np.array([5.0, 20.0, 60.0])
    points = FALCON.points(K, B)
    expected = [spectral_radius(k, b, mass=0.58, b=4.0, delay=4) for k, b in zip(K, B, strict=True)]
    assert points["spectral_radius"].tolist() == pytest.approx(expected, rel=1e-10)
    assert points["stable"].tolist() == [radius < 1 for radius in expected] == [True, True, False]
    assert points["reason"].tolist()[2] == "unstable"
    assert points.loc[2, ["overshoot", "settle_2pct"]].isna().all()


@pytest.mark.parametrize("delay", [1, 2.5])
def test_boundary_is_where_the_radius_is_one(delay):
    loop = pipeline.Loop(0.19, 0.5, 0.001, delay, motion="rotation")
    border = loop.boundary(60)
    inner = border[border["stiffness"] > 0]
    found = loop.points(inner["stiffness"], inner["damping"])["spectral_radius"]
    assert found.to_numpy() == pytest.approx(1.0, abs=1e-7)
    assert border.attrs["units"] == {"damping": "Nms/rad", "stiffness": "Nm/rad"}
    assert border["stiffness"].max() == pytest.approx(border.attrs["stiffness_max"], rel=1e-3)
    assert border["damping"].max() <= border.attrs["damping_max"] * (1 + 1e-12)


def test_a_device_with_a_spring():
    loop = pipeline.Loop(0.58, 4.0, 0.001, 4, stiffness=500.0)
    assert loop.boundary()["stiffness"].min() == pytest.approx(-500.0, abs=1.0)


@pytest.mark.slow
def test_optimum_scales_with_mass_and_period():
    m, T = 2.0, 0.002
    loop = pipeline.Loop(m, 3.0, T, 3)
    best = loop.optimum("energy_step_w0")
    expected = optimal_point(NormalisedLoop.ideal(0.0, 3.0 * T / m, 3), "energy_step_w0")
    assert best.stiffness * T**2 / m == pytest.approx(expected.alpha, rel=1e-12)
    assert best.damping * T / m == pytest.approx(expected.beta, rel=1e-12)
    assert best.cost == expected.cost
    around = loop.points(best.stiffness * np.array([0.97, 1.03, 1, 1]), best.damping * np.array([1, 1, 0.97, 1.03]))
    assert (around["energy_step_w0"] > best.cost).all()
    discrete = loop.optimum("settle_2pct_discrete")
    low, high = discrete.box[:2]
    assert low <= discrete.stiffness <= high


def test_map_is_a_grid_over_the_stable_region():
    found = FALCON.map(size=7, criteria=["overshoot", "pole_radius"])
    assert list(found.columns) == ["stiffness", "damping", "stable", "overshoot", "pole_radius"]
    assert (found["damping"].to_numpy().reshape(7, 7) == found["damping"].to_numpy().reshape(7, 7)[:, :1]).all()
    inside = found[found["pole_radius"].notna()]
    again = FALCON.points(inside["stiffness"], inside["damping"])
    assert inside["pole_radius"].to_numpy() == pytest.approx(again["spectral_radius"].to_numpy(), rel=1e-9)
    assert found.loc[~found["stable"], ["overshoot", "pole_radius"]].isna().all(axis=None)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mass": 0.0}, "mass = 0"),
        ({"sampling_period_s": -1.0}, "sampling_period_s = -1"),
        ({"damping": -4.0}, "damping = -4"),
        ({"stiffness": float("nan")}, "stiffness = nan"),
        ({"delay_samples": -1}, "delay_samples = -1"),
        ({"delay_samples": 300}, "at most 256"),
        ({"stiffness": 1e9}, "oscillates faster than it is sampled"),
        ({"velocity": {"kind": "butterworth", "order": 2, "cutoff_hz": 600.0}}, "cutoff_hz: found 600"),
        ({"velocity": {"kind": "butterworth", "order": 7, "cutoff_hz": 60.0}}, "order = 7: Input should be less"),
        ({"velocity": {"kind": "coefficients", "b": [1.0], "a": [1.0, -2.0]}}, "expected a stable filter"),
        ({"actuator_lag_s": -1e-3}, "actuator_lag_s = -0.001"),
        ({"mode": {"frequency_hz": 60.0, "damping_ratio": -0.1, "mass": 0.1}}, "mode.damping_ratio = -0.1"),
        ({"mode": {"frequency_hz": 60.0, "damping_ratio": 0.1, "mass": 0.6}}, "mode.mass: found 0.6"),
        (
            {"mode": {"frequency_hz": 60.0, "damping_ratio": 0.1, "mass": 0.1, "load_damping": 4.1}},
            "load_damping: found 4.1; must not exceed the total damping of motor and load side, 4",
        ),
        ({"operator": {"damping": 5.0}}, "operator.mass = .*Field required"),
    ],
)
def test_parameters_out_of_range(given, message):
    with pytest.raises(ParameterError, match=message):
        pipeline.Loop(**({"mass": 0.58, "damping": 4.0, "sampling_period_s": 0.001, "delay_samples": 4} | given))


def test_damping_of_a_load_makes_no_wall_passive():
    """A hand may hold the motor's side still against the load's damper."""
    mode = {"frequency_hz": 60.0, "damping_ratio": 0.05, "mass": 0.1}
    damped = pipeline.Loop(0.58, 4.0, 0.001, 4, mode=mode | {"load_damping": 1.5}).passive()
    assert_frame_equal(damped, pipeline.Loop(0.58, 2.5, 0.001, 4, mode=mode).passive())
    assert pipeline.Loop(0.58, 4.0, 0.001, 4, mode=mode | {"load_damping": 4.0}).passive().stiffness.max() == 0


PARTS = {
    "velocity": {"kind": "butterworth", "order": 2, "cutoff_hz": 80.0},
    "actuator_lag_s": 0.001,
    "force_gain": 0.8,
    "mode": {"frequency_hz": 60.0, "damping_ratio": 0.05, "mass": 0.1, "sensor": "load"},
    "operator": {"mass": 0.15, "damping": 5.0, "stiffness": 300.0},
}


@pytest.mark.parametrize("left_out", [(), ("velocity", "mode"), ("actuator_lag_s", "velocity", "mode")])
def test_a_device_as_it_is(left_out):
    """The limit is where a loop in other states, in SI and many digits, loses its stability."""
    parts = {name: part for name, part in PARTS.items() if name not in left_out}
    loop = pipeline.Loop(0.58, 4.0, 0.001, 2.4, stiffness=50.0, **parts)
    border = loop.boundary(24)
    truth = ManyDigits(loop)
    with mp.workdps(40):
        for _, wall in border[border["stiffness"] > 0].iloc[2:-2:6].iterrows():
            K, B = wall["stiffness"], wall["damping"]
            assert [truth.stable(K * share, B) for share in (1 - 1e-8, 1 + 1e-8)] == [True, False]
    assert border.attrs["islands"] == []
    best = loop.optimum("energy_step_w0")
    around = loop.points(best.stiffness * np.array([1, 0.97, 1.03]), best.damping)["energy_step_w0"]
    assert around[0] == pytest.approx(best.cost, rel=1e-9)
    assert (around[1:] > best.cost).all()
    assert loop.map(size=5, criteria=["settle_2pct"])["settle_2pct"].notna().any()


def test_absent_parts_are_ideal():
    assert loop_frames(pipeline.Loop(0.58, 4.0, 0.001, 4, velocity=None, actuator_lag_s=0.0)) == loop_frames(FALCON)


def loop_frames(loop):
    return loop.boundary(20).to_numpy().tolist(), loop.points([3000.0], [20.0])["overshoot"].tolist()


def test_walls_that_are_none():
    for K, B in (([1.0, 2.0], [1.0, 2.0, 3.0]), ([np.nan], [1.0]), ("a", 1.0), (np.ones((2, 2)), 1.0)):
        with pytest.raises(ParameterError, match="stiffness and damping"):
            FALCON.points(K, B)
    with pytest.raises(ParameterError, match="expected a list"):
        FALCON.map(criteria="overshoot")
    with pytest.raises(ParameterError, match="expected one of"):
        FALCON.optimum("speed")


GENERAL = PARTS | {"mode": PARTS["mode"] | {"sensor": "motor"}}


@pytest.mark.parametrize("delay", [0, 1, 2.5, 3.2])
@pytest.mark.parametrize("signal", ["step", "impulse"])
def test_response_is_that_of_the_independently_stepped_loop(delay, signal):
    mass, period, K, B = 0.58, 0.001, 2500.0, 21.0
    found = pipeline.Loop(mass, 4.0, period, delay, 90.0).response(K, B, 40, signal=signal, per_sample=10)
    parts = (int(10 * delay), 10) if delay % 1 else (delay, 1)
    physical = {"mass": mass, "period": period, "gamma": 90.0, "delta": 4.0}
    motion = simulate(K, B, delay=parts, samples=40, signal=signal, fine=10, **physical)
    every = motion.every // 10
    truth = motion.x[::every]
    assert found["time_s"].to_numpy() == pytest.approx(np.arange(401) * 1e-4)
    assert found["position"].to_numpy() == pytest.approx(truth, abs=1e-10 * np.abs(truth).max())


def test_response_of_a_device_with_parts_ends_where_its_springs_say():
    loop = pipeline.Loop(0.5, 3.0, 0.001, 2.4, 40.0, **GENERAL)
    found = loop.response(1000.0, 8.0, 4000, per_sample=1)["position"]
    # 1 N of the command is 0.8 N; so much of the wall's stiffness is felt, beside the device's and the hand's springs
    assert found.iloc[-1] == pytest.approx(0.8 / (0.8 * 1000.0 + 40.0 + 300.0), rel=1e-6)
    hit = loop.response(1000.0, 8.0, 4000, per_sample=1, signal="impulse")["position"]
    # without force yet the near side, 0.55 kg of 0.65, has all of the momentum
    assert hit.iloc[1] == pytest.approx(1e-3 / 0.55, rel=0.02)
    assert abs(hit.iloc[-1]) < 1e-6 * hit.max()


def test_response_without_any_stiffness_creeps_at_the_speed_that_damping_allows():
    found = pipeline.Loop(1.0, 0.0, 1.0, 1).response(0.0, 0.25, 400, per_sample=1)["position"]
    assert np.diff(found)[-1] == pytest.approx(4.0, rel=1e-9)


def test_response_refuses_what_it_cannot_give():
    for words in ({"signal": "ramp"}, {"samples": 0}, {"per_sample": 0}, {"samples": 1 << 20, "per_sample": 16}):
        with pytest.raises(ParameterError, match="expected"):
            FALCON.response(100.0, 1.0, **words)


@pytest.mark.parametrize("criterion", ["settle_2pct", "energy_step_w1", "pole_radius"])
def test_best_damping_and_stiffness_are_not_beaten_by_their_neighbours(criterion):
    loop = pipeline.Loop(0.58, 4.0, 0.001, 2)
    for given, found in (
        ("stiffness", loop.best_damping([1500.0, 6000.0], criterion)),
        ("damping", loop.best_stiffness([40.0, 90.0], criterion)),
    ):
        other = {"stiffness": "damping", "damping": "stiffness"}[given]
        for row in found.to_dict("records"):
            name = "spectral_radius" if criterion == "pole_radius" else criterion
            around = np.sort(np.append(row[other] * np.linspace(0.9, 1.1, 21), row[other] * (1 + 1e-7)))
            costs = loop.points(**{given: row[given], other: around})[name]
            assert row["cost"] <= np.nanmin(costs) * (1 + 1e-6)
    assert found.attrs["units"]["stiffness"] == "N/m"
    assert np.isnan(loop.best_damping(1e9, criterion)["damping"]).all()


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_passive_walls_are_those_of_the_thesis_in_si(delay):
    mass, damping, period = 0.3, 2.5, 0.002
    found = pipeline.Loop(mass, damping, period, delay).passive()
    # Source: Hulin 2017, eq. 4.11
    assert found.attrs["stiffness_max"] == pytest.approx(
        2 * damping / period * np.tan(np.pi / (4 * (delay + 1))), rel=1e-7
    )
    assert found["stiffness"].max() <= found.attrs["stiffness_max"] * (1 + 1e-9)
    assert found["damping"].min() == pytest.approx(-damping)
    assert found.iloc[0].tolist() == found.iloc[-1].tolist()
    K, B = found["stiffness"].to_numpy(), found["damping"].to_numpy()
    inside = (1e-9 * K.max() < K) & (np.abs(B) < 0.999 * damping)
    # Colgate and Schenkel: b > K T/2 + |B|, without delay
    if delay == 0:
        assert K[inside] * period / 2 + np.abs(B[inside]) == pytest.approx(damping, rel=1e-6)
    assert pipeline.Loop(mass, 0.0, period, delay).passive().attrs["stiffness_max"] == 0.0


def test_a_map_of_the_damping_ratio_keeps_the_damping_of_the_walls():
    found = pipeline.Loop(1.0, 0.0, 1.0, 1).map(11, ["damping"])
    assert found["damping"].is_monotonic_increasing
    assert found["damping"].max() == pytest.approx(2 * np.sqrt(2) - 2, rel=1e-9)
    assert found["damping_ratio"].max() <= 1.0

"""Plans from one or few logs, of devices with friction, and from logs without a verdict: careful walls, true reasons.

Each test is named after its kind of fault and makes its own logs by a second simulator: fine steps, Coulomb friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, exp, inf
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from pipeline.base.errors import PipelineError
from pipeline.intake.ingest import ingest
from pipeline.measured.experiment.identified_loop import IdentifiedLoop, identified_loop
from pipeline.measured.identification.estimated import ESTIMATED
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.planning.campaign import Campaign, PlanOptions, open_campaign
from pipeline.planning.loop_limits import linear_limits, lowest_limits
from pipeline.planning.next_wall import Bracket, Forecast, PlanGoal, TriedWalls, bracket, plan_state, stiffest_stable
from pipeline.planning.planner import plan, plan_of, rounded_down
from pipeline.records.native import NativeHeader, format_header
from pipeline.store.storage import list_experiments
from pipeline.surface.identify import identify

T = 1e-3

SUBSTEPS = 10


@dataclass(frozen=True)
class Body:
    """Mass [kg], damping [Ns/m], delay [samples], Coulomb friction [N]."""

    mass: float
    damping: float
    delay: float
    friction: float = 0.0

    def move(self, K, B, step, rows, edge=20, resolution=1e-6, seed=None):
        """Return command and position of a trial whose step is in a row, by exact motion over parts of a sample.

        With a seed readings have noise of 0.4 of their resolution.
        """
        noise = np.zeros(rows) if seed is None else np.random.default_rng(seed).normal(0, 0.4 * resolution, rows)
        x = v = 0.0
        position, command = np.zeros(rows), np.zeros(rows)
        dt = T / SUBSTEPS
        late = ceil(self.delay * SUBSTEPS)
        decay = exp(-self.damping * dt / self.mass)
        for k in range(rows):
            position[k] = round((x + noise[k]) / resolution) * resolution if resolution else x
            speed = (position[k] - position[k - 1]) / T if k else 0.0
            command[k] = (step if k >= edge else 0.0) - K * position[k] - B * speed
            for part in range(SUBSTEPS):
                age = (k * SUBSTEPS + part - late) // SUBSTEPS
                force = command[age] if age >= 0 else 0.0
                if v == 0 and abs(force) <= self.friction:
                    continue
                driving = force - self.friction * (np.sign(v) or np.sign(force))
                final = driving / self.damping
                faster = final + (v - final) * decay
                if v * faster < 0:
                    x, v = x + 0.5 * v * dt * v / (v - faster), 0.0
                else:
                    x += final * dt + (v - final) * (1 - decay) * self.mass / self.damping
                    v = faster
            if abs(x) > 1e3:
                break
        return command, position

    def is_unstable(self, K, B, step):
        """Return whether the motion after a step grows, from its second quarter to its last one."""
        _, position = self.move(K, B, step, 1600, resolution=0.0)
        size = [np.ptp(part) for part in np.array_split(position, 4)]
        return bool(np.abs(position).max() > 1e2 or (size[3] > 1.05 * size[1] and size[3] > 1e-6 * np.ptp(position)))

    def radius(self, K, B):
        """Return the spectral radius of the linear loop: states are position, velocity, last position and commands."""
        late = ceil(self.delay)
        first = late - self.delay
        rate = np.array([[0.0, 1.0, 0.0], [0.0, -self.damping / self.mass, 1 / self.mass], [0.0, 0.0, 0.0]])
        whole, old, new = (expm(rate * T * share) for share in (1.0, 1 - first, first))
        size = 3 + late
        loop = np.zeros((size, size))
        wall = np.zeros(size)
        wall[[0, 2]] = -K - B / T, B / T
        # the command of a sample acts from `delay` later on: that of `late` samples ago first, then the next one
        before = np.eye(size)[size - 1] if late else wall
        after = np.eye(size)[size - 2] if late > 1 else wall
        loop[:2, :2] = whole[:2, :2]
        loop[:2] += np.outer((new @ old[:, 2])[:2] - new[:2, 2], before) + np.outer(new[:2, 2], after)
        loop[2, 0] = 1.0
        if late:
            loop[3] = wall
            loop[range(4, size), range(3, size - 1)] = 1.0
        return float(np.abs(np.linalg.eigvals(loop)).max())

    def limit(self, B):
        """Return the exact limit without friction [N/m], by the spectral radius and bisection from soft walls on."""
        low, high = 0.0, 1e-3 * self.mass / T**2
        while self.radius(high, B) <= 1 + 1e-12:
            low, high = high, 1.5 * high
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.radius(middle, B) > 1 + 1e-12 else (middle, high)
        return low


def store(folder: Path, body: Body, trials, step=4.0, rows=321, edge=20, still=False, noisy=False) -> Path:
    """Write the logs of trials (K, B, perhaps another step) and take them in, with those that are there."""
    logs = folder / "logs"
    logs.mkdir(exist_ok=True)
    for number, (K, B, *own) in enumerate(trials, len(list(logs.iterdir()))):
        force = own[0] if own else step
        command, position = body.move(K, B, force, rows, edge, seed=number if noisy else None)
        position = 0 * position if still else position
        # a copy of a log is no second trial
        command[0] = number * 1e-9
        head = format_header(NativeHeader("dev", "1", K, B, force, T))
        lines = (f"{k * T:.17g},{u:.17g},{x:.17g}\n" for k, (u, x) in enumerate(zip(command, position, strict=True)))
        (logs / f"{number}.csv").write_text(head + "".join(lines), encoding="utf-8")
    ingest([logs], folder / "processed")
    return folder / "processed"


RUBBING = [
    (Body(0.5, 3.0, 2.4, 0.3), (1500.0, 15.0), 4.0),
    (Body(0.12, 0.6, 1.3, 0.2), (500.0, 6.0), 2.0),
    (Body(2.0, 5.0, 4.6, 0.5), (1200.0, 40.0), 8.0),
]


@pytest.mark.parametrize(
    ("body", "wall", "step"), RUBBING[:1] + [pytest.param(*each, marks=pytest.mark.slow) for each in RUBBING[1:]]
)
def test_one_log_friction_plan(tmp_path, body, wall, step):
    processed = store(tmp_path, body, [wall], step)
    assert not body.is_unstable(*wall, step)
    campaign = open_campaign("dev", processed, None, PlanOptions())
    for options in (
        PlanOptions(),
        PlanOptions(gentle=True),
        PlanOptions(dampings=(0.0, wall[1], 1.5 * wall[1]), count=3),
    ):
        answer = plan_of(campaign, options)
        assert not answer.done
        for asked in answer.next:
            assert asked.stiffness <= 2 * wall[0]
            assert not body.is_unstable(asked.stiffness, asked.damping, step)
            assert not options.gentle or asked.stiffness < body.limit(asked.damping)
    assert any("friction" in remark and "more logs" in remark for remark in answer.remarks)


@pytest.mark.parametrize("count", [5, *(pytest.param(count, marks=pytest.mark.slow) for count in (1, 4, 6, 9))])
def test_same_wall_plan_done(tmp_path, count):
    body = Body(0.5, 3.0, 2.4)
    answer = plan("dev", store(tmp_path, body, [(1500.0, 15.0)] * count))
    assert not answer.done
    (limit,) = answer.boundary
    assert (limit.low, limit.high, limit.note) == (1500.0, None, "")
    (asked,) = answer.next
    assert asked.stiffness != 1500.0
    assert asked.stiffness < body.limit(15.0)


SAME_WALL = [
    (Body(0.5, 3.0, 2.4), (1500.0, 15.0), 4.0, 5),
    (Body(0.5, 3.0, 2.4, 0.3), (1500.0, 15.0), 4.0, 5),
    (Body(2.0, 5.0, 4.6, 0.5), (1200.0, 40.0), 8.0, 5),
    (Body(0.05, 0.3, 1.6, 0.02), (300.0, 2.0), 1.0, 2),
    (Body(0.5, 3.0, 2.4), (1500.0, 50.0), 4.0, 2),
    (Body(0.5, 3.0, 2.4, 0.2), (3000.0, 30.0), 4.0, 3),
]


@pytest.mark.parametrize(
    ("body", "wall", "step", "count"),
    SAME_WALL[:2] + [pytest.param(*each, marks=pytest.mark.slow) for each in SAME_WALL[2:]],
)
def test_same_wall_plan_done_identifies_the_device(tmp_path, body, wall, step, count):
    campaign = open_campaign("dev", store(tmp_path, body, [wall] * count, step, noisy=True), None, PlanOptions())
    assert campaign.found is not None, campaign.unknown
    assert campaign.found.loop.mass == pytest.approx(body.mass, rel=0.03)
    dampings = np.array([wall[1], 2 * wall[1]])
    assert linear_limits(campaign.found.loop, dampings) == pytest.approx([body.limit(B) for B in dampings], rel=0.05)
    (asked,) = plan_of(campaign, PlanOptions()).next
    assert (asked.damping, asked.stiffness > wall[0]) == (wall[1], True)
    assert not body.is_unstable(asked.stiffness, asked.damping, step)


@pytest.mark.parametrize("step", [250.0, 1000.0])
def test_a_plan_names_what_a_rig_set_in_place_of_the_wall_that_was_stored_as_asked(tmp_path, step):
    body, wall = Body(0.5, 3.0, 2.4), (1500.0, 15.0)
    processed = store(tmp_path, body, [wall] * 2)
    before = sorted(processed.rglob("*"))
    plan("dev", processed)
    assert not list(processed.rglob("asked-*")), "a plan in Python stores nothing"
    asked = plan("dev", processed, remembered=True).next[0]
    assert len(list(processed.rglob("asked-*"))) == 1
    assert set(before) <= set(processed.rglob("*"))
    got = step * (asked.stiffness // step)
    store(tmp_path, body, [(got, 15.0)])
    for _ in range(2):  # asked once more without new logs it says the same
        remarks = plan("dev", processed, remembered=True).remarks
        said = f"requested K = {asked.stiffness:g} N/m, B = 15 Ns/m, the rig set K = {got:g} N/m "
        said += "(deviating walls: 1 of 1 wall so far)"
        assert (said in remarks) is (got != asked.stiffness)


@pytest.mark.parametrize("verdict", ["stable", "unstable"])
@pytest.mark.parametrize("count", [2, 4, 7, 30])
def test_same_wall_plan_done_without_a_device(verdict, count):
    tried = TriedWalls(np.full(count, 800.0), np.full(count, 5.0), np.full(count, verdict), np.full(count, 9.0))
    assert not plan_state(tried, PlanGoal((5.0,), bold=2.0)).done


def test_two_walls_repeated_as_often_are_no_step_of_a_rig():
    for count in (4, 8):
        stiffness, damping = np.repeat([1000.0, 20_000.0], count), np.full(2 * count, 5.0)
        tried = TriedWalls(stiffness, damping, np.repeat(["stable", "unstable"], count), np.full(2 * count, 9.0))
        (column,) = plan_state(tried, PlanGoal((5.0,))).columns
        assert 1000.0 < column.wall < 20_000.0
    # walls inside the bracket were set at another damping
    stiffness, verdict = np.array([1000.0, *[5000.0] * 4]), np.array(["stable", *["unstable"] * 4])
    alone = TriedWalls(stiffness, np.full(5, 5.0), verdict, np.full(5, 9.0))
    other = TriedWalls(np.append(stiffness, [2000.0, 3000.0]), np.append(alone.damping, [9.0, 9.0]),
                  np.append(verdict, ["stable", "unstable"]), np.full(7, 9.0))  # fmt: skip
    assert plan_state(alone, PlanGoal((5.0,))).columns[0].note == "step of the rig"
    assert plan_state(other, PlanGoal((5.0,))).columns[0].wall == pytest.approx(3000.0)


@pytest.mark.parametrize("stiffness", [0.0, pytest.param(-50.0, marks=pytest.mark.slow)])
def test_plan_dampings_no_walls(tmp_path, stiffness):
    body = Body(0.5, 3.0, 2.4, 0.3)
    steps = [sign * size for size in (0.8, 1.2, 2.0) for sign in (1, -1)]
    processed = store(tmp_path, body, [(stiffness, 0.0, step) for step in steps])
    campaign = open_campaign("dev", processed, None, PlanOptions())
    for options in (
        PlanOptions(dampings=(0.0, 20.0), count=2),
        PlanOptions(count=12),
        PlanOptions(count=12, gentle=True),
    ):
        answer = plan_of(campaign, options)
        assert not answer.done
        assert all(limit.estimate is None and not limit.note for limit in answer.boundary)
        assert len(answer.next) == options.count
        share = 0.3 if options.gentle else 0.5
        for asked in answer.next:
            assert 0.2 < asked.stiffness / body.limit(asked.damping) <= 1.02 * share
    assert plan_of(campaign, PlanOptions(goal="optimum")).next


def test_plan_dampings_no_walls_and_no_motion(tmp_path):
    processed = store(tmp_path, Body(0.5, 3.0, 2.4), [(0.0, 0.0), (0.0, 5.0)], still=True)
    for options in (PlanOptions(), PlanOptions(dampings=(0.0, 20.0))):
        with pytest.raises(PipelineError, match=r"position does not change.*larger steps.*initial range"):
            plan("dev", processed, None, options)


@pytest.mark.parametrize("rows", [28, 32])
def test_undecided_done(tmp_path, rows):
    walls = [(K, B) for B in (5.0, 10.0, 20.0) for K in (300.0, 1000.0, 4000.0)]
    processed = store(tmp_path, Body(0.5, 3.0, 2.4, 0.2), walls, rows=rows)
    campaign = open_campaign("dev", processed, None, PlanOptions())
    for options in (PlanOptions(), PlanOptions(goal="optimum"), PlanOptions(gentle=True)):
        answer = plan_of(campaign, options)
        assert not answer.done
        assert (answer.next[0].stiffness, answer.next[0].damping) in walls
        assert "longer" in answer.next[0].why
        assert all(limit.estimate is None for limit in answer.boundary)
        assert any(remark.startswith("no verdict in 9 of 9 trials") and "longer" in remark for remark in answer.remarks)


def test_position_constant(tmp_path):
    walls = [(K, B) for B in (5.0, 20.0) for K in (0.0, 500.0, 1500.0, 5000.0)]
    answer = plan("dev", store(tmp_path, Body(0.5, 3.0, 2.4), walls, still=True))
    assert not answer.done
    assert "larger step" in answer.next[0].why
    assert any("does not change in any log" in remark and "larger steps" in remark for remark in answer.remarks)
    assert ".." not in str(answer)


@pytest.mark.parametrize("edge", [100, 96, 91])
def test_edge_late_plan(tmp_path, edge):
    walls = [(K, B) for B in (5.0, 20.0) for K in (500.0, 5000.0)]
    answer = plan("dev", store(tmp_path, Body(0.5, 3.0, 2.4), walls, rows=101, edge=edge))
    assert not answer.done
    assert (answer.next[0].stiffness, answer.next[0].damping) in walls


@pytest.mark.parametrize(("rows", "edge"), [(3, 0), (4, 1), (6, 0)])
def test_rows3_edge0(tmp_path, rows, edge):
    answer = plan("dev", store(tmp_path, Body(0.5, 3.0, 2.4), [(300.0, 5.0)], rows=rows, edge=edge))
    assert (answer.done, answer.boundary[0].estimate) == (False, None)
    assert answer.next[0].stiffness == 300.0
    assert any("usable rows" in remark and "longer" in remark for remark in answer.remarks)


@pytest.mark.parametrize("stiffness", [1500.0, 40.0])
def test_one_short_estimate(tmp_path, stiffness):
    answer = plan("dev", store(tmp_path, Body(0.5, 3.0, 2.4), [(stiffness, 15.0)], rows=26))
    (limit,), (asked,) = answer.boundary, answer.next
    assert (limit.estimate, limit.low, limit.high) == (None, None, None)
    assert asked.stiffness == stiffness
    assert "longer than 0.026 s" in asked.why


@pytest.mark.parametrize("count", [1, 2])
def test_few_logs_expect_no_stiffer_wall_to_be_stable(tmp_path, count):
    processed = store(tmp_path, Body(0.5, 3.0, 2.4), [(1500.0, 15.0), (2000.0, 15.0)][:count], noisy=True)
    for gentle in (False, True):
        for wall in plan("dev", processed, options=PlanOptions(gentle=gentle, dampings=(15.0, 30.0))).next:
            assert wall.expected != "stable"


@pytest.mark.slow
def test_the_device_of_a_plan_is_that_of_identify(tmp_path):
    walls = [(1000.0, 10.0), (1500.0, 15.0, -4.0), (2000.0, 15.0), (800.0, 5.0, -4.0)]
    processed = store(tmp_path, Body(0.5, 3.0, 2.4, 0.1), walls, noisy=True)
    planned = open_campaign("dev", processed, None, PlanOptions()).found
    estimates = identify(tmp_path / "logs").estimates.set_index("name")
    for name in ("mass", "damping", "delay_samples", "friction.coulomb"):
        each, stated = planned.interval(name), estimates.loc[ESTIMATED[name].key]
        unit = T if stated["unit"] == "s" else 1.0
        ends = np.array([stated["value"], stated["low"], stated["high"]]) / unit
        np.testing.assert_allclose([each.value, each.low, each.high], ends, rtol=1e-9, err_msg=name)


def test_the_device_of_a_plan_is_that_of_the_last_comparison_of_the_same_logs(tmp_path):
    walls = [(1000.0, 10.0), (1500.0, 15.0, -4.0), (2000.0, 15.0), (800.0, 5.0, -4.0)]
    processed = store(tmp_path, Body(0.5, 3.0, 2.4, 0.1), walls, noisy=True)
    (experiment,) = list_experiments(processed, "dev")
    stages = ExperimentStages.stored(processed, "dev", experiment)
    compared = identified_loop(stages)

    def look(_):
        raise AssertionError("a comparison has chosen the parts")

    planned = open_campaign("dev", processed, None, PlanOptions(), look=look).found
    assert planned.values == compared.values
    np.testing.assert_array_equal(planned.covariance, compared.covariance)
    (tmp_path / "alone").mkdir()
    with pytest.raises(AssertionError, match="chosen"):
        open_campaign("dev", store(tmp_path / "alone", Body(0.5, 3.0, 2.4, 0.1), walls), None, PlanOptions(), look=look)


def walls_at(*trials):
    stiffness, verdict = (np.array([trial[i] for trial in trials]) for i in range(2))
    return TriedWalls(stiffness, np.full(len(trials), 15.0), verdict, np.full(len(trials), 9.0))


@pytest.mark.parametrize("scale", [1.0, 40.0])
@pytest.mark.parametrize("times", [1, 2])
def test_contradictory_walls(scale, times):
    both = [(k * scale, verdict) for k in (1000.0, 4000.0) for verdict in ("stable", "unstable")] * times
    tried = walls_at(*both)
    (column,) = plan_state(tried, PlanGoal((15.0,))).columns
    assert column.wall == 1000.0 * scale
    assert column.bracket.even == column.bracket.again == (1000.0 * scale, 4000.0 * scale)
    # it is enclosed by walls whose verdicts agree, and those of more trials decide
    ends = [(500.0 * scale, "stable"), (9000.0 * scale, "unstable")]
    found = bracket(*(getattr(walls_at(*both, *ends), name) for name in ("stiffness", "verdict")))
    assert (found.low, found.high) == (500.0 * scale, 9000.0 * scale)
    decided = walls_at(*both, *ends, (1000.0 * scale, "stable"), (4000.0 * scale, "unstable"))
    assert bracket(decided.stiffness, decided.verdict).again == ()


def test_a_wall_stays_contradictory_up_to_six_trials():
    for times, again in ((2, (2000.0,)), (3, ())):
        tried = walls_at((1000.0, "stable"), *[(2000.0, "stable"), (2000.0, "unstable")] * times, (5000.0, "unstable"))
        found = bracket(tried.stiffness, tried.verdict)
        assert (found.low, found.again, found.high) == (1000.0, again, 5000.0 if again else 2000.0)


def course_of(tried):
    return Campaign(
        "dev", "1", tried, None, None, T, 0.3, 4.0, "translation", unknown="the logs do not identify a device."
    )


def test_contradictory_walls_are_named():
    tried = walls_at((1000.0, "stable"), (1000.0, "unstable"), (4000.0, "unstable"), (4000.0, "stable"))
    answer = plan_of(course_of(tried), PlanOptions())
    assert (answer.next[0].stiffness, answer.done) == (1000.0, False)
    assert "logs contradict each other at B = 15 Ns/m" in answer.next[0].why
    assert (
        "equal numbers of stable and unstable trials at 1000, 4000 N/m; repeat these walls first" in answer.next[0].why
    )


def test_an_estimate_needs_a_stable_or_an_unstable_trial_and_without_a_device_both():
    trials = [(1000.0, "stable"), (4000.0, "unstable"), (9000.0, "undecided")]
    for places, known in (([2], False), ([0], False), ([1], False), ([0, 1], True)):
        (limit,) = plan_of(course_of(walls_at(*(trials[i] for i in places))), PlanOptions()).boundary
        assert (limit.estimate is not None) is known


def test_a_rig_that_answers_by_its_stiffest_wall_is_reported():
    trials = [(2500.0, "stable"), *[(5000.0, "stable")] * 7]
    for count, done in ((7, False), (8, True)):
        answer = plan_of(course_of(walls_at(*trials[:count])), PlanOptions())
        assert answer.done is done
        assert ("no wall above low" in answer.boundary[0].note) is done


def test_undecided_walls_near_the_limit_are_enclosed_from_farther_away():
    by, undecided = Forecast(np.array([5000.0]), np.array([10.0])), [(K, "undecided") for K in (4900.0, 4950.0, 5000.0)]
    assert plan_state(walls_at(*undecided), PlanGoal((15.0,)), by).columns[0].wall == pytest.approx(0.7 * 4900.0)
    ends = [(3400.0, "stable"), (5400.0, "unstable")]
    (column,) = plan_state(walls_at(*undecided, *ends), PlanGoal((15.0,)), by).columns
    assert (column.wall, column.estimate, column.note) == (None, None, "undecided")
    twice = walls_at(*undecided, *undecided[:2])
    stiffer, softer = (
        plan_state(twice, PlanGoal((15.0,), gentle=gentle), by).columns[0].wall for gentle in (False, True)
    )
    assert softer < 4900.0 < 5000.0 < stiffer
    often = walls_at(*undecided, *undecided)
    assert plan_state(often, PlanGoal((15.0,)), by).columns[0].wall == 4900.0, "with a longer log"
    # that ends where others have verdicts, and never without one
    lasting = [walls_at(*undecided * count) for count in (2, 3)]
    other = TriedWalls(*(np.array([each]) for each in (1000.0, 9.0, "stable", -9.0)))
    for trials, done in zip(lasting, (False, True), strict=True):
        with_other = TriedWalls(*(np.append(getattr(trials, name), getattr(other, name))
                             for name in ("stiffness", "damping", "verdict", "growth")))  # fmt: skip
        assert plan_state(with_other, PlanGoal((15.0,)), by).done is done
        assert not plan_state(trials, PlanGoal((15.0,)), by).done


HANDS = [(20.0, 1.0, 3.0), (1000.0, 1.0, 3.0), (20.0, 0.0, 0.0), (3.0, 0.2, 0.5)]


@pytest.mark.parametrize(("mass", "damping", "own"), HANDS)
@pytest.mark.parametrize("gentle", [False, True])
def test_parts_and_outputs_first_wall_with_a_heavy_hand(tmp_path, mass, damping, own, gentle):
    file = tmp_path / "hand.toml"
    file.write_text(
        f"sampling_period_s = 0.001\nmass = 0.5\ndamping = {own}\ndelay_samples = 2.0\n"
        f"[loop]\noperator = {{ mass = {mass}, damping = {damping} }}\n",
        encoding="utf-8",
    )
    body = Body(0.5 + mass, own + damping, 2.0)
    answer = plan(str(file), tmp_path / "none", None, PlanOptions(count=12, gentle=gentle))
    assert len(answer.next) == (12 if body.damping else 11), "no wall where none is stable"
    for asked in answer.next[:: 1 if body.damping else 3]:
        assert asked.stiffness <= (0.3 if gentle else 0.5) * body.limit(asked.damping) * (1 + 1e-6)
    alone = plan(str(file), tmp_path / "none", None, PlanOptions(dampings=(0.0,), gentle=gentle)).next[0]
    if not body.damping:
        assert (alone.expected, alone.stiffness < 1e-3 * body.mass / T**2) == ("unstable", True)


def test_the_lowest_limit_is_that_of_all_devices_in_the_range():
    values = {"mass": 0.5, "damping": 3.0, "delay_samples": 2.4, "friction.coulomb": 0.3}
    B, random = np.array([0.0, 15.0, 60.0]), np.random.default_rng(3)
    for size, closest in ((0.02, 0.02), (0.25, 0.15)):
        spread = size * np.array([0.5, 3.0, 2.4, 0.3])
        likeness = np.full((4, 4), 0.6) + 0.4 * np.eye(4)
        found = IdentifiedLoop(values, likeness * np.outer(spread, spread), T, parts=("friction",))
        root = np.linalg.cholesky(likeness * np.outer(spread, spread))
        away = random.standard_normal((400, 4))
        away *= 1.96 / np.linalg.norm(away, axis=1, keepdims=True)
        numbers = np.array([*values.values()]) + away @ root.T
        limits = np.array(
            [linear_limits(found.at(dict(zip(values, each, strict=True))), B) for each in numbers.tolist()]
        )
        lowest, limit = lowest_limits(found, B), linear_limits(found.loop, B)
        assert (lowest <= limits.min(axis=0) + closest * limit).all()
        assert (lowest >= limits.min(axis=0) - closest * limit).all()
    # the range of an exact device is itself
    exact = IdentifiedLoop(values, np.zeros((4, 4)), T)
    assert lowest_limits(exact, B) == pytest.approx(linear_limits(exact.loop, B))


def test_a_wall_is_not_above_the_lowest_limit_before_one_near_it_was_stable():
    limit, low = np.array([10_000.0]), np.array([6000.0])
    by = Forecast(limit, np.array([1500.0]), low=low)
    for first, highest in ((1000.0, 6000.0), (5900.0, inf)):
        tried = TriedWalls(np.array([first]), np.array([60.0]), np.array(["stable"]), np.array([-9.0]))
        wall = plan_state(tried, PlanGoal((60.0,)), by).columns[0].wall
        assert wall <= highest
        assert wall > first
    assert wall > 6000.0, "only such a wall closes the bracket"


def test_a_rig_is_spared_by_few_logs_of_an_unknown_device():
    tried = TriedWalls(np.array([1000.0]), np.array([60.0]), np.array(["stable"]), np.array([-9.0]))
    walls = [plan_state(tried, PlanGoal((60.0,), gentle=True, bold=bold, few=few)).columns[0].wall
             for bold, few in ((1.3, True), (1.3, False))]  # fmt: skip
    assert walls[0] < 1000.0 < walls[1] <= 1300.0


def test_stable_walls_count_with_more_damping_and_in_proportion_with_less():
    tried = TriedWalls(np.array([1000.0, 3000.0, 6000.0, 9000.0]), np.array([5.0, 20.0, 20.0, 20.0]),
                  np.array(["stable", "stable", "unstable", "stable"]), np.zeros(4))  # fmt: skip
    found = [stiffest_stable(tried, B) for B in (0.0, 5.0, 10.0, 20.0, 50.0)]
    assert found == pytest.approx([300.0, 1000.0, 1500.0, 3000.0, 3000.0])
    unstable = tried.select(np.array([False, False, True, False]))
    assert stiffest_stable(unstable, 20.0) == 1500.0


def test_bounds_are_rounded_to_the_safe_side():
    for value in (12_347.678, 3.29, 0.0123456, 999.9999):
        down = rounded_down(value, 500.0)
        assert 0.89 * value < down <= value
    assert rounded_down(800.0, 13_000.0) == 800.0
    assert Bracket().bottom == 0.0


def test_a_rig_is_spared_walls_where_the_device_has_no_stable_one():
    by = Forecast(np.array([9000.0, 0.0]), np.array([900.0, 900.0]))
    trials = TriedWalls(
        np.array([8900.0, 9100.0]), np.full(2, 60.0), np.array(["stable", "unstable"]), np.array([-9.0, 9.0])
    )
    plain, gentle = (
        plan_state(trials, PlanGoal((60.0, 120.0), gentle=gentle), by).columns[1] for gentle in (False, True)
    )
    assert (gentle.wall, gentle.note) == (None, "no stable wall")
    assert plain.wall is not None

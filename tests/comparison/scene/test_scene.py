from __future__ import annotations

import shutil

import pytest
from native_logs import log_text

from pipeline.base.errors import DeviceError, StoreError, UsageError
from pipeline.comparison.scene.scene import LEAVE_OUT, REUSE, RUN, needed_stages, open_scene, plan_measured
from pipeline.intake.ingest import ingest
from pipeline.measured.stages.stages import STAGES
from pipeline.store.storage import stage_file

# What each quantity needs, from the definitions (6.1.4, 6.2.2): overshoot and boundary need neither delay nor mass,
# settling needs the delay, energy delay and mass; the mass comes from the model or is corrected by the damping
ALWAYS = {"response", "wall_law", "outcome", "boundary"}
NEEDED = {
    ("overshoot",): ALWAYS | {"overshoot"},
    ("settle_2pct",): ALWAYS | {"wall_law", "parts", "device", "model", "delay", "settling"},
    ("settle_1pct", "overshoot"): ALWAYS | {"wall_law", "parts", "device", "model", "delay", "settling", "overshoot"},
    ("energy_step_w1",): ALWAYS | {"wall_law", "parts", "device", "model", "delay", "energy", "mass"},
}


@pytest.mark.parametrize("criteria", NEEDED, ids=",".join)
def test_known_device_needs_no_more_than_its_criteria(falcon, criteria):
    data = open_scene("falcon", falcon.processed, None, criteria)
    assert needed_stages(data) == NEEDED[criteria]
    left_out = {p.stage for p in plan_measured(data) if p.action == LEAVE_OUT}
    everything = set(STAGES) - {"rise"}  # named only where it is asked for
    assert left_out == {f"1: {stage}" for stage in everything - NEEDED[criteria]}
    assert all(p.reason for p in plan_measured(data))


def test_unknown_device_needs_its_estimates_for_any_theory(unknown):
    data = open_scene("mydevice", unknown.processed, None, ("overshoot",))
    assert data.device is None
    assert data.overlay
    assert needed_stages(data) == ALWAYS | {"wall_law", "overshoot", "parts", "device", "model", "delay", "mass"}


def test_all_criteria_need_all_stages(falcon):
    data = open_scene("falcon", falcon.processed, None, None)
    assert len(needed_stages(data)) == 12
    assert data.overlay
    assert len(data.scene.criteria) == 7


def test_scene_of_a_sweep_and_of_one_of_its_delays(lwr):
    both = open_scene("lwr", lwr.processed, None, None)
    assert both.scene.experiments == ("delay-2", "delay-4")
    assert both.scene.delay_sweep
    assert not both.scene.operator
    assert both.simulated
    one = open_scene("lwr", lwr.processed, ["delay-4"], None)
    assert one.scene.experiments == ("delay-4",)
    assert not one.scene.delay_sweep


def test_double_requests_count_once_and_keep_the_stored_order(lwr):
    data = open_scene("lwr", lwr.processed, ["delay-4", "delay-2", "delay-4"], ["overshoot", "overshoot"])
    assert data.scene.experiments == ("delay-2", "delay-4")
    assert data.scene.criteria == ("overshoot",)


def test_requests_that_do_not_fit_say_what_there_is(falcon, tmp_path):
    with pytest.raises(UsageError, match=r"unknown criterion 'settling'.*settle_2pct"):
        open_scene("falcon", falcon.processed, None, ["overshoot", "settling"])
    with pytest.raises(DeviceError, match=r"no logs of experiment '9'; found 1"):
        open_scene("falcon", falcon.processed, ["1", "9"], None)
    with pytest.raises(DeviceError, match=r"no logs of device 'phantom'; found falcon.*pipeline ingest"):
        open_scene("phantom", falcon.processed, None, None)
    with pytest.raises(DeviceError, match="found none at all"):
        open_scene("falcon", tmp_path, None, None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_plan_goes_from_run_to_reuse_and_follows_changes(falcon, noisy, tmp_path):
    processed = tmp_path / "processed"
    shutil.copytree(falcon.processed / "trials", processed / "trials")

    def actions(criteria):
        data = open_scene("falcon", processed, None, criteria)
        return data, {p.stage.removeprefix("1: "): (p.action, p.reason) for p in plan_measured(data)}

    data, plan = actions(("settle_2pct",))
    assert plan["settling"] == (RUN, "no result is stored")
    for stage in needed_stages(data):
        data.experiments[0].table(stage)
    _, plan = actions(("settle_2pct", "overshoot"))
    assert {s for s, (action, _) in plan.items() if action == REUSE} == NEEDED["settle_2pct",]
    assert {s for s, (action, _) in plan.items() if action == RUN} == {"overshoot"}
    # a stage of other logs under the same name
    stage_file(processed, "falcon", "1", "settling").unlink()
    noisy.stages("1").table("settling")
    shutil.copy(stage_file(noisy.processed, "falcon", "1", "settling"), processed / "stages/falcon/1")
    _, plan = actions(("settle_2pct",))
    assert plan["settling"][0] == RUN
    assert "changed" in plan["settling"][1]


def test_grips_make_an_operator_and_mixed_motion_is_refused(falcon, tmp_path):
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "a.csv").write_text(log_text(device="bench", experiment="a", grip="firm"))
    (logs / "b.csv").write_text(log_text(device="bench", experiment="b", seed=1, motion="rotation"))
    ingest([logs], tmp_path / "processed")
    with pytest.raises(StoreError, match=r"'bench': its logs mix rotation and translation.*--experiment"):
        open_scene("bench", tmp_path / "processed", None, None)
    data = open_scene("bench", tmp_path / "processed", ["a"], None)
    assert data.scene.operator
    assert not data.simulated
    assert not open_scene("falcon", falcon.processed, None, None).scene.operator

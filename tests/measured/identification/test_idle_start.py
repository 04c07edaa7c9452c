"""A time at the start of logs in which the command does not act: found, and not found where it acts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from force_rigs import DAMPING, MASS, ForceRig, T
from real_drives import KINDS

from pipeline.measured.identification.idle_start import identified_while_driven, suspected_rows
from pipeline.measured.identification.recordings import Recording

IDLE = 350


def without_force(logs):
    return [replace(each, force=None) for each in logs]


@pytest.fixture(scope="module")
def late():
    """A drive that is switched on after 350 rows."""
    rig = ForceRig(gain=1.0, lag=0.0, idle_rows=IDLE, rows=900, position_noise=1e-5)
    return without_force(rig.logs(3))


def test_rows_before_the_drive_is_on_are_left_out_and_the_device_is_identified(late):
    found, idle = identified_while_driven(late)
    assert [each.log for each in idle] == [each.name for each in late]
    for each in idle:
        assert IDLE <= each.rows <= IDLE + 20
        assert each.duration_s == pytest.approx(T * each.rows)
    assert found.parameters["mass"].value == pytest.approx(MASS, rel=1e-3)
    assert found.parameters["damping"].value == pytest.approx(DAMPING, rel=1e-2)
    assert found.fit_percent > 99


def test_only_the_logs_that_begin_without_a_drive_are_cut(late):
    on = without_force([ForceRig(gain=1.0, lag=0.0, rows=900, position_noise=1e-5).log(5)])
    found, idle = identified_while_driven([late[0], *on, late[1]])
    assert [each.log for each in idle] == [late[0].name, late[1].name]
    assert found.parameters["mass"].value == pytest.approx(MASS, rel=1e-3)


@pytest.mark.slow
def test_a_device_that_friction_fixes_at_first_has_no_idle_start():
    logs = without_force(ForceRig(gain=1.0, lag=0.0, rows=900, friction=2.0, position_noise=1e-5).logs(3))
    first_motion = [int(np.argmax(np.abs(each.position - each.position[0]) > 1e-3)) for each in logs]
    assert max(first_motion) > 100
    assert identified_while_driven(logs)[1] == []


def breakaway(static, level, rows=900):
    """A device with a static friction of ``static`` and a Coulomb friction of 1 N under steps of growing size."""
    command = np.zeros(rows)
    for start, size in ((30, level), (250, -level), (450, 2.2 * level), (600, -2.2 * level), (750, 2.5 * level)):
        command[start:] = size
    x, v, position, fine = 0.0, 0.0, np.zeros(rows), 20
    for row in range(rows):
        position[row] = x
        for _ in range(fine):
            u = command[max(row - 1, 0)]
            left = u - DAMPING * v
            left -= np.sign(v) if v else np.clip(left, -static, static)
            if not v and abs(u) > static:
                left = u - np.sign(u)
            new = v + T / fine * left / MASS
            v = 0.0 if v * new < 0 else new
            x += T / fine * v
    position += 1e-6 * np.random.default_rng(int(10 * level)).standard_normal(rows)
    return Recording(f"{level}", T * np.arange(rows), command, position, T)


@pytest.mark.slow
def test_static_friction_is_no_idle_start():
    logs = [breakaway(1.9, level) for level in (1.5, 1.7, 1.8)]
    assert all(np.ptp(each.position[:440]) < 1e-4 for each in logs)
    _, idle = identified_while_driven(logs)
    assert idle == []


def test_a_slow_start_is_not_suspected():
    time = T * np.arange(4000)
    position = np.round(0.5 * 0.02 * np.maximum(time - 0.03, 0) ** 2 / 1e-4) * 1e-4
    log = Recording("heavy", time, np.where(time > 0.03, 2.0, 0.0), position, T)
    assert int(np.argmax(position > 3e-4)) > 150
    assert suspected_rows(log) == 0


def test_a_long_time_without_a_command_is_not_suspected(late):
    on = without_force([ForceRig(gain=1.0, lag=0.0, rows=500, position_noise=1e-5).log(5)])[0]
    assert suspected_rows(on) == 0
    rest = 500
    before = replace(
        on,
        time=T * np.arange(rest + len(on.time)),
        command=np.concatenate([np.zeros(rest), on.command]),
        position=np.concatenate([np.full(rest, on.position[0]), on.position]),
    )
    assert suspected_rows(before) == 0
    assert suspected_rows(late[0]) > 0


def test_a_log_of_a_wall_is_not_suspected(late):
    assert suspected_rows(replace(late[0], wall=(1.0, 100.0))) == 0


SWITCHED_ON = "switched on late"


def test_numbers_of_real_drives_that_are_switched_on_late_are_true():
    rig, logs = KINDS[SWITCHED_ON](1)
    found, idle = identified_while_driven(logs)
    assert len(idle) == len(logs)
    for name, value in rig.truth.items():
        interval = found.parameters[name]
        reach = 0.5 * (interval.high - interval.low) + 1e-3 * abs(value)
        assert interval.low - reach <= value <= interval.high + reach, name


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_of_all_kinds_of_real_drives_only_those_switched_on_late_are_suspected(seed):
    suspected = {kind: any(map(suspected_rows, logs(seed)[1])) for kind, logs in KINDS.items()}
    assert {kind for kind, is_suspected in suspected.items() if is_suspected} == {SWITCHED_ON}

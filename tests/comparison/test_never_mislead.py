"""What a comparison tells where logs are odd: nothing that rests on them, and why."""

from __future__ import annotations

import os
import re

import numpy as np
import pytest
from labs import compare

import pipeline
from pipeline.base.errors import ParameterError
from pipeline.device.parts import Friction, LoopTable
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.simulation.sweep import run_sweep, write_sweep
from pipeline.theory import predictions
from pipeline.theory.optimum import optimal_point


def ingested(folder, device, **options):
    """Ingest a simulated course of the first experiment of a device, and return the folder of its trials."""
    write_sweep(run_sweep(device, device.experiments[0].name, **options), folder / "raw")
    ingest([folder / "raw"], folder / "processed", jobs=1)
    return folder / "processed"


def restated(text, **changes):
    """Return the text of a log with other numbers in its header, by name of the line."""
    stated = {name: float(re.search(rf"(?m)^# {name}: (\S+)", text)[1]) for name in ("stiffness", "damping", "step")}
    for name, change in changes.items():
        text = re.sub(rf"(?m)^# {name}: \S+", f"# {name}: {change(stated)!r}", text, count=1)
    return text


OTHER_HEADERS = {
    "K in N/mm": ({"stiffness": lambda of: of["stiffness"] / 1e3}, "K 1000 times"),
    "K and B in N/mm": (
        {"stiffness": lambda of: of["stiffness"] / 1e3, "damping": lambda of: of["damping"] / 1e3},
        "K and B 1000 times",
    ),
    "swapped": ({"stiffness": lambda of: of["damping"], "damping": lambda of: of["stiffness"]}, "K and B are swapped"),
    "K 5 % too large": ({"stiffness": lambda of: of["stiffness"] * 1.05}, "K 0.952 times"),
    "another step": ({"step": lambda of: of["step"] * 1.25}, "the step 0.800 times"),
}


@pytest.fixture(scope="module")
def course(tmp_path_factory):
    """Logs of an ideal course of the robot, by name."""
    folder = tmp_path_factory.mktemp("course")
    write_sweep(run_sweep(load_device("lwr"), "delay-3", ideal=True, coarsen=8), folder)
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*.csv"))}


def compared(folder, logs, **options):
    """Compare logs and return the experiment and the whole result."""
    (folder / "raw").mkdir()
    for name, text in logs.items():
        (folder / "raw" / name).write_text(text, encoding="utf-8")
    ingest([folder / "raw"], folder / "processed", jobs=1)
    result = compare("lwr", folder / "processed", **options).result
    return result.experiments[0], result


@pytest.mark.sampled
@pytest.mark.parametrize("what", OTHER_HEADERS)
def test_nothing_is_recommended_in_units_that_the_command_does_not_obey(tmp_path, course, what):
    changes, words = OTHER_HEADERS[what]
    logs = {name: restated(text, **changes) for name, text in course.items()}
    page = tmp_path / "page.html"
    found, result = compared(tmp_path, logs, report=page)
    assert found.causes[0].code == "other_gains"
    assert words in found.causes[0].sentence
    assert found.use is found.passive is found.loop_boundary is None
    assert (found.optimum, found.scores) == ({}, ())
    assert not any(point.unstable or point.estimate for point in found.boundary)
    told = result.answer
    assert (told.wall, told.next, told.predicts.code) == (None, None, "unknown")
    assert told.causes[0].sentence == found.causes[0].sentence
    assert "stiffness_max" not in {each.name for each in told.estimates}
    assert all(row.trial_id is None for row in result.tables)
    told = re.sub(r"<[^>]+>", " ", page.read_text(encoding="utf-8"))
    assert "follows another wall than the headers state" in told
    assert not re.search(r"× K|largest stable K", told)


@pytest.mark.slow
def test_single_logs_of_another_wall_are_left_out_by_name_and_the_rest_is_used(tmp_path, course):
    double = {"stiffness": lambda of: 2 * of["stiffness"], "damping": lambda of: 2 * of["damping"]}
    off = [name for i, name in enumerate(course) if i % 11 == 5 and "K000000" not in name]
    logs = {name: restated(text, **double) if name in off else text for name, text in course.items()}
    (tmp_path / "some").mkdir()
    found, _ = compared(tmp_path / "some", logs)
    assert found.causes[0].code == "other_gains"
    assert all(name in found.causes[0].evidence for name in off)
    assert "K and B 0.500 times" in found.causes[0].sentence
    # as if they had not been recorded
    (tmp_path / "rest").mkdir()
    rest, _ = compared(tmp_path / "rest", {name: text for name, text in course.items() if name not in off})
    numbers = [(p.damping, p.stable, p.unstable, p.estimate, p.low, p.high) for p in rest.boundary]
    assert [(p.damping, p.stable, p.unstable, p.estimate, p.low, p.high) for p in found.boundary] == numbers
    for criterion, best in rest.optimum.items():
        assert found.optimum[criterion].cost == pytest.approx(best.cost)
        assert (
            found.optimum[criterion].model_copy(
                update={name: getattr(best, name) for name in ("cost", "cost_low", "cost_high")}
            )
            == best
        )
    assert found.use.point.trial_id == rest.use.point.trial_id
    assert (found.passive, found.loop.adequate) == (rest.passive, True)


@pytest.mark.slow
def test_a_criterion_without_an_optimum_in_theory_is_a_row_with_a_reason(tmp_path, course, monkeypatch):
    """A loop with a mode at the load may have no wall without overshoot: the other criteria are compared."""

    def none_without_overshoot(loop, criterion):
        if criterion.startswith("overshoot"):
            raise ParameterError("no point without overshoot was found.")
        return optimal_point(loop, criterion)

    monkeypatch.setattr(predictions, "optimal_point", none_without_overshoot)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    page = tmp_path / "page.html"
    _, result = compared(tmp_path, course, criteria=("overshoot", "energy_step_w0"), report=page)
    theory = {row.criterion: row for row in result.tables if row.condition == "theory_discrete"}
    assert (theory["overshoot"].cost, theory["overshoot"].note) == (None, "no point without overshoot was found")
    assert theory["energy_step_w0"].cost > 0
    assert "no point without overshoot was found" in page.read_text(encoding="utf-8")
    # what is kept is read again
    again = compare("lwr", tmp_path / "processed", criteria=("overshoot", "energy_step_w0")).result
    assert [row.note for row in again.tables] == [row.note for row in result.tables]


@pytest.mark.slow
def test_stable_with_friction_is_said_of_the_step_with_the_limit_of_large_motions_beside(tmp_path):
    device = load_device("falcon").model_copy(update={"name": "rubbing"})
    device = device.model_copy(update={"loop": LoopTable(friction=Friction(coulomb=0.7))})
    page, folder = tmp_path / "page.html", ingested(tmp_path, device, seed=21, jitter_samples=(), coarsen=8)
    result = compare("rubbing", folder, criteria=("settle_2pct", "energy_step_w1"), report=page).result
    (found,) = result.experiments
    assert "coulomb_friction" in {cause.code for cause in found.causes}
    true = device.experiments[0]
    loop = pipeline.Loop(true.mass, true.damping, device.sampling_period_s, true.delay_samples)
    edge = loop.boundary()
    for point in found.boundary[1:-1]:
        limit = np.interp(point.damping, edge["damping"], edge["stiffness"])
        assert point.stiffness_large_motion == pytest.approx(limit, rel=0.02)
    best = found.stiffest
    assert best.stiffness_large_motion < best.limit.stiffness
    assert result.answer.predicts.code in ("with_friction", "unknown")
    (told,) = [each for each in result.answer.estimates if each.name == "stiffness_max"]
    assert told.large_motion == best.stiffness_large_motion
    assert found.use is None or found.use.point.margin_large_motion >= 1.25
    assert f"for a much harder push {float(format(best.stiffness_large_motion, '.3g')):.0f}" in page.read_text(
        encoding="utf-8"
    )

"""The planner beside a simulated rig, from its first word to done."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.device_data.devices import load_device
from pipeline.loop.normalised_loop import LoopUnits, NormalisedLoop
from pipeline.records.native import NativeHeader, format_header
from pipeline.simulation.setup import setup_of
from pipeline.simulation.simulate import simulate
from pipeline.theory.boundary import boundary

MOST = 25
"""Answers after which the rig gives up: bisection takes 15 trials."""

DAMPINGS = (40.0, 80.0, 120.0)
FALCON = load_device("falcon")
EXPERIMENT = FALCON.experiments[0]


def record(folder: Path, stiffness: float, damping: float, number: int) -> None:
    """Write the log of one trial, complete in one step, as a rig does that renames it."""
    # noise of its own in each log: a log of the same content as another is no second trial
    setup = setup_of(FALCON, EXPERIMENT).with_loop(jitter_samples=())
    (trial,) = simulate(setup, np.array([stiffness]), np.array([damping]), seed=number)
    head = format_header(NativeHeader("falcon", "1", stiffness, damping, FALCON.step, FALCON.sampling_period_s))
    lines = [
        f"{k * FALCON.sampling_period_s:.17g},{trial.command[k]:.17g},{trial.position[k]:.17g}\n"
        for k in range(trial.rows)
    ]
    temporary = folder.parent / "growing"
    temporary.write_text(head + "".join(lines), encoding="utf-8")
    temporary.replace(folder / f"{number}.csv")


def true_limits() -> np.ndarray:
    loop = FALCON.loop_for(EXPERIMENT)
    units, curve = LoopUnits.of(loop), boundary(NormalisedLoop.of(loop), 2000)
    rising = curve.beta.argmax() + 1
    return np.interp(DAMPINGS, curve.beta[:rising] * units.damping, curve.alpha[:rising] * units.stiffness)


@pytest.mark.slow
def test_watch_leads_a_rig_to_the_limits(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    command = [sys.executable, "-m", "pipeline", "plan", "--device", "falcon", "--experiment", "1", "--json"]
    command += ["--dampings", ",".join(map(str, DAMPINGS)), "--watch", str(logs), "--processed", str(tmp_path / "p")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        answers = []
        for line in running.stdout:
            answers.append(json.loads(line))
            if len(answers) == MOST:
                running.terminate()
            elif not answers[-1]["done"]:
                wall = answers[-1]["next"][0]
                record(logs, wall["stiffness"], wall["damping"], len(answers))
        assert running.wait() == 0
    last = answers[-1]
    assert last["done"]
    assert last["next"] == []
    assert [answer["trials_used"] for answer in answers] == list(range(len(answers)))
    truth = true_limits()
    found = np.array([point["estimate"] for point in last["boundary"]])
    assert np.abs(found - truth).max() < 0.02 * truth.max()
    tried = {wall["stiffness"] for answer in answers for wall in answer["next"]}
    assert {point[end] for point in last["boundary"] for end in ("low", "high")} <= tried, "ends are verdicts of trials"

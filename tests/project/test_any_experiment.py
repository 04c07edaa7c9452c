"""Any experiment ends in a report: a generator of experiments, most of them poor, and what must be true of each.

Thirty examples of up to four trials are in the fast set and 500 of up to twelve in the slow one.
`PIPELINE_SEED` draws others.
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from any_experiment import Rig, Trial, is_unstable, write_log
from hypothesis import HealthCheck, Phase, given, note, seed, settings
from hypothesis import strategies as st

import pipeline
from pipeline.shell.cli import run as run_here

SEED = int(os.environ.get("PIPELINE_SEED", "20261128"))

DOCUMENTED = {0, 1, 2, 3}
"""Exit statuses of commands."""


@st.composite
def rigs(draw: st.DrawFn) -> Rig:
    mass = draw(st.sampled_from([0.01, 0.1, 0.5, 2.0, 10.0]))
    return Rig(
        mass=mass,
        damping=mass * draw(st.sampled_from([0.0, 0.5, 3.0, 20.0])),
        friction=draw(st.sampled_from([0.0, 0.0, 0.1, 0.5, 2.0])),
        period=draw(st.sampled_from([1e-3, 1e-3, 5e-4, 5e-3])),
        delay=draw(st.integers(0, 120)) / 20,
        jitter=draw(st.sampled_from([0, 0, 0, 1])),
        resolution=draw(st.sampled_from([0.0, 1e-6, 1e-4, 1e-2])),
        noise=draw(st.sampled_from([0.0, 1e-6, 1e-4])),
        stop=draw(st.sampled_from([math.inf, math.inf, 0.05])),
    )


@st.composite
def trials(draw: st.DrawFn, rig: Rig) -> Trial:
    largest = 2 * rig.mass / rig.period**2 / (1 + rig.delay) ** 2
    rows = draw(st.one_of(st.integers(2, 12), st.integers(20, 300), st.integers(100, 300)))
    released = draw(st.sampled_from([False, False, False, True]))
    return Trial(
        stiffness=draw(st.sampled_from([-0.05, 0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.2])) * largest,
        damping=draw(st.sampled_from([0.0, 0.05, 0.1, 0.2, 0.4, 0.8])) * rig.mass / rig.period / (1 + rig.delay),
        step=0.0 if released else draw(st.sampled_from([1.0, 4.0, -4.0, 0.3])),
        rows=rows,
        edge=draw(st.one_of(st.just(0), st.just(min(20, rows - 1)), st.integers(0, rows - 1))),
        position=draw(st.sampled_from([0.0, 0.02])) if released else 0.0,
        velocity=draw(st.sampled_from([0.0, 0.1])) if released else 0.0,
    )


@st.composite
def experiments(draw: st.DrawFn, most: int = 12) -> tuple[Rig, list[tuple[Trial, dict[str, Any]]]]:
    rig = draw(rigs())
    logs = []
    for _ in range(draw(st.integers(1, most))):
        trial = draw(trials(rig))
        more: dict[str, Any] = {}
        if draw(st.integers(0, 7)) == 0 and trial.rows > 8:
            more["lost"] = sorted(draw(st.sets(st.integers(1, trial.rows - 1), max_size=trial.rows // 4)))
        logs.append((trial, more))
        if draw(st.integers(0, 5)) == 0:
            logs.append((trial, more))
    return rig, logs


def finite(text: str) -> Any:
    """Return a JSON document, in which NaN and infinity are an error."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} in JSON")

    return json.loads(text, parse_constant=refuse)


def run(*arguments: str) -> tuple[int, Any]:
    """Return exit status and document of a command; any exception but a named error is a failure."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as leaving:
        run_here([*arguments, "--json"])
    status = int(leaving.value.code or 0)
    note(f"pipeline {' '.join(arguments)} --json: {status} {err.getvalue()[-500:]}")
    assert status in DOCUMENTED
    assert "Warning" not in err.getvalue()
    if status in {1, 2}:
        assert err.getvalue().startswith("Error:"), "an error without a message"
        return status, None
    return status, finite(out.getvalue())


def recorded_by(folder: Path, rig: Rig, logs: list[tuple[Trial, dict[str, Any]]]) -> None:
    folder.mkdir()
    for i, (trial, more) in enumerate(logs):
        write_log(folder / f"{i:03}.csv", rig, trial, seed=i, **more)


def unstable_walls(rig: Rig, walls: list[tuple[float, float]], step: float) -> list[tuple[float, float]]:
    return [(K, B) for K, B in walls if is_unstable(rig, K, B, step)]


def ends_in_a_report(drawn: tuple[Rig, list[Any]]) -> None:
    """Check one experiment: exit statuses, documents, reasons, and walls that are expected to be stable."""
    rig, logs = drawn
    with TemporaryDirectory() as name:
        folder = Path(name)
        recorded_by(folder / "logs", rig, logs)
        store = ["--processed", str(folder / "processed")]
        status, report = run("ingest", str(folder / "logs"), *store)
        assert status in {0, 3}
        assert report["found"] == report["ingested"] + report["skipped"] + len(report["quarantined"])
        run("identify", str(folder / "logs"))
        if not report["ingested"]:
            return
        status, compared = run("compare", "--device", "dev", *store, "--report", str(folder / "report.html"))
        assert status == 0
        assert len(compared["experiments"]) >= 1
        recommended: list[tuple[float, float]] = []
        for each in compared["experiments"]:
            for name, estimate in each["estimates"].items():
                assert estimate["value"] is not None or estimate["reason"], name
            wall = (each.get("answer") or compared["answer"])["wall"]
            recommended += [(wall["stiffness"], wall["damping"])] if wall else []
            _, plan = run("plan", "--device", "dev", "--experiment", each["experiment"], *store)
            _, careful = run("plan", "--device", "dev", "--experiment", each["experiment"], "--gentle", *store)
            if plan is not None and plan["done"]:
                assert all(limit["low"] is not None or limit["note"] for limit in plan["boundary"])
            walls = [*(plan["next"] if plan else ()), *(careful["next"] if careful else ())]
            recommended += [(wall["stiffness"], wall["damping"]) for wall in walls if wall["expected"] == "stable"]
        step = max((abs(trial.step) for trial, _ in logs), default=1.0) or 1.0
        assert not unstable_walls(rig, recommended, step)
        assert len(pipeline.estimates(folder / "processed", "dev", compared["experiments"][0]["experiment"]))


def of_examples(count: int, number: int, most: int = 12) -> Callable[[], None]:
    """Return the property for some examples of a seed, each with at most so many trials."""
    chosen = settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
        print_blob=True,
    )
    return seed(number)(chosen(given(experiments(most))(ends_in_a_report)))


@pytest.mark.slow
def test_any_experiment_ends_in_a_report_and_no_wall_is_unsafe() -> None:
    of_examples(30, SEED, most=4)()


@pytest.mark.slow
def test_five_hundred_experiments_end_in_a_report() -> None:
    of_examples(500, SEED + 1)()


@pytest.mark.parametrize("rig", [Rig(delay=2.5), Rig(mass=0.1, delay=1.0, friction=0.1, noise=1e-6)])
def test_scales_of_mass_and_time_scale_the_results(rig: Rig) -> None:
    """Forces 3 times as large move a mass 3 times as large alike; with time twice as slow forces are a quarter."""
    walls = [(400.0, 4.0, 4.0), (900.0, 8.0, -4.0), (1500.0, 10.0, 4.0), (0.0, 0.0, -2.0)]

    def found(mass: float, time: float) -> dict[str, float]:
        force = mass / time**2
        scaled = replace(
            rig,
            mass=rig.mass * mass,
            damping=rig.damping * mass / time,
            friction=rig.friction * force,
            period=rig.period * time,
        )
        with TemporaryDirectory() as name:
            for i, (K, B, step) in enumerate(walls):
                trial = Trial(K * mass / time**2, B * mass / time, step * force)
                write_log(Path(name) / f"{i}.csv", scaled, trial, seed=i)
            table = pipeline.identify(Path(name)).estimates.set_index("name")["value"]
        return {"mass": table["mass"] / mass, "damping": table["damping"] * time / mass, "delay": table["delay"] / time}

    one = found(1.0, 1.0)
    assert one["mass"] == pytest.approx(rig.mass, rel=0.01)
    for scales in ((3.0, 1.0), (1.0, 2.0), (0.25, 0.5)):
        assert found(*scales) == pytest.approx(one, rel=1e-4)

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import pytest

from pipeline.device.loop import Loop
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.results import SourcedLoop
from pipeline.theory import predictions
from pipeline.theory.optimum import optimal_point
from pipeline.theory.predictions import Predictions, Theory

LOOP = NormalisedLoop.ideal(0.0, 0.01, 1.0)
REQUESTS = [
    (LOOP, "energy_step_w0"),
    (LOOP, "energy_step_w0_discrete"),
    (NormalisedLoop.ideal(0.0, 0.01, 2.0), "energy_step_w0"),
]

pytestmark = pytest.mark.usefixtures("one_process")


def theory(mass=0.5, damping=5.0, period=1e-3, delay=1.0):
    return Theory(SourcedLoop(loop=Loop(mass, damping, period, delay), source="test"))


@pytest.fixture
def kept(tmp_path):
    first = Predictions(tmp_path / "theory")
    assert first.missing([*REQUESTS, *REQUESTS]) == REQUESTS
    assert not (tmp_path / "theory").exists()
    first.start(REQUESTS)
    first.finish()
    return tmp_path / "theory"


@pytest.fixture
def nothing_is_computed(monkeypatch):
    def refuse(*request):
        raise AssertionError(f"computed again: {request}")

    monkeypatch.setattr(predictions, "optimal_point", refuse)


def test_one_file_a_loop_is_kept_and_read_back(kept, nothing_is_computed):
    assert len(list(kept.iterdir())) == 2
    again = Predictions(kept)
    assert again.missing(REQUESTS) == []
    again.start(REQUESTS)
    again.finish()
    expected = theory(damping=5.0).physical(optimal_point(LOOP, "energy_step_w0"))
    assert again.get(theory(damping=5.0), "energy_step_w0") == expected


def test_what_is_added_later_joins_what_is_kept(kept, monkeypatch):
    computed = []

    def noted(loop, criterion):
        computed.append(criterion)
        return optimal_point(loop, criterion)

    monkeypatch.setattr(predictions, "optimal_point", noted)
    later = Predictions(kept)
    later.start([*REQUESTS, (LOOP, "energy_step_w1")])
    later.finish()
    assert computed == ["energy_step_w1"]
    assert Predictions(kept).missing([*REQUESTS, (LOOP, "energy_step_w1")]) == []


def test_a_region_survives_the_file(tmp_path, monkeypatch):
    request = (LOOP, "settle_5pct_discrete")
    first = Predictions(tmp_path)
    first.start([request])
    expected = first.get(theory(damping=5.0), request[1])
    assert expected.region is not None
    second = Predictions(tmp_path)
    assert second.missing([request]) == []
    assert second.get(theory(damping=5.0), request[1]) == expected


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "",
        lambda text: "[]",
        lambda text: "null",
        lambda text: "{}",
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"alpha"', '"alfa"'),
        lambda text: text.replace('"optima": {', '"optima": [').replace("}\n}", "]\n}"),
        lambda text: json.dumps({"optima": []}),
        lambda text: json.dumps({"optima": {"energy_step_w0": 3}}),
        lambda text: json.dumps({"optima": {"energy_step_w0": {"alpha": "x", "beta": 0, "cost": 1, "box": None}}}),
        lambda text: text.replace('"box": null', '"box": 5'),
        lambda text: text.replace('"cost": ', '"cost": NaN, "was": '),
        lambda text: "\xff\xfe\x00{",
    ],
)
def test_a_damaged_file_is_computed_anew(kept, change):
    sound = {path: path.read_text(encoding="utf-8") for path in kept.iterdir()}
    for path, text in sound.items():
        path.write_bytes(change(text).encode("latin-1"))
    again = Predictions(kept)
    assert again.missing(REQUESTS) == REQUESTS
    again.start(REQUESTS)
    again.finish()
    assert {path: path.read_text(encoding="utf-8") for path in kept.iterdir()} == sound


def test_physical_values_scale_with_mass_and_period():
    # K = alpha m/T^2, B = beta m/T (Table 3.1): the same normalised loop from two devices
    point = optimal_point(LOOP, "settle_5pct_discrete")
    one, other = theory(0.5, 5.0, 1e-3), theory(2.0, 5.0, 4e-3)
    assert one.normalised == other.normalised == LOOP
    a, b = one.physical(point), other.physical(point)
    assert a.stiffness == pytest.approx(point.alpha * 5e5)
    assert a.damping == pytest.approx(point.beta * 500)
    assert b.stiffness == pytest.approx(a.stiffness * 4 / 16)
    assert b.damping == pytest.approx(a.damping)
    assert a.cost == b.cost == point.cost
    low_k, high_k, low_b, high_b = a.region
    assert low_k < a.stiffness < high_k
    assert low_b < a.damping < high_b


class FailingPool:
    """A pool whose calls all fail."""

    def __init__(self, error):
        self.error, self.ended_by = error, None

    def __call__(self, workers):
        return self

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        self.ended_by = kind

    def submit(self, *_):
        future = Future()
        future.set_exception(self.error)
        return future


def test_optima_are_computed_here_where_other_processes_die(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(predictions, "process_pool", FailingPool(BrokenProcessPool("died")))
    with Predictions(tmp_path) as wanted:
        wanted.start(REQUESTS)
        wanted.finish()
    assert Predictions(tmp_path).missing(REQUESTS) == []


def test_other_errors_are_not_hidden_and_end_the_pool(tmp_path, monkeypatch):
    pool = FailingPool(ZeroDivisionError("a fault of the code"))
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    monkeypatch.setattr(predictions, "process_pool", pool)
    wanted = Predictions(tmp_path)
    wanted.start(REQUESTS)
    with pytest.raises(ZeroDivisionError), wanted:
        wanted.finish()
    assert pool.ended_by is ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


PROGRAM = """
import os, sys
from pathlib import Path
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.theory.predictions import Predictions

os.cpu_count = lambda: 2
wanted = Predictions(Path(sys.argv[1]))
wanted.start([(NormalisedLoop.ideal(0.0, 0.01, delay), "energy_step_w0") for delay in (1.0, 2.0)])
wanted.finish()
"""


@pytest.mark.slow
@pytest.mark.parametrize("typed_in", [False, True])
def test_a_pool_gives_what_one_process_gives(tmp_path, typed_in):
    """Also for a program without a file, which other processes cannot import."""
    arguments = ["-" if typed_in else "-c", *([] if typed_in else [PROGRAM]), str(tmp_path / "pool")]
    subprocess.run(
        [sys.executable, *arguments], input=PROGRAM, text=True, check=True, timeout=120, stderr=subprocess.DEVNULL
    )
    here = Predictions(tmp_path / "here")
    requests = [REQUESTS[0], REQUESTS[2]]
    here.start(requests)
    files = sorted(p.name for p in (tmp_path / "pool").iterdir())
    assert files == sorted(p.name for p in (tmp_path / "here").iterdir())
    for name in files:
        pool, single = ((tmp_path / f / name).read_text() for f in ("pool", "here"))
        assert json.loads(pool) == json.loads(single)

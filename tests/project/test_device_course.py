"""A course of a device with filter, lag and mode, from its file to its report: theory is that of the loop as it is."""

import re
from html import unescape

import mpmath as mp
import pytest
from general_devices import Example, ManyDigits
from test_cli import call, document  # noqa: F401

from pipeline.records.loop_parts import LoopParts

FILE = """
name = "arm"
title = "Arm"
source = "made up"
sampling_period_s = 0.001
step = 4.0
duration_s = 0.3
baseline_s = 0.02
[limits]
travel = 0.1
[sensor]
quantum = 1e-6
[loop]
velocity = { kind = "butterworth", order = 2, cutoff_hz = 80.0 }
actuator_lag_s = 0.001
mode = { frequency_hz = 60.0, damping_ratio = 0.05, mass = 0.10, sensor = "motor" }
friction = { coulomb = 0.004 }
[[experiment]]
name = "1"
mass = 0.5
damping = 25.0
delay_samples = 2.4
damping_last = 30.0
damping_step = 30.0
stiffness_step = 1000.0
"""
PARTS = LoopParts.model_validate(
    {
        "velocity": {"kind": "butterworth", "order": 2, "cutoff_hz": 80.0},
        "actuator_lag_s": 0.001,
        "mode": {"frequency_hz": 60.0, "damping_ratio": 0.05, "mass": 0.1},
    }
)
SCENE = 'device = "arm"\ncriteria = ["settle", "overshoot"]\nbands = [2]\nfigures = ["boundaries"]\n'
WORDS = "velocity filter (Butterworth, order 2, 80 Hz), actuator lag 1 ms, vibration mode at 60 Hz, sensed at the motor"


def largest(page, label):
    """Largest stiffness of a curve, as the text beside its drawing says."""
    return float(re.search(rf"{re.escape(label)}: up to ([\d.]+) N/m", page)[1])


@pytest.mark.slow
def test_a_report_rests_on_the_loop_of_its_device_file(call, tmp_path, monkeypatch):  # noqa: F811
    (tmp_path / "devices").mkdir()
    file = tmp_path / "devices" / "arm.toml"
    file.write_text(FILE, encoding="utf-8")
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    monkeypatch.setenv("PIPELINE_DEVICES", str(file.parent))
    logs = document(call("simulate", "arm", "--out", "raw", "--seed", 5, "--json"))["logs"]["1"]
    assert document(call("ingest", "raw", "--jobs", 1, "--json"))["ingested"] == logs
    found = document(call("compare", "--scene", "scene.toml", "--report", "arm.html", "--json"))
    page = unescape((tmp_path / "arm.html").read_text(encoding="utf-8")).replace("\xa0", " ")

    # the simulated limits lie about those of a loop of its own, in other states and many digits
    truth = ManyDigits(Example(0.5, 25.0, 0.0, 2.4, 0.001, PARTS))
    told = [p for p in found["experiments"][0]["boundary"] if p["stable"] is not None]
    assert len(told) == 2
    with mp.workdps(40):
        for point in told:
            verdicts = [truth.stable(point[name], point["damping"]) for name in ("stable", "unstable")]
            assert verdicts == [True, False], point
        # the drawn boundary is its limit, to the printed digits
        limit = document(call("theory", "boundary", "--device", "arm", "--json"))
        drawn, damping = largest(page, " theory"), limit["damping_at_stiffness_max"]
        assert drawn == pytest.approx(limit["stiffness_max"], abs=1)
        assert [truth.stable(limit["stiffness_max"] * share, damping) for share in (0.999, 1.001)] == [True, False]

    # optima of the tables are those of the loop
    rows = {(row["criterion"], row["condition"]): row for row in found["tables"]}
    for criterion in ("settle_2pct", "overshoot"):
        best = document(call("theory", "optimum", "--device", "arm", "--criterion", criterion, "--json"))
        row = rows[criterion, "theory_continuous"]
        assert (row["stiffness"], row["damping"]) == pytest.approx((best["stiffness"], best["damping"]), rel=1e-6)
        assert row["cost"] == pytest.approx(best["cost"], rel=1e-9, abs=1e-12)
    # the best trial settles as theory says of its wall
    trial, walls = rows["settle_2pct", "experiment"], tmp_path / "walls.csv"
    walls.write_text(f"stiffness,damping\n{trial['stiffness']!r},{trial['damping']!r}\n", encoding="utf-8")
    (wall,) = document(call("theory", "points", walls, "--device", "arm", "--json"))
    assert trial["cost"] == pytest.approx(wall["settle_2pct_discrete"], abs=2)
    assert trial["cost"] >= rows["settle_2pct", "theory_discrete"]["cost"]

    # the loop is that of the file; with friction the logs are not explained, and what the file tells is not asked for
    loop = found["experiments"][0]["loop"]
    assert loop["source"] == "device file"
    assert (loop["actuator_lag_s"]["value"], loop["mode"]["frequency_hz"]["value"]) == (0.001, 60.0)
    assert not loop["adequate"]
    assert "what would help" not in loop["reason"]
    # the passive region knows lag and filter; captions and sources name all parts, and what is left out
    assert 0 < largest(page, "passive region (of this loop)") < drawn
    assert largest(page, "limit with Coulomb friction") == pytest.approx(drawn, rel=0.05)
    assert largest(page, "2 f_c/Δ: no limit cycle below") == 8000
    assert f"{WORDS} and the delay factors" in page
    assert f"device file arm, with {WORDS}; without friction" in page

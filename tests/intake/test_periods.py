"""Logs of another sampling period than their experiment are said, and kept apart; clocks may differ a little."""

import pytest
from native_logs import log_text

from pipeline.intake.ingest import ingest
from pipeline.store.storage import read_trials


def write(folder, name, period, seed=0):
    text = log_text(300 + seed, seed=seed).split("time_s")[0]
    text = text.replace("# sampling_period_s: 0.001", f"# sampling_period_s: {period!r}")
    assert f"{period!r}" in text
    rows = "".join(f"{k * period!r},{8.0 * (k > 2)!r},{seed + k * 1e-4!r}\n" for k in range(30))
    (folder / name).write_text(text + "time_s,command,position\n" + rows)


def experiments(processed):
    table = read_trials(processed)
    found = zip(*(table.column(c).to_pylist() for c in ("experiment", "sampling_period_s")), strict=True)
    return sorted(found)


@pytest.mark.parametrize("at_once", [True, False])
def test_another_period_is_another_experiment(logs, processed, at_once):
    periods = (0.001, 0.001003, 0.00106, 0.00106, 0.002)
    said = []
    for seed, period in enumerate(periods):
        write(logs, f"{seed}.csv", period, seed)
        if not at_once:
            said += ingest([logs], processed, jobs=1).warnings
    said += ingest([logs], processed, jobs=1).warnings
    assert experiments(processed) == [
        ("1", 0.001),
        ("1", 0.001003),
        ("1-T1.06ms", 0.00106),
        ("1-T1.06ms", 0.00106),
        ("1-T2ms", 0.002),
    ]
    assert len(said) == 3
    assert "2 ms" in said[-1].warning
    assert "'1-T2ms'" in said[-1].warning
    assert ingest([logs], processed, jobs=1).skipped == len(periods)


@pytest.mark.slow
def test_a_course_whose_clocks_differ_a_little_is_compared(tmp_path):
    from labs import compare

    (tmp_path / "logs").mkdir()
    for seed, period in enumerate((0.001, 0.001004, 0.000997)):
        write(tmp_path / "logs", f"{seed}.csv", period, seed)
    ingest([tmp_path / "logs"], tmp_path / "processed")
    result = compare("bench", tmp_path / "processed").result
    assert result is not None
    assert [experiment.trials for experiment in result.experiments] == [3]

"""Ingest: every log ends as ingested, skipped or quarantined; what is stored equals the logs."""

import csv
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from native_logs import FAULTS, GOOD, HEADER_LINES, ROWS, log_text
from wall_logs import named_logs, profile_text

from pipeline.base.errors import ProfileError, UsageError
from pipeline.intake import ingest as ingest_module
from pipeline.intake import sources
from pipeline.intake.ingest import ingest
from pipeline.intake.quarantine import list_quarantine
from pipeline.store import batch_files
from pipeline.store.samples import load_trials
from pipeline.store.storage import list_devices, list_experiments, read_trials


@pytest.fixture
def logs(tmp_path):
    folder = tmp_path / "logs"
    (folder / "deep").mkdir(parents=True)
    for number in range(6):
        place = folder / "deep" if number % 2 else folder
        (place / f"K{number}.csv").write_text(log_text(100.0 * number, rows=ROWS + number))
    return folder


@pytest.fixture
def processed(tmp_path):
    return tmp_path / "processed"


@pytest.fixture
def run(processed):
    def run(*paths, **options):
        report = ingest(paths, processed, jobs=1, **options)
        assert report.found == report.ingested + report.skipped + len(report.quarantined)
        readable(processed)
        return report

    return run


def readable(processed: Path) -> None:
    for path in processed.rglob("*.parquet"):
        pq.read_table(path).validate(full=True)
    assert not list(processed.rglob("*.tmp"))


def counts(report) -> tuple[int, int, int, int]:
    return report.found, report.ingested, report.skipped, len(report.quarantined)


def touch(path: Path) -> None:
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 10**9))


def test_stored_values_equal_the_logs(logs, run, processed):
    assert counts(run(logs)) == (6, 6, 0, 0)
    assert list_devices(processed) == ["bench"]
    trials = read_trials(processed)
    loaded = load_trials(processed, trials)
    sources = dict(zip(trials.column("trial_id").to_pylist(), trials.column("source_path").to_pylist(), strict=True))
    assert loaded.stiffness.tolist() == [0, 100, 200, 300, 400, 500]
    for trial in loaded:
        lines = Path(sources[trial.trial_id]).read_text().splitlines()[HEADER_LINES:]
        expected = [[float(cell) for cell in row] for row in csv.reader(lines)]
        assert np.column_stack([trial.time, trial.command, trial.position]).tolist() == expected


def test_stored_conditions_equal_the_header(tmp_path, run, processed):
    path = tmp_path / "a.csv"
    path.write_text(log_text(added_delay_samples=3, grip="firm", simulated=True, extra={"operator": "Ü"}))
    run(path)
    (row,) = read_trials(processed).to_pylist()
    expected = {"added_delay_samples": 3, "grip": "firm", "simulated": True, "extra": '{"operator": "Ü"}'}
    expected |= {
        "damping": 2.0,
        "step": 8.0,
        "sampling_period_s": 0.001,
        "rows": ROWS,
        "motion": "translation",
    }
    assert {key: row[key] for key in expected} == expected
    assert row["source_path"] == str(path)
    assert row["profile"] == "native"


def test_an_unchanged_log_is_not_opened_again(logs, run, processed, monkeypatch):
    run(logs)
    files = {path: path.stat().st_mtime_ns for path in processed.rglob("*.parquet")}
    monkeypatch.setattr(sources, "open_regular", None)
    assert counts(run(logs)) == (6, 0, 6, 0)
    assert files == {path: path.stat().st_mtime_ns for path in processed.rglob("*.parquet")}


def test_rehash_finds_a_change_that_size_and_time_hide(logs, run, processed):
    run(logs)
    path = logs / "K0.csv"
    status = path.stat()
    path.write_text(path.read_text().replace("# damping: 2 ", "# damping: 7 "))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert path.stat().st_size == status.st_size
    assert counts(run(logs)) == (6, 0, 6, 0)
    assert counts(run(logs, rehash=True)) == (6, 1, 5, 0)
    assert sorted(read_trials(processed).column("damping").to_pylist()) == [2, 2, 2, 2, 2, 7]


def test_same_content_is_stored_once(logs, run, processed):
    shutil.copy(logs / "K0.csv", logs / "copy.csv")
    assert counts(run(logs)) == (7, 6, 1, 0)
    shutil.copy(logs / "K2.csv", logs / "later.csv")
    touch(logs / "K2.csv")
    assert counts(run(logs)) == (8, 0, 8, 0)
    assert read_trials(processed).num_rows == 6


def test_one_file_given_twice_counts_once(logs, run):
    assert counts(run(logs, logs / "K0.csv", logs / "deep")) == (6, 6, 0, 0)
    assert counts(run(logs, logs / "K0.csv", logs / "deep")) == (6, 0, 6, 0)


def test_a_changed_log_replaces_its_former_version(logs, run, processed):
    run(logs)
    first = (logs / "K0.csv").read_text()
    (logs / "K0.csv").write_text(log_text(700.0))
    touch(logs / "K0.csv")
    assert counts(run(logs)) == (6, 1, 5, 0)
    assert sorted(read_trials(processed).column("stiffness").to_pylist()) == [100, 200, 300, 400, 500, 700]
    (logs / "K0.csv").write_text(first)
    os.utime(logs / "K0.csv", ns=(0, 0))
    assert counts(run(logs)) == (6, 1, 5, 0)
    assert sorted(read_trials(processed).column("stiffness").to_pylist()) == [0, 100, 200, 300, 400, 500]
    assert counts(run(logs)) == (6, 0, 6, 0)


def test_logs_that_swap_their_names_are_both_kept(logs, run, processed):
    run(logs)
    (logs / "K0.csv").rename(logs / "x")
    (logs / "K2.csv").rename(logs / "K0.csv")
    (logs / "x").rename(logs / "K2.csv")
    assert counts(run(logs)) == (6, 2, 4, 0)
    rows = {Path(r["source_path"]).name: r["stiffness"] for r in read_trials(processed).to_pylist()}
    assert (rows["K0.csv"], rows["K2.csv"], len(rows)) == (200.0, 0.0, 6)
    assert len(load_trials(processed, read_trials(processed))) == 6


def test_each_fault_is_found_in_its_row_and_its_neighbours_are_stored(logs, run):
    for fault, (text, _, _) in FAULTS.items():
        (logs / f"{fault.replace('/', ' ')}.csv").write_bytes(text.encode())
    report = run(logs)
    assert counts(report) == (6 + len(FAULTS), 6, 0, len(FAULTS))
    found = {Path(refusal.path).stem: refusal for refusal in report.quarantined}
    for fault, (_, row, words) in FAULTS.items():
        refusal = found[fault.replace("/", " ")]
        assert refusal.row == row, refusal
        assert re.search(words, refusal.reason), refusal.reason
    again = run(logs)
    assert counts(again) == (6 + len(FAULTS), 0, 6, len(FAULTS))
    assert again.quarantined == report.quarantined


def test_a_quarantined_log_is_kept_with_its_reason_until_it_is_repaired(logs, run, processed):
    bad = logs / "bad.csv"
    bad.write_text(FAULTS["text cell"][0])
    run(logs)
    (record,) = list_quarantine(processed)
    assert (record.path, record.row, record.size) == (str(bad), 17, bad.stat().st_size)
    bad.write_text(GOOD)
    assert counts(run(logs)) == (7, 1, 6, 0)
    assert list_quarantine(processed) == []
    assert not list(processed.glob("quarantine/*"))


def test_files_that_are_no_logs(logs, run, processed):
    (logs / "notes.md").write_text("remarks")
    (logs / "table.parquet").write_text("no table")
    (logs / "truth.json").write_text("{}")
    (logs / ".hidden.csv").write_text("x")
    (logs / ".git").mkdir()
    (logs / ".git" / "a.csv").write_text("x")
    (logs / "gone.csv").symlink_to(logs / "nowhere")
    report = run(logs)
    assert counts(report) == (8, 6, 0, 2)
    assert [Path(path).name for path in report.ignored] == ["notes.md"]
    reasons = {Path(r.path).name: r.reason for r in report.quarantined}
    assert "accepted names are" in reasons["table.parquet"]
    assert "native: *.csv" in reasons["table.parquet"]
    assert "cannot be read" in reasons["gone.csv"]
    (logs / "gone.csv").unlink()
    (logs / "gone.csv").write_text(log_text(999))
    assert counts(run(logs)) == (8, 1, 6, 1)


@pytest.mark.parametrize("name", ["README", "readme.txt", "LICENSE.md", "lab.toml", "plot.py", "rig.PNG", "look.html"])
def test_a_paper_script_setting_or_picture_is_listed_and_not_counted(logs, run, name):
    (logs / name).write_text("x")
    report = run(logs)
    assert counts(report) == (6, 6, 0, 0)
    assert report.ignored == (str(logs / name),)
    # what is given itself is to be read
    assert [Path(refusal.path).name for refusal in run(logs / name).quarantined] == [name]


def test_files_are_ignored_by_pattern(logs, run):
    (logs / "calibration.csv").write_text("x")
    assert counts(run(logs)) == (7, 6, 0, 1)
    assert counts(run(logs, ignore=["cal*"])) == (6, 0, 6, 0)


def test_processed_inside_the_searched_folder_is_left_out(logs):
    inside = logs / "processed"
    assert ingest([logs], inside).ingested == 6
    assert counts(ingest([logs], inside)) == (6, 0, 6, 0)
    with pytest.raises(UsageError, match="the folder of results"):
        ingest([inside], inside)


def test_dry_run_counts_and_writes_nothing(logs, run, processed):
    (logs / "bad.csv").write_text("x")
    shutil.copy(logs / "K0.csv", logs / "copy.csv")
    assert counts(run(logs, dry_run=True)) == (8, 6, 1, 1)
    assert not processed.exists()


def test_wrong_arguments(logs, processed):
    with pytest.raises(UsageError, match="does not exist or cannot be read"):
        ingest([logs / "nowhere"], processed)
    assert not processed.exists()
    with pytest.raises(UsageError, match="jobs must be at least 1"):
        ingest([logs], processed, jobs=0)
    with pytest.raises(ProfileError, match="neither a file nor a shipped profile"):
        ingest([logs], processed, profile="none")


def test_batches_and_threads_do_not_change_what_is_stored(tmp_path, processed, monkeypatch):
    logs = tmp_path / "logs"
    logs.mkdir()
    for number in range(40):
        (logs / f"{number}.csv").write_text(log_text(number, experiment=f"delay-{number % 3}", rows=2 + number))
    (logs / "20a.csv").write_text(FAULTS["NaN"][0])
    assert counts(ingest([logs], processed, jobs=1)) == (41, 40, 0, 1)
    monkeypatch.setattr(sources, "BATCH_LOGS", 3)
    monkeypatch.setattr(ingest_module, "PENDING_BYTES", 2000)
    monkeypatch.setattr(batch_files, "MOST_SMALL", 1000)
    seen = []
    second = tmp_path / "second"
    report = ingest([logs], second, jobs=3, progress=lambda done, found: seen.append((done, found)))
    assert counts(report) == (41, 40, 0, 1)
    assert seen == [(done, 41) for done in range(1, 42)]
    assert list_experiments(second, "bench") == ["delay-0", "delay-1", "delay-2"]
    assert len(list(second.rglob("trials/**/*.parquet"))) > 3
    a, b = (load_trials(folder, read_trials(folder)) for folder in (processed, second))
    assert a.trial_id == b.trial_id
    np.testing.assert_array_equal(a.position, b.position)


def test_what_is_too_large_or_no_regular_file_is_not_read(logs, run, monkeypatch):
    os.mkfifo(logs / "pipe.csv")
    (logs / "large.csv").write_text(log_text(rows=500))
    (logs / "long.csv").write_text(log_text(experiment="ü" * 50))
    monkeypatch.setattr(sources, "LARGEST_LOG", 10_000)
    report = run(logs)
    reasons = {Path(r.path).name: r.reason for r in report.quarantined}
    assert counts(report) == (9, 6, 0, 3)
    assert "bytes; expected a log of one step response, at most 10000" in reasons["large.csv"]
    assert "not a regular file" in reasons["pipe.csv"]
    assert "too long for a folder name" in reasons["long.csv"]


def test_a_known_device_brings_its_motion(tmp_path, run, processed):
    text = log_text(device="lwr", experiment="delay-2")
    (tmp_path / "a.csv").write_text(text.replace("# motion: translation\n", ""))
    assert run(tmp_path / "a.csv").ingested == 1
    assert read_trials(processed).column("motion").to_pylist() == ["rotation"]
    (tmp_path / "b.csv").write_text(text)
    (refusal,) = run(tmp_path / "b.csv").quarantined
    assert "motion is translation, but the device 'lwr' has rotation" in refusal.reason


PROFILE = """
name = "lab"
format = "delimited"
files = ["*_m.txt"]
decimal = "."
step_at = "command edge"
partner = { replace = "_m.txt", by = "_d.txt" }
columns.time = { name = "t", unit = "ms" }
columns.position = { name = "x", unit = "mm", sign = 1 }
columns.command = { name = "f", unit = "N", sign = 1, file = "partner" }
[constants]
device = "bench"
experiment = "lab"
stiffness = 1
damping = 1
step = 1
sampling_period_s = 0.001
"""


def test_a_pair_is_one_log_and_a_changed_profile_is_applied(tmp_path, run, processed):
    profile = tmp_path / "lab.toml"
    profile.write_text(PROFILE)
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "a_m.txt").write_text("t,x\n0,1\n1,2\n")
    (folder / "a_d.txt").write_text("f\n5\n6\n")
    (folder / "b_d.txt").write_text("f\n5\n6\n")
    (folder / "c_m.txt").write_text("t,x\n0,1\n1,2\n")
    report = run(folder, profile=profile)
    assert counts(report) == (3, 1, 0, 2)
    assert "b_m.txt is missing" in report.quarantined[0].reason
    assert "c_d.txt is missing" in report.quarantined[1].reason
    assert counts(run(folder / "a_d.txt", profile=profile)) == (1, 0, 1, 0)
    (folder / "b_m.txt").write_text("t,x\n0,1\n1,3\n")
    (folder / "c_d.txt").write_text("f\n5\n7\n")
    assert counts(run(folder, profile=profile)) == (3, 2, 1, 0)
    assert list_quarantine(processed) == []

    profile.write_text(PROFILE.replace('unit = "mm", sign = 1', 'unit = "mm", sign = -1'))
    assert counts(run(folder, profile=profile)) == (3, 3, 0, 0)
    positions = [float(trial.position[1]) for trial in load_trials(processed, read_trials(processed))]
    assert sorted(positions) == [-0.003, -0.002, -0.002]
    assert counts(run(folder, profile=profile)) == (3, 0, 3, 0)
    assert len(list(processed.rglob("trials/**/*.parquet"))) == 1


def test_measured_force_logged_velocity_and_declared_step_are_kept(tmp_path, run, processed):
    profile = tmp_path / "lab.toml"
    columns = 'columns.force = { name = "g", unit = "mN", sign = -1 }\n'
    columns += 'columns.velocity = { name = "v", unit = "mm/s", sign = 1 }\n'
    profile.write_text(
        PROFILE.replace('"bench"', '"pair"')
        .replace("[constants]", columns + "[constants]")
        .replace('step_at = "command edge"', "step_row = 1")
    )
    (tmp_path / "a_m.txt").write_text("t,x,g,v\n0,1,10,2\n1,2,20,3\n2,4,30,5\n")
    (tmp_path / "a_d.txt").write_text("f\n5\n6\n7\n")
    assert counts(run(tmp_path / "a_m.txt", profile=profile)) == (1, 1, 0, 0)
    (tmp_path / "b.csv").write_text(GOOD.replace("# device", "# step_row: 0\n# device", 1))
    (tmp_path / "c.csv").write_text(log_text(400.0))
    assert run(tmp_path / "b.csv", tmp_path / "c.csv").ingested == 2
    pair = load_trials(processed, read_trials(processed, "pair"))
    np.testing.assert_allclose(pair.force, [-0.01, -0.02, -0.03])
    np.testing.assert_allclose(pair.velocity, [0.002, 0.003, 0.005])
    assert pair.step_row.tolist() == [1]
    everything = load_trials(processed, read_trials(processed))
    assert sum(trial.force is not None for trial in everything) == 1
    assert sorted(everything.step_row.tolist()) == [-1, 0, 1]
    native = read_trials(processed).filter(pc.field("device") != "pair")
    assert load_trials(processed, native).force is None


def test_logs_that_another_profile_has_stored_are_skipped_by_one_that_cannot_read_them(tmp_path, run, processed):
    """Half of a folder has one layout, half the other, and each profile claims all of its files."""
    logs = tmp_path / "half"
    logs.mkdir()
    for number, (name, content) in enumerate(named_logs(4)):
        (logs / name).write_bytes(content.replace(b";", b"|") if number % 2 else content)
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text(profile_text())
    other = profile_text().replace('name = "lab"', 'name = "other"')
    second.write_text(other.replace('delimiter = ";"', 'delimiter = "|"'))
    assert counts(run(logs, profile=first)) == (4, 2, 0, 2)
    assert counts(run(logs, profile=second)) == (4, 2, 2, 0)
    assert counts(run(logs, profile=first)) == (4, 0, 4, 0)
    assert len(read_trials(processed)) == 4
    first.write_text(profile_text().replace('name = "t"', 'name = "time"'))
    assert counts(run(logs, profile=first)) == (4, 0, 2, 2)

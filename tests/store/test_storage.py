"""Layout of processed/: names survive as folder names, versions and damage are handled."""

import ntpath
import os
import re
import tempfile
from pathlib import Path, PureWindowsPath

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from stored import merge_all

from pipeline.base.disk import file_hash
from pipeline.base.errors import StoreError
from pipeline.intake.ingest import ingest
from pipeline.records.native import NativeHeader, format_header
from pipeline.records.table_files import parquet_bytes
from pipeline.records.tables import COLUMNS, LOCATION, TABLES, to_arrow
from pipeline.store.corrections import write_corrections
from pipeline.store.names import folder_for, folder_name, name_of_folder, page_against, page_against_document, report_of
from pipeline.store.samples import load_trial, load_trials
from pipeline.store.storage import (
    IDENTITY,
    Correction,
    list_devices,
    list_experiments,
    natural_key,
    read_exclusions,
    read_trials,
    trials_files,
)


def write_log(path, stiffness, damping=1.0, device="bench", experiment="1", rows=3):
    header = format_header(NativeHeader(device, experiment, stiffness, damping, 8.0, 0.001))
    path.write_text(header + "".join(f"{k},{k + stiffness},{k - damping}\n" for k in range(rows)))


@given(st.text(st.characters(codec="utf-8"), min_size=1, max_size=40))
@example(".hidden")
@example("_hidden")
def test_any_name_survives_as_one_visible_folder(name):
    folder = folder_name(name)
    assert name_of_folder(folder) == name
    assert "/" not in folder
    assert not folder.startswith((".", "_"))


def refused_by_windows(name: str) -> bool:
    """By the rules that Python itself keeps for Windows."""
    reserved = getattr(ntpath, "isreserved", None) or (lambda text: PureWindowsPath(text).is_reserved())
    return bool(re.search(r'[<>:"/\\|?*\x00-\x1f]|[. ]$', name)) or reserved(name)


ODD = ["CON", "nul", "aux", "prn.txt", "com1", "LPT9.tar.gz", "con ", "x.", "x ", "a<b>c", 'q"|?*', "index", "a:b", "."]


@pytest.mark.parametrize(
    "name",
    [*ODD, "Index", "accuracy", "THEORY", "lwr=1-against-2", "lwr-against-earlier", "x-against-against-y", "%41"],
)
def test_names_that_some_system_refuses_are_written_otherwise(name, tmp_path):
    folder = folder_for(tmp_path, name).name
    assert name_of_folder(folder) == name
    assert not refused_by_windows(folder)
    report = report_of(tmp_path, name)
    assert name_of_folder(report.stem) == name
    assert not refused_by_windows(report.name)
    assert report.stem.casefold() not in ("index", "accuracy", "theory")
    assert "-against" not in report.name


PART = st.lists(st.sampled_from(["a", "A", "-", "=", "against", "-against-"]), min_size=1, max_size=4).map("".join)


@settings(deadline=None)  # it makes folders
@given(st.lists(st.tuples(PART, PART, PART, PART), min_size=2, max_size=6, unique=True), st.lists(PART, unique=True))
def test_each_two_experiments_have_a_page_of_their_own(pairs, devices):
    with tempfile.TemporaryDirectory() as text:
        parent = Path(text)
        makers = [lambda pair=pair: page_against(parent, pair[:2], pair[2:]) for pair in pairs]
        makers += [lambda device=device: report_of(parent, device) for device in devices]
        for make in makers:
            make().touch()
        files = os.listdir(parent)
        assert len({file.casefold() for file in files}) == len(files) == len(makers)
        assert [make().name for make in makers if not make().exists()] == []
        documents = {
            page_against_document(report_of(parent, device), parent / folder / "x.json")
            for device in devices
            for folder in "ab"
        }
        assert len(documents) == 2 * len(devices)
        assert not documents & {parent / file for file in files}


@settings(deadline=None)  # it makes folders
@given(st.lists(st.text(st.sampled_from("aAbB%46. ſß"), min_size=1, max_size=3), min_size=1, max_size=8, unique=True))
def test_names_that_differ_in_case_are_different_files_everywhere(names):
    with tempfile.TemporaryDirectory() as text:
        parent = Path(text)
        for name in names:
            folder_for(parent, name).mkdir()
            report_of(parent, name).touch()
        found = os.listdir(parent)
        assert len({entry.casefold() for entry in found}) == len(found) == 2 * len(names)
        assert {name_of_folder(entry) for entry in found if not entry.endswith(".html")} == set(names)
        assert [name_of_folder(folder_for(parent, name).name) for name in names] == names
        assert [name_of_folder(report_of(parent, name).stem) for name in names] == names
        assert all(folder_for(parent, name).is_dir() and report_of(parent, name).is_file() for name in names)


def test_devices_that_differ_in_case_are_stored_apart(tmp_path):
    for number, device in enumerate(("arm", "Arm", "CON")):
        write_log(tmp_path / f"{number}.csv", float(number), device=device)
    processed = tmp_path / "processed"
    ingest(sorted(tmp_path.glob("*.csv")), processed)
    assert list_devices(processed) == ["Arm", "CON", "arm"]
    folders = os.listdir(processed / "trials")
    assert len({folder.casefold() for folder in folders}) == 3
    assert not any(refused_by_windows(folder) for folder in folders)
    for number, device in enumerate(("arm", "Arm", "CON")):
        assert load_trials(processed, read_trials(processed, device)).stiffness.tolist() == [number]


@pytest.fixture
def processed(tmp_path):
    logs = tmp_path / "logs"
    logs.mkdir()
    for number, (stiffness, damping, experiment) in enumerate(
        [(5.0, 2.0, "1"), (7.0, 1.0, "1"), (6.0, 1.0, "1"), (1.0, 0.0, "ä/10"), (1.0, 0.0, "ä/9")]
    ):
        write_log(logs / f"{number}.csv", stiffness, damping, experiment=experiment, rows=3 + number)
    ingest([logs], tmp_path / "processed", jobs=1)
    return tmp_path / "processed"


def test_trials_are_found_by_device_and_experiment(processed):
    assert list_devices(processed) == ["bench"]
    assert list_experiments(processed, "bench") == ["1", "ä/9", "ä/10"]
    assert list_experiments(processed, "other") == []
    assert read_trials(processed).num_rows == 5
    assert read_trials(processed, "bench", "ä/9").column("experiment").to_pylist() == ["ä/9"]
    assert read_trials(processed, "other").num_rows == 0


def test_trials_are_ordered_by_damping_and_stiffness_with_their_own_rows(processed):
    trials = load_trials(processed, read_trials(processed, "bench", "1"))
    assert list(zip(trials.damping, trials.stiffness, trials.rows, strict=True)) == [
        (1, 6, 5),
        (1, 7, 4),
        (2, 5, 3),
    ]
    for trial in trials:
        np.testing.assert_array_equal(trial.command, np.arange(trial.rows) + trial.stiffness)
        np.testing.assert_array_equal(trial.position, np.arange(trial.rows) - trial.damping)


def test_units_and_meanings_are_stored(processed):
    (path,) = (processed / "trials" / "bench" / "1").glob("*.parquet")
    field = pq.read_schema(path).field("position")
    assert field.metadata == {b"unit": b"m", b"meaning": b"measured position"}
    assert {*LOCATION, *(name for names in TABLES.values() for name in names)} == set(COLUMNS)


def test_missing_and_damaged_files_are_named(processed):
    trials = read_trials(processed, "bench", "1")
    (path,) = (processed / "trials" / "bench" / "1").glob("*.parquet")
    path.write_bytes(b"no table")
    for read in (lambda: load_trials(processed, trials), lambda: read_trials(processed)):
        with pytest.raises(StoreError, match="is missing or damaged"):
            read()
    damaged: dict = {}
    assert read_trials(processed, damaged=damaged).num_rows == 2
    assert list(damaged) == [path]
    path.unlink()
    with pytest.raises(StoreError, match="3 trials were removed while they were read"):
        load_trials(processed, trials)


def test_a_trial_is_read_by_where_it_is_stored(processed):
    trials = read_trials(processed)
    for row in trials.to_pylist():
        place = row["sample_file"], row["sample_row"]
        table, trial = load_trial(processed, row["trial_id"], *place)
        assert table.column("stiffness").to_pylist() == [row["stiffness"]] == [trial.stiffness]
        same = load_trials(processed, trials.filter(pc.equal(trials["trial_id"], row["trial_id"])))
        assert (trial.digest,) == same.digests
        assert load_trial(processed, "another", *place) is None
        assert load_trial(processed, row["trial_id"], row["sample_file"], 99) is None
        assert load_trial(processed, row["trial_id"], "trials/gone.parquet", 0) is None


def test_a_table_of_other_columns_is_not_written():
    table = to_arrow("boundary", {name: [] for name in TABLES["boundary"]})
    with pytest.raises(StoreError, match="columns differ"):
        parquet_bytes(table.drop_columns(["damping"]))


def test_a_store_of_an_earlier_version_is_told_with_what_rebuilds_it(processed, tmp_path):
    for file in trials_files(processed):
        pq.write_table(pq.read_table(file).drop_columns(["claims"]), file)
        file.rename(file.with_name(f"{file_hash(file)}.parquet"))
    words = rf"a different version.*pipeline ingest {tmp_path}/logs --processed {processed}-new"
    with pytest.raises(StoreError, match=words):
        ingest([tmp_path / "logs"], processed)


def test_what_is_moved_or_deleted_by_hand_stays_so(processed, tmp_path):
    rows = {row["stiffness"]: row for row in read_trials(processed, columns=["stiffness", *IDENTITY]).to_pylist()}
    changes = {5.0: {"moved_experiment": "ä/9"}, 7.0: {"moved_device": "other"}, 6.0: {"deleted": True}}
    new = [Correction(**{n: rows[k][n] for n in IDENTITY}, **change) for k, change in changes.items()]
    write_corrections(processed, new[:2])
    write_corrections(processed, new[2:])

    def check():
        found = {(r["device"], r["experiment"], r["stiffness"]) for r in read_trials(processed).to_pylist()}
        assert found == {("bench", "ä/9", 5.0), ("other", "1", 7.0), ("bench", "ä/10", 1.0), ("bench", "ä/9", 1.0)}
        for device in ("bench", "other"):
            own = {one for one in found if one[0] == device}
            assert list_experiments(processed, device) == sorted({e for _, e, _ in own}, key=natural_key)
            for experiment in list_experiments(processed, device):
                trials = read_trials(processed, device, experiment)
                stiffness = sorted(k for _, e, k in own if e == experiment)
                assert sorted(load_trials(processed, trials).stiffness.tolist()) == stiffness
        assert list_devices(processed) == ["bench", "other"]

    check()
    ingest([tmp_path / "logs"], processed, rehash=True)
    merge_all(processed)
    check()
    assert len(list((processed / "corrections").iterdir())) == 1
    write_corrections(processed, [one.model_copy(update={"deleted": False}) for one in new[2:]])
    assert list_experiments(processed, "bench") == ["1", "ä/9", "ä/10"]


def test_corrections_that_were_written_at_once_both_count(processed):
    rows = read_trials(processed, columns=list(IDENTITY)).to_pylist()
    (first, second, third) = (Correction(**row, exclusion_reason=f"{k}") for k, row in enumerate(rows[:3]))
    write_corrections(processed, [first])
    (before,) = (processed / "corrections").iterdir()
    content = before.read_bytes()
    write_corrections(processed, [second])
    (one,) = (processed / "corrections").iterdir()
    kept = one.read_bytes()
    one.unlink()
    before.write_bytes(content)
    write_corrections(processed, [third])
    one.write_bytes(kept)
    assert set(read_exclusions(processed)) == {c.trial_id for c in (first, second, third)}
    write_corrections(processed, [second.model_copy(update={"exclusion_reason": ""})])
    assert set(read_exclusions(processed)) == {first.trial_id, third.trial_id}
    assert len(list((processed / "corrections").iterdir())) == 1


def test_stored_trials_have_the_motion_of_their_device(lwr, falcon):
    assert lwr.stages("delay-2").samples.motion == "rotation"
    assert falcon.stages("1").samples[0].motion == "translation"

"""Layout of processed/: names survive as folder names, versions and damage are handled."""

import ntpath
import os
import re
import tempfile
from pathlib import Path, PureWindowsPath

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pipeline.base.seal import MARK

from pipeline.base.errors import StoreError
from pipeline.intake.ingest import ingest
from pipeline.records.native import NativeHeader, format_header
from pipeline.records.table_files import read_table, write_table
from pipeline.records.tables import COLUMNS, TABLES, to_arrow
from pipeline.store.names import folder_name, name_of_folder, page_against, page_against_document, place_of, report_of
from pipeline.store.samples import load_batch
from pipeline.store.storage import (
    list_devices,
    list_experiments,
    natural_key,
    read_trials,
)


def write_log(path, stiffness, damping=1.0, device="bench", experiment="1", rows=3):
    header = format_header(NativeHeader(device, experiment, stiffness, damping, 8.0, 0.001))
    path.write_text(header + "".join(f"{k},{k + stiffness},{k - damping}\n" for k in range(rows)))


@given(st.text(st.characters(codec="utf-8"), min_size=1, max_size=40))
def test_any_name_survives_as_one_visible_folder(name):
    folder = folder_name(name)
    assert name_of_folder(folder) == name
    assert "/" not in folder
    assert not folder.startswith(".")


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
    folder = place_of(tmp_path, name).name
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


def test_pages_of_two_experiments_have_names_that_read_well(tmp_path):
    assert page_against(tmp_path, ("lwr", "1"), ("lwr", "2")).name == "lwr=1-against-2.html"
    assert page_against(tmp_path, ("lwr", "1"), ("falcon", "2")).name == "lwr=1-against-falcon=2.html"


@settings(deadline=None)  # it makes folders
@given(st.lists(st.text(st.sampled_from("aAbB%46. ſß"), min_size=1, max_size=3), min_size=1, max_size=8, unique=True))
def test_names_that_differ_in_case_are_different_files_everywhere(names):
    with tempfile.TemporaryDirectory() as text:
        parent = Path(text)
        for name in names:
            place_of(parent, name).mkdir()
            report_of(parent, name).touch()
        found = os.listdir(parent)
        assert len({entry.casefold() for entry in found}) == len(found) == 2 * len(names)
        assert {name_of_folder(entry) for entry in found if not entry.endswith(".html")} == set(names)
        assert [name_of_folder(place_of(parent, name).name) for name in names] == names
        assert [name_of_folder(report_of(parent, name).stem) for name in names] == names
        assert all(place_of(parent, name).is_dir() and report_of(parent, name).is_file() for name in names)


def test_devices_that_differ_in_case_are_stored_apart_and_former_stores_are_read(tmp_path):
    for number, device in enumerate(("arm", "Arm", "CON")):
        write_log(tmp_path / f"{number}.csv", float(number), device=device)
    processed = tmp_path / "processed"
    ingest(sorted(tmp_path.glob("*.csv")), processed)
    assert list_devices(processed) == ["Arm", "CON", "arm"]
    for tree in ("trials", "samples"):
        folders = os.listdir(processed / tree)
        assert len({folder.casefold() for folder in folders}) == 3
        assert not any(refused_by_windows(folder) for folder in folders)
        # as earlier versions wrote it
        (processed / tree / "%43ON").rename(processed / tree / "CON")
    for file in processed.glob("trials/CON/*/*.parquet"):
        table = pq.read_table(file).replace_schema_metadata(
            {key: value for key, value in pq.read_schema(file).metadata.items() if key != MARK.encode()}
        )
        moved = [name.replace("%43ON", "CON") for name in table.column("sample_file").to_pylist()]
        pq.write_table(table.set_column(table.schema.get_field_index("sample_file"), "sample_file", [moved]), file)
    for number, device in enumerate(("arm", "Arm", "CON")):
        assert load_batch(processed, read_trials(processed, device)).stiffness.tolist() == [number]
    write_log(tmp_path / "3.csv", 3.0, device="CON")
    ingest([tmp_path / "3.csv"], processed)
    assert load_batch(processed, read_trials(processed, "CON")).stiffness.tolist() == [2, 3]
    assert sorted(os.listdir(processed / "samples")) == sorted(os.listdir(processed / "trials"))


def test_experiments_are_sorted_as_people_do():
    names = ["delay-10", "delay-2", "10", "9", "a"]
    assert sorted(names, key=natural_key) == ["9", "10", "a", "delay-2", "delay-10"]


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


def test_a_batch_is_ordered_and_padded(processed):
    batch = load_batch(processed, read_trials(processed, "bench", "1"))
    assert list(zip(batch.damping, batch.stiffness, batch.rows, strict=True)) == [
        (1, 6, 5),
        (1, 7, 4),
        (2, 5, 3),
    ]
    for stiffness, damping, rows, command, position in zip(
        batch.stiffness, batch.damping, batch.rows, batch.command, batch.position, strict=True
    ):
        np.testing.assert_array_equal(command[:rows], np.arange(rows) + stiffness)
        np.testing.assert_array_equal(position[:rows], np.arange(rows) - damping)
        assert np.isnan(position[rows:]).all()


def test_nothing_stored_is_an_empty_batch(processed):
    assert len(load_batch(processed, read_trials(processed, "other"))) == 0


def test_units_and_meanings_are_stored(processed):
    (path,) = (processed / "samples" / "bench" / "1").glob("*.parquet")
    field = pq.read_schema(path).field("position")
    assert field.metadata == {b"unit": b"m", b"meaning": b"measured position"}
    assert {name for names in TABLES.values() for name in names} == set(COLUMNS)


def test_missing_and_damaged_files_are_named(processed):
    trials = read_trials(processed, "bench", "1")
    (path,) = (processed / "samples" / "bench" / "1").glob("*.parquet")
    short = read_table(path).slice(0, 5)
    write_table(path, short)
    with pytest.raises(StoreError, match="shorter than its trials say"):
        load_batch(processed, trials)
    path.write_bytes(b"no table")
    with pytest.raises(StoreError, match="is missing or damaged"):
        load_batch(processed, trials)
    path.unlink()
    with pytest.raises(StoreError, match="samples file is missing"):
        load_batch(processed, trials)


def test_a_table_of_other_columns_is_not_written(tmp_path):
    columns = {"time_s": [0.0], "command": [0.0], "position": [0.0], "force": [None], "velocity": [None]}
    columns |= {"raw_time": [None], "raw_count": [None]}
    table = to_arrow("samples", {"trial_id": ["a"], **columns})
    with pytest.raises(StoreError, match="columns differ"):
        write_table(tmp_path / "a.parquet", table.drop_columns(["command"]))
    assert list(tmp_path.iterdir()) == []

"""Batches are merged without a change to what is read, and an ingest rewrites little."""

import itertools
import os
import threading
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from native_logs import short_log
from stored import check_whole, merge_all, stored_rows

from pipeline.base.errors import StoreError
from pipeline.intake.ingest import ingest
from pipeline.records import table_files
from pipeline.store import batch_files, storage
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials, trials_files


@pytest.fixture
def grow(tmp_path, monkeypatch):
    """Ingest logs one by one; returns the store and what is to be read of it."""

    def grow(count: int, rows: int = 3, most_small: int = 10**6) -> tuple[Path, dict[str, float]]:
        monkeypatch.setattr(batch_files, "MOST_SMALL", most_small)
        logs: dict[str, float] = {}
        for number in range(count):
            path = tmp_path / f"{number:03d}.csv"
            path.write_text(short_log(float(number), rows=rows))
            logs[str(path)] = float(number)
            assert ingest([path], tmp_path / "processed", jobs=1).ingested == 1
        return tmp_path / "processed", logs

    return grow


def test_one_batch_is_left_and_the_same_is_read(grow):
    processed, logs = grow(5)
    before = load_trials(processed, read_trials(processed))
    assert len(trials_files(processed)) == 5
    merge_all(processed)
    assert len(trials_files(processed)) == 1
    after = load_trials(processed, read_trials(processed))
    assert after.trial_id == before.trial_id
    np.testing.assert_array_equal(after.position, before.position)
    assert check_whole(processed, logs) == set(logs)


def test_replaced_and_incomplete_files_are_left_out_and_removed(grow, tmp_path):
    """What a command leaves that is killed between the new file and the removal of the former ones."""
    processed, logs = grow(3)
    (folder,) = {file.parent for file in trials_files(processed)}
    former = {file: file.read_bytes() for file in trials_files(processed)}
    (folder / ".batch.0123456789abcdef.tmp").write_bytes(b"x")
    merge_all(processed)
    for file, content in former.items():
        file.write_bytes(content)
    assert check_whole(processed, logs) == set(logs)
    ingest([tmp_path / "000.csv"], processed, jobs=1)
    assert len(os.listdir(folder)) == 1
    assert check_whole(processed, logs) == set(logs)


@pytest.mark.parametrize(("limit", "value"), [("GROUP_TRIALS", 3), ("GROUP_BYTES", 3 * 4 * 24)])
def test_row_groups_are_small(grow, monkeypatch, limit, value):
    monkeypatch.setattr(batch_files, limit, value)
    processed, logs = grow(8, rows=4)
    merge_all(processed)
    (file,) = trials_files(processed)
    groups = pq.read_metadata(file)
    assert [groups.row_group(i).num_rows for i in range(groups.num_row_groups)] == [3, 3, 2]
    assert check_whole(processed, logs) == set(logs)


def test_translation_and_rotation_keep_their_own_files(tmp_path):
    processed = tmp_path / "processed"
    for number in range(4):
        text = short_log(float(number))
        path = tmp_path / f"{number}.csv"
        path.write_text(
            text.replace("motion: translation", "motion: rotation").replace("N/m", "Nm/rad") if number % 2 else text
        )
        ingest([path], processed, jobs=1)
    merge_all(processed)
    files = trials_files(processed)
    assert len(files) == 2
    motions = {file: table_files.read_table(file).column("motion").unique().to_pylist() for file in files}
    assert sorted(motions.values()) == [["rotation"], ["translation"]]
    assert {pq.read_schema(file).field("position").metadata[b"unit"] for file in files} == {b"m", b"rad"}


@pytest.mark.slow
def test_bytes_are_rewritten_once_for_each_factor(grow, monkeypatch):
    """Of 26 logs that come alone, with groups of 3, each is written at most 1 + log3(26) times: 26 = 2*9 + 2*3 + 2."""
    written: Counter[str] = Counter()
    original = batch_files._groups

    def groups(parts):
        for group in original(parts):
            written.update(group.column("trial_id").to_pylist())
            yield group

    monkeypatch.setattr(batch_files, "_groups", groups)
    processed, logs = grow(26, rows=3, most_small=3)
    assert len(written) == 26
    assert max(written.values()) == 1 + 2
    assert len(trials_files(processed)) == 6
    assert check_whole(processed, logs) == set(logs)
    assert set(stored_rows(processed).values()) == {1}


def test_large_batches_are_left_alone(grow, monkeypatch):
    monkeypatch.setattr(batch_files, "LARGE_TRIALS", 1)
    processed, _ = grow(12, most_small=4)
    assert len(trials_files(processed)) == 12


def test_a_damaged_batch_stops_the_merge_and_loses_nothing(grow):
    processed, _ = grow(3)
    file = trials_files(processed)[1]
    data = bytearray(file.read_bytes())
    data[20] ^= 0xFF
    file.write_bytes(data)
    with pytest.raises(StoreError, match="is missing or damaged"):
        merge_all(processed)
    assert len(trials_files(processed)) == 3
    assert not list(processed.rglob("*.tmp"))


def test_readers_find_samples_that_were_moved_meanwhile(grow, monkeypatch):
    processed, _ = grow(3)
    trials = read_trials(processed)
    before = load_trials(processed, trials)
    merge_all(processed)
    assert not (processed / trials.column("sample_file")[0].as_py()).exists()
    np.testing.assert_array_equal(load_trials(processed, trials).position, before.position)


def test_a_listing_that_a_merge_tears_is_read_again(grow, monkeypatch):
    """A folder is not listed in one moment: the merged file may be missed, and the former one be gone already."""
    processed, _ = grow(2)
    original, listings = storage._listing, []

    def torn(folder):
        found = original(folder)
        listings.append(folder)
        if len(listings) == 1:
            merge_all(processed)
            return found[1:]
        return found

    monkeypatch.setattr(storage, "_listing", torn)
    assert read_trials(processed).num_rows == 2
    assert len(listings) > 2
    numbers = itertools.count()
    monkeypatch.setattr(storage, "_listing", lambda folder: [os.path.join(folder, str(next(numbers)))])
    monkeypatch.setattr(storage, "_PAUSE_S", 0)
    with pytest.raises(StoreError, match="changed during each of 50 attempts"):
        read_trials(processed)


@pytest.mark.slow
def test_readers_see_each_trial_once_while_batches_are_merged(grow, monkeypatch):
    processed, logs = grow(6)
    ended = threading.Event()
    counts: Counter[int] = Counter()
    faults = []

    def read() -> None:
        while not ended.is_set():
            try:
                trials = read_trials(processed)
                counts[len(set(trials.column("trial_id").to_pylist()))] += 1
                assert len(load_trials(processed, trials)) == trials.num_rows == 6
            except Exception as error:
                faults.append(repr(error))

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(3):
        merge_all(processed)
        # one batch becomes six again
        for path in logs:
            Path(path).write_text(short_log(logs[path]) + "\n")
            ingest([Path(path)], processed, jobs=1)
            Path(path).write_text(short_log(logs[path]))
            ingest([Path(path)], processed, jobs=1)
    ended.set()
    reader.join()
    assert [fault for fault in faults if "were removed while they were read" not in fault] == []
    assert set(counts) == {6}

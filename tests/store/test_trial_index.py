"""The index of trials: what it copies is what the files have, as long as they are the same."""

import os

import pytest
from small_experiments import trials, write_logs

from pipeline.intake.ingest import ingest
from pipeline.store.storage import read_trials, trials_files
from pipeline.store.trial_index import INDEX, INDEXED, FileRows, indexed_rows

COLUMNS = list(INDEXED)


@pytest.fixture
def store(tmp_path):
    for name in "abc":
        write_logs(tmp_path / "raw" / name, trials([100.0, 200.0], [1.0, 1.0]), experiment=name)
    ingest([tmp_path / "raw"], tmp_path / "processed")
    return tmp_path / "processed"


def indexed(store, read=None):
    """The rows of all files by the index, and the files that were opened for them."""
    opened = []

    def rows_of(file, columns):
        opened.append(file)
        experiment = file.parent.name
        return FileRows(read_trials(store, "dev", experiment, COLUMNS), "")

    parts = indexed_rows(store, trials_files(store), read or rows_of)
    return [row for part in parts.values() for row in part.table.to_pylist()], opened


def test_index_has_the_rows_of_all_files_and_opens_none(store):
    first, opened = indexed(store)
    assert opened == trials_files(store)
    assert len(first) == 6
    second, opened = indexed(store)
    assert (second, opened) == (first, [])
    assert sorted(row["trial_id"] for row in first) == sorted(read_trials(store).column("trial_id").to_pylist())


def test_file_that_changed_is_opened_again(store):
    first, _ = indexed(store)
    changed = trials_files(store)[1]
    os.utime(changed, ns=(0, 0))
    assert indexed(store) == (first, [changed])


def test_file_that_is_gone_has_no_rows(store):
    indexed(store)
    trials_files(store)[0].unlink()
    rows, opened = indexed(store)
    assert ({row["experiment"] for row in rows}, opened) == ({"b", "c"}, [])


def test_damaged_index_is_written_again(store):
    first, _ = indexed(store)
    (store / INDEX).write_bytes((store / INDEX).read_bytes()[:-9])
    assert indexed(store) == (first, trials_files(store))
    assert indexed(store) == (first, [])


def test_damaged_file_is_left_out_of_rows_and_index(store):
    assert indexed(store, lambda file, columns: None) == ([], [])
    rows, opened = indexed(store)
    assert len(rows) == 6
    assert opened == trials_files(store)


def test_index_is_readable_by_those_alone_who_may_read_all_trials(store):
    os.chmod(trials_files(store)[0], 0o600)
    indexed(store)
    assert (store / INDEX).stat().st_mode & 0o077 == 0

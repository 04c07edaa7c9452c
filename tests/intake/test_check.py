"""Damaged files are named, and what can be saved of them is: from the logs where they are, else group by group."""

import random
import re

import pyarrow.parquet as pq
import pytest
from labs import compare
from native_logs import FAULTS, short_log
from stored import check_whole, flip, merge_all

from pipeline.intake.check import check
from pipeline.intake.ingest import ingest
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.store import batch_files
from pipeline.store.corrections import exclude, use_again
from pipeline.store.samples import load_trials
from pipeline.store.storage import corrections_files, read_exclusions, read_trials, trials_files


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """Six logs of one experiment in three groups of rows, one refused log, one result, one exclusion."""
    monkeypatch.setattr(batch_files, "GROUP_TRIALS", 2)
    monkeypatch.setattr("pipeline.intake.stored_sources.GROUP_TRIALS", 2)
    (tmp_path / "logs").mkdir()
    for number in range(6):
        (tmp_path / "logs" / f"{number}.csv").write_text(short_log(float(number), rows=40))
    (tmp_path / "logs" / "bad.csv").write_text(FAULTS["text cell"][0])
    ingest([tmp_path / "logs"], tmp_path / "processed", jobs=1)
    exclude(tmp_path / "processed", str(tmp_path / "logs" / "0.csv"), "slipped")
    ExperimentStages.stored(tmp_path / "processed", "bench", "1").table("response")
    return tmp_path


def logs_of(lab):
    return {str(lab / "logs" / f"{number}.csv"): float(number) for number in range(6)}


def test_every_flipped_byte_of_every_file_is_named(lab):
    processed, rng = lab / "processed", random.Random(3)
    files = sorted(file for file in processed.rglob("*") if file.is_file() and not file.name.startswith("."))
    assert {file.relative_to(processed).parts[0] for file in files} >= {"trials", "stages", "corrections", "quarantine"}
    assert check(processed).damage == ()
    for file in files:
        whole = file.read_bytes()
        for at in (0, len(whole) - 1, *(rng.randrange(len(whole)) for _ in range(4))):
            flip(file, at)
            assert [one.file for one in check(processed).damage] == [file.relative_to(processed).as_posix()]
            file.write_bytes(whole)


@pytest.mark.parametrize("name", [b"trial_id", b"source_path", b"pipeline.table"])
@pytest.mark.parametrize("tree", ["trials", "stages"])
def test_a_flipped_letter_of_a_name_in_a_footer_is_named_and_saved(lab, tree, name):
    """The file then has all its data and another column: which nobody may take for another version, or end by."""
    processed = lab / "processed"
    (file,) = (processed / tree).rglob("*.parquet")
    places = [found.start() for found in re.finditer(name, file.read_bytes())]
    for at in places:
        flip(file, at)
        assert [one.file for one in check(processed).damage] == [file.relative_to(processed).as_posix()]
        assert ingest([lab / "logs"], processed, jobs=1, dry_run=True).found == 7
        flip(file, at)
    if places:
        flip(file, places[-1])
        check(processed, repair=True)
        assert ingest([lab / "logs"], processed, jobs=1).found == 7
        assert sorted(read_trials(processed).column("stiffness").to_pylist()) == [0, 1, 2, 3, 4, 5]
    assert places or (tree, name) == ("stages", b"source_path")


def test_a_deleted_table_of_corrections_is_named(lab):
    processed = lab / "processed"
    (excluded,) = read_exclusions(processed)
    assert check(processed).gone == ()
    for file in corrections_files(processed):
        file.unlink()
    (told,) = check(processed).gone
    assert told.startswith(f"Experiment 1 of bench: stored results are based on 1 exclusion ({excluded})")
    assert told in compare("bench", processed, criteria=("overshoot",)).result.warnings


def test_a_deleted_batch_is_named(lab):
    processed = lab / "processed"
    (lab / "logs" / "6.csv").write_text(short_log(6.0, rows=40))
    before = set(trials_files(processed))
    ingest([lab / "logs"], processed, jobs=1)
    ExperimentStages.stored(processed, "bench", "1").table("response")
    (new,) = set(trials_files(processed)) - before
    ids = pq.read_table(new, columns=["trial_id"]).column("trial_id").to_pylist()
    assert check(processed).gone == ()
    new.unlink()
    (told,) = check(processed).gone
    assert told.startswith(f"Experiment 1 of bench: stored results are based on 1 trial ({ids[0]})")
    assert told in compare("bench", processed, criteria=("overshoot",)).result.warnings


def test_what_was_undone_deleted_or_replaced_is_not_gone(lab):
    processed, log = lab / "processed", lab / "logs" / "1.csv"
    use_again(processed, str(lab / "logs" / "0.csv"))
    assert check(processed).gone == ()
    log.write_text(short_log(1.5, rows=40))
    ingest([lab / "logs"], processed, jobs=1)
    merge_all(processed)
    assert check(processed).gone == ()


@pytest.mark.parametrize("seed", range(6))
def test_a_flipped_byte_costs_nothing_where_the_logs_are(lab, seed):
    processed = lab / "processed"
    (file,) = trials_files(processed)
    flip(file, random.Random(seed).randrange(file.stat().st_size))
    (told,) = check(processed).damage
    (done,) = check(processed, repair=True).damage
    assert (told.remedy, told.trials, told.read_again) == (done.remedy, done.trials, done.read_again)
    if done.trials:
        assert len(load_trials(processed, read_trials(processed))) == 6, "the file that was read again stays"
    ingest([lab / "logs"], processed, jobs=1)
    assert check_whole(processed, logs_of(lab)) == set(logs_of(lab))
    assert not [one for one in check(processed).damage if one.file.startswith("trials")]


def test_groups_that_can_be_read_are_kept_where_the_logs_are_gone(lab):
    processed = lab / "processed"
    (file,) = trials_files(processed)
    (lab / "logs").rename(lab / "elsewhere")
    group = pq.read_metadata(file).row_group(1)
    columns = (group.column(number) for number in range(group.num_columns))
    position = next(column for column in columns if column.path_in_schema.startswith("position"))
    flip(file, position.data_page_offset + position.total_compressed_size // 3)
    (damage,) = check(processed, repair=True).damage
    assert (damage.remedy, damage.trials, damage.kept, damage.read_again) == ("save", 6, 4, 0)
    assert {one["source_path"].rpartition("/")[2] for one in damage.lost} == {"2.csv", "3.csv"}
    assert len(load_trials(processed, read_trials(processed))) == 4
    assert len(list((processed / "damaged").rglob("*.lost.json"))) == 1
    assert len(list((processed / "damaged").rglob("*.damaged"))) == 1
    assert check(processed).damage == ()


def test_a_file_of_which_all_can_be_read_stays_where_the_logs_are_gone(lab):
    """What is kept of it is the same file then: the name of the library that wrote it changes no trial."""
    processed = lab / "processed"
    (file,) = trials_files(processed)
    (lab / "logs").rename(lab / "elsewhere")
    flip(file, file.read_bytes().rindex(b"parquet-cpp"))
    (damage,) = check(processed, repair=True).damage
    assert (damage.kept, damage.lost) == (6, ())
    assert check(processed).damage == ()
    assert check_whole(processed, logs_of(lab)) == set(logs_of(lab))


@pytest.mark.parametrize("cut", [0, 10, -10])
def test_a_file_that_is_cut_off_or_deleted_is_read_again_by_the_next_ingest(lab, cut):
    processed = lab / "processed"
    (file,) = trials_files(processed)
    file.write_bytes(file.read_bytes()[:cut] if cut else b"")
    report = ingest([lab / "logs"], processed, jobs=1)
    assert (report.ingested, len(report.damaged)) == (6, 1)
    assert check(processed).damage == (), "the same logs give the same file"
    assert check_whole(processed, logs_of(lab)) == set(logs_of(lab))
    for deleted in trials_files(processed):
        deleted.unlink()
    assert ingest([lab / "logs"], processed, jobs=1).ingested == 6
    assert check_whole(processed, logs_of(lab)) == set(logs_of(lab))

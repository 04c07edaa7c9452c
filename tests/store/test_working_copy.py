"""Stores by URL: the same tables as in a folder, whole at any moment, whoever else writes."""

import errno
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest
from native_logs import short_log
from pipeline.intake.compaction import compact
from pipeline.store.manifests import ConflictError, read_manifest

from pipeline.base.errors import DeviceError, StoreError
from pipeline.comparison.scene.scene import open_scene
from pipeline.intake import compaction
from pipeline.intake.exclude import exclude
from pipeline.intake.ingest import ingest
from pipeline.store import working_copy
from pipeline.store.corrections import read_exclusions
from pipeline.store.mirror import opened, publish, stored_by
from pipeline.store.objects import Objects
from pipeline.store.samples import load_batch
from pipeline.store.storage import list_experiments, read_trials


def write_logs(folder, stiffnesses, experiment="1"):
    folder.mkdir(parents=True, exist_ok=True)
    for stiffness in stiffnesses:
        (folder / f"{experiment.replace('/', '-')}-{stiffness}.csv").write_text(short_log(float(stiffness), experiment))
    return folder


def store(url, *folders):
    return stored_by(url, lambda processed: ingest(folders, processed))


def seen(url, experiment="1"):
    """Stiffness and samples of the trials of an experiment, all of them read."""
    with opened(url, "bench") as processed:
        trials = read_trials(processed, "bench", experiment)
        batch = load_batch(processed, trials)
        assert [row[0] for row in batch.command.tolist()] == batch.stiffness.tolist(), "samples are those of the trial"
        return sorted(batch.stiffness.tolist())


def test_the_tables_are_those_of_a_folder(s3, tmp_path):
    logs = write_logs(tmp_path / "logs", [1, 2, 3])
    write_logs(logs, [1, 2], "a/B %41")
    (logs / "bad.csv").write_text("nothing")
    local = ingest([logs], tmp_path / "local")
    assert store(s3, logs).model_dump() == local.model_dump()
    assert store(s3, logs).skipped == 5
    with opened(s3) as processed:
        read_trials(processed)
        for experiment in list_experiments(processed, "bench"):
            load_batch(processed, read_trials(processed, "bench", experiment))
        for tree in ("trials", "samples", "quarantine"):
            here = {f.relative_to(processed): f.read_bytes() for f in (processed / tree).rglob("*") if f.is_file()}
            there = [f for f in (tmp_path / "local" / tree).rglob("*") if f.is_file()]
            assert here == {file.relative_to(tmp_path / "local"): file.read_bytes() for file in there}
            assert here
    assert not processed.exists(), "a working copy is removed"


def test_changed_excluded_and_merged_trials(s3, tmp_path, monkeypatch):
    logs = write_logs(tmp_path / "logs", [1, 2, 3])
    store(s3, logs)
    (logs / "1-2.csv").write_text(short_log(20.0))
    assert [one.path for one in store(s3, logs).changed] == [str(logs / "1-2.csv")]
    assert seen(s3) == [1, 3, 20]
    stored_by(s3, lambda processed: exclude(processed, str(logs / "1-3.csv"), "slipped"))
    with opened(s3, "bench") as processed:
        assert [one.exclusion_reason for one in read_exclusions(processed).values()] == ["slipped"]
    report = stored_by(s3, compact)
    assert [(one.batches, one.trials) for one in report.merged] == [(2, 3)]
    assert report.merged[0].bytes_after < report.merged[0].bytes_before
    assert seen(s3) == [1, 3, 20]
    files = read_manifest(Objects(s3), "bench/1").files
    assert sorted(path.split("/")[0] for path in files) == ["samples", "trials"], "former batches are not named"
    assert stored_by(s3, compact).merged == ()
    monkeypatch.setattr(compaction, "MOST_SMALL", 2)
    store(s3, write_logs(tmp_path / "more", [4, 5, 6]))
    assert seen(s3) == [1, 3, 4, 5, 6, 20]
    assert len(read_manifest(Objects(s3), "bench/1").files) == 2, "an ingest merges there, too"


def test_objects_that_nothing_names_are_removed_after_a_week(s3, tmp_path, monkeypatch):
    logs = write_logs(tmp_path / "logs", [1, 2])
    store(s3, logs)
    (logs / "1-2.csv").write_text(short_log(20.0))
    store(s3, logs)
    objects = Objects(s3)
    count = len(objects.list("objects/"))
    assert stored_by(s3, compact).orphans == (), "they are of today"
    monkeypatch.setattr(working_copy, "KEPT", timedelta(0))
    dry = stored_by(s3, lambda processed: compact(processed, dry_run=True))
    assert len(dry.orphans) == len(objects.list("objects/")) - 2 >= count - 2
    assert dry.orphan_bytes == sum(size for name, size, _ in objects.list("objects/") if name in dry.orphans)
    assert stored_by(s3, compact).orphans == dry.orphans
    assert len(objects.list("objects/")) == len(read_manifest(objects, "bench/1").files) == 2
    assert seen(s3) == [1, 20]


def test_a_reader_sees_one_moment(s3, tmp_path):
    store(s3, write_logs(tmp_path / "logs", [1, 2]))
    with opened(s3, "bench") as processed:
        store(s3, write_logs(tmp_path / "logs", [3]))
        stored_by(s3, compact)
        trials = read_trials(processed)
        assert sorted(load_batch(processed, trials).stiffness.tolist()) == [1, 2], "its objects are still there"
    assert seen(s3) == [1, 2, 3]


def test_two_ingests_at_once_lose_nothing(s3, tmp_path, monkeypatch):
    """The second one stores while the first one is about to make its trials visible."""
    first, second = write_logs(tmp_path / "first", [1, 2]), write_logs(tmp_path / "second", [2, 3])
    write_logs(first, [7], "2")
    original, times = working_copy.advance, []

    def late(objects, base, files):
        times.append(base.name)
        if base.name == "bench/1" and times.count("bench/1") == 1:
            store(s3, second)
        return original(objects, base, files)

    monkeypatch.setattr(working_copy, "advance", late)
    report = store(s3, first)
    assert report.found == 3
    assert times.count("bench/1") == 3, "once in vain, once by the other one, once anew"
    assert times.count("bench/2") == 1, "what nobody else touched is stored once"
    assert seen(s3) == [1, 2, 3]
    assert seen(s3, "2") == [7]


def test_who_never_gets_a_turn_is_told(s3, tmp_path, monkeypatch):
    def never(objects, base, files):
        raise ConflictError("another command")

    monkeypatch.setattr(working_copy, "advance", never)
    monkeypatch.setattr(working_copy, "REPEATS", 3)
    with pytest.raises(ConflictError):
        store(s3, write_logs(tmp_path / "logs", [1]))


def test_wherever_it_is_cut_off_each_batch_is_whole(s3, tmp_path, monkeypatch):
    """Every request that writes fails in turn, as when the process is killed there."""
    logs = write_logs(tmp_path / "logs", [1, 2])
    write_logs(logs, [3], "2")
    puts = []
    for name in ("put", "advance"):
        original = getattr(Objects, name)

        def counted(self, *given, original=original):
            if len(puts) >= limit:
                raise KeyboardInterrupt
            puts.append(given[0])
            return original(self, *given)

        monkeypatch.setattr(Objects, name, counted)
    for cut in range(9):
        limit, url = cut, f"{s3}/{cut}"
        puts.clear()
        try:
            store(url, logs)
        except KeyboardInterrupt:
            assert cut < 6
        else:
            assert len(puts) == 6, "two files and a manifest of each experiment"
        limit = 100
        assert seen(url) in ([], [1, 2])
        assert seen(url, "2") in ([], [3])
        store(url, logs)
        assert (seen(url), seen(url, "2")) == ([1, 2], [3])


def test_a_damaged_or_missing_object_is_named(s3, tmp_path):
    store(s3, write_logs(tmp_path / "logs", [1]))
    objects = Objects(s3)
    sample = next(name for path, name in read_manifest(objects, "bench/1").files.items() if path.startswith("samples"))
    name = f"objects/bench/1/{sample}"
    (tmp_path / "file").write_bytes(objects.get(name)[0][:-1])
    objects.put(name, tmp_path / "file")
    with pytest.raises(StoreError, match=rf"{sample}: is not as it was written; it holds samples/bench/1"):
        seen(s3)
    objects.delete([name])
    with pytest.raises(StoreError, match=rf"{sample}: is missing"):
        seen(s3)


def test_a_store_that_may_only_be_read(s3, tmp_path, monkeypatch):
    """What is computed is not kept there; what is to be stored is an error, and no success that stored nothing."""

    def refuse(self, name, file):
        raise PermissionError(errno.EACCES, "no", self.url)

    logs = write_logs(tmp_path / "logs", [1])
    store(s3, logs)
    monkeypatch.setattr(Objects, "put", refuse)
    with opened(s3, "bench") as processed:
        (processed / "theory").mkdir()
        (processed / "theory" / "0.json").write_text("{}")
    with pytest.raises(PermissionError):
        stored_by(s3, lambda processed: exclude(processed, str(logs / "1-1.csv"), "slipped"))
    with pytest.raises(StoreError, match=r"cannot be written .*no.*run the command again"):
        store(s3, write_logs(tmp_path / "more", [2]))
    assert seen(s3) == [1]


def test_a_device_that_is_not_there_is_told_with_those_that_are(s3, tmp_path):
    store(s3, write_logs(tmp_path / "logs", [1]))
    words = f"^{s3}: holds no logs of device 'x'; found bench. .*--processed {s3}$"
    with pytest.raises(DeviceError, match=words), opened(s3, "x") as processed:
        open_scene("x", processed, None, None)


def test_errors_name_the_store_and_not_the_copy(s3, tmp_path):
    with pytest.raises(StoreError, match=f"^{s3}/trials/x is wrong$"), opened(s3) as processed:
        raise StoreError(f"{processed}/trials/x is wrong")


def test_a_folder_is_itself(tmp_path):
    with opened(str(tmp_path)) as processed:
        assert processed == tmp_path
        publish(processed)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_ingests_of_several_processes_lose_nothing(s3, tmp_path):
    """Each of four processes stores ten logs of one experiment, one by one."""
    code = "import sys; from pipeline.shell.cli import run; run(sys.argv[1:])"

    def store_all(number):
        for step in range(3):
            logs = write_logs(tmp_path / f"{number}-{step}", [100 * number + step])
            done = subprocess.run(
                [sys.executable, "-c", code, "ingest", logs, "--processed", s3], capture_output=True, text=True
            )
            assert done.returncode == 0, done.stderr

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(store_all, range(4)))
    assert seen(s3) == [100 * number + step for number in range(4) for step in range(3)]

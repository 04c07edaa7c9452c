"""Stores by URL: tables as in a folder, whole at any moment, whoever else writes; failures tell their cure."""

import errno
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pyarrow.parquet as pq
import pytest
from clusters import free_port
from native_logs import short_log
from obstore.exceptions import PermissionDeniedError
from stored import merge_all

from pipeline.base.errors import DeviceError, StoreError, UsageError
from pipeline.comparison.scene.scene import open_scene
from pipeline.intake.ingest import ingest
from pipeline.store import batch_files
from pipeline.store import objects as objects_module
from pipeline.store.corrections import exclude
from pipeline.store.objects import Objects, check_installed, is_url, opened, stored_by
from pipeline.store.samples import load_trials
from pipeline.store.storage import list_experiments, read_exclusions, read_trials


def write_logs(folder, stiffnesses, experiment="1"):
    folder.mkdir(parents=True, exist_ok=True)
    for stiffness in stiffnesses:
        (folder / f"{experiment.replace('/', '-')}-{stiffness}.csv").write_text(short_log(float(stiffness), experiment))
    return folder


def store(url, *folders):
    return stored_by(url, lambda processed: ingest(folders, processed))


def objects_of(url):
    return [name for name, _, _ in Objects(url).list("trials/")]


def seen(url, experiment="1"):
    """Stiffness and samples of the trials of an experiment, all of them read."""
    with opened(url, "bench") as processed:
        trials = read_trials(processed, "bench", experiment)
        loaded = load_trials(processed, trials)
        for trial in loaded:
            assert trial.command[0] == trial.stiffness, "samples are those of the trial"
        return sorted(loaded.stiffness.tolist())


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
            load_trials(processed, read_trials(processed, "bench", experiment))
        for tree in ("trials", "quarantine"):
            here = {f.relative_to(processed): f.read_bytes() for f in (processed / tree).rglob("*") if f.is_file()}
            there = [f for f in (tmp_path / "local" / tree).rglob("*") if f.is_file()]
            assert here == {file.relative_to(tmp_path / "local"): file.read_bytes() for file in there}
            assert here
    assert not processed.exists(), "the mirror is removed"


def test_changed_excluded_and_merged_trials(s3, tmp_path, monkeypatch):
    logs = write_logs(tmp_path / "logs", [1, 2, 3])
    store(s3, logs)
    (logs / "1-2.csv").write_text(short_log(20.0))
    assert [one.path for one in store(s3, logs).changed] == [str(logs / "1-2.csv")]
    assert seen(s3) == [1, 3, 20]
    stored_by(s3, lambda processed: exclude(processed, str(logs / "1-3.csv"), "slipped"))
    with opened(s3, "bench") as processed:
        assert [one.exclusion_reason for one in read_exclusions(processed).values()] == ["slipped"]
    assert len(objects_of(s3)) == 1, "the changed trial came with those that stay"
    stored_by(s3, merge_all)
    assert seen(s3) == [1, 3, 20]
    assert len(objects_of(s3)) == 1, "former files are gone"
    monkeypatch.setattr(batch_files, "MOST_SMALL", 2)
    store(s3, write_logs(tmp_path / "more", [4, 5, 6]))
    assert seen(s3) == [1, 3, 4, 5, 6, 20]
    assert len(objects_of(s3)) == 1, "an ingest merges there, too"


def test_a_reader_sees_one_moment(s3, tmp_path):
    store(s3, write_logs(tmp_path / "logs", [1, 2]))
    with opened(s3, "bench") as processed:
        store(s3, write_logs(tmp_path / "logs", [3]))
        stored_by(s3, merge_all)
        trials = read_trials(processed)
        assert sorted(load_trials(processed, trials).stiffness.tolist()) == [1, 2], "its objects are still there"
    assert seen(s3) == [1, 2, 3]


@pytest.fixture
def meanwhile(monkeypatch):
    """Call it with what is to happen when the next command is about to put its first file of trials."""

    def meanwhile_do(work):
        original, pending = Objects.put, [work]

        def put(self, name, file):
            if pending and name.startswith("trials/"):
                pending.pop()()
            return original(self, name, file)

        monkeypatch.setattr(Objects, "put", put)

    return meanwhile_do


def rows_of(url):
    """Rows of each stiffness in all files, whatever readers make of them."""
    with opened(url) as processed:
        tables = [pq.read_table(file, columns=["stiffness"]) for file in processed.glob("trials/*/*/*.parquet")]
    return sorted(value for table in tables for value in table.column(0).to_pylist())


def test_two_ingests_at_once_lose_nothing(s3, tmp_path, meanwhile):
    """The second one stores while the first one is about to make its trials visible; one log is that of both."""
    first, second = write_logs(tmp_path / "first", [1, 2]), write_logs(tmp_path / "second", [2, 3])
    meanwhile(lambda: store(s3, second))
    assert store(s3, first).found == 2
    assert seen(s3) == rows_of(s3) == [1, 2, 3], "no reader sees a trial twice when both are done"


def test_two_merges_and_an_ingest_at_once_lose_nothing(s3, tmp_path, meanwhile):
    logs = tmp_path / "logs"
    for number in range(4):
        store(s3, write_logs(logs, [number]))

    def other():
        stored_by(s3, merge_all)
        (logs / "1-0.csv").write_text(short_log(50.0))
        store(s3, write_logs(logs, [7]))

    meanwhile(other)
    stored_by(s3, merge_all)
    assert seen(s3) == [1, 2, 3, 7, 50]
    store(s3, write_logs(logs, [8]))
    assert seen(s3) == rows_of(s3) == [1, 2, 3, 7, 8, 50]
    assert store(s3, logs).skipped == 6


def test_corrections_at_once_both_count(s3, tmp_path, monkeypatch):
    logs = write_logs(tmp_path / "logs", [1, 2])
    store(s3, logs)

    def other():
        stored_by(s3, lambda processed: exclude(processed, str(logs / "1-2.csv"), "second"))

    with opened(s3) as processed:
        exclude(processed, str(logs / "1-1.csv"), "first")
        other()
    with opened(s3) as processed:
        assert sorted(one.exclusion_reason for one in read_exclusions(processed).values()) == ["first", "second"]


def test_a_file_that_is_merged_while_it_is_brought(s3, tmp_path, monkeypatch):
    for number in range(3):
        store(s3, write_logs(tmp_path / "logs", [number]))
    original, pending = Objects.get, [1]

    def get(self, name):
        if pending:
            pending.pop()
            stored_by(s3, merge_all)
        return original(self, name)

    monkeypatch.setattr(Objects, "get", get)
    assert seen(s3) == [0, 1, 2]
    assert not pending


@pytest.mark.slow
def test_wherever_it_is_cut_off_each_file_is_whole(s3, tmp_path, monkeypatch):
    """Every request that writes fails in turn, as when the process is killed there."""
    logs = write_logs(tmp_path / "logs", [1, 2])
    write_logs(logs, [3], "2")
    done = []
    for name in ("put", "delete"):
        original = getattr(Objects, name)

        def counted(self, *given, original=original):
            if len(done) >= limit:
                raise KeyboardInterrupt
            done.append(given[0])
            return original(self, *given)

        monkeypatch.setattr(Objects, name, counted)
    for cut in range(12):
        limit, url = cut, f"{s3}/{cut}"
        done.clear()
        with suppress(KeyboardInterrupt):
            store(url, logs)
            (logs / "1-1.csv").write_text(short_log(10.0))
            store(url, logs)
        limit = 1000
        assert seen(url) in ([], [1, 2], [2, 10])
        assert seen(url, "2") in ([], [3])
        store(url, logs)
        assert (seen(url)[-1:], seen(url, "2")) == (
            [10] if (logs / "1-1.csv").read_text() == short_log(10.0) else [2],
            [3],
        )
        assert len(rows_of(url)) == 3
        (logs / "1-1.csv").write_text(short_log(1.0))


def test_a_damaged_object_is_named(s3, tmp_path):
    store(s3, write_logs(tmp_path / "logs", [1]))
    objects = Objects(s3)
    (name,) = objects_of(s3)
    (tmp_path / "file").write_bytes(objects.get(name)[:-1])
    objects.put(name, tmp_path / "file")
    with pytest.raises(StoreError, match=rf"{s3}/{name}: is missing or damaged"):
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
    words = f"^{s3}: contains no logs of device 'x'; found bench. .*--processed {s3}$"
    with pytest.raises(DeviceError, match=words), opened(s3, "x") as processed:
        open_scene("x", processed, None, None)


def test_errors_name_the_store_and_not_the_copy(s3, tmp_path):
    with pytest.raises(StoreError, match=f"^{s3}/trials/x is wrong$"), opened(s3) as processed:
        raise StoreError(f"{processed}/trials/x is wrong")


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


def test_names_below_a_url_are_listed_page_by_page(s3, tmp_path):
    store = Objects(s3 + "/")
    (tmp_path / "file").write_bytes(b"x")
    names = [f"x/{number:04d} %41 ä" for number in range(3)]
    for name in (*names, "y"):
        store.put(name, tmp_path / "file")
    assert sorted(name for name, _, _ in store.list("x/")) == names
    store.delete(names[:1])
    store.delete([])
    assert sorted(name for name, _, _ in store.list("x/")) == names[1:]
    assert store.get(names[0]) is None
    assert Objects(s3[:-1]).list("") == [], "another prefix that begins alike"


def test_a_store_that_is_gone_says_what_to_repeat(monkeypatch, server):
    monkeypatch.setattr(objects_module, "RETRIES", 1)
    for name, value in (server.env | {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{free_port()}"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(StoreError, match=r"s3://lab/x: a request failed.*AWS_ENDPOINT_URL.*repeat"):
        Objects("s3://lab/x").get("a")


def test_a_store_that_may_only_be_read_is_like_a_folder_that_may(s3, monkeypatch, tmp_path):
    def refuse(*_, **__):
        raise PermissionDeniedError("no")

    monkeypatch.setattr("obstore.store.S3Store.put", refuse)
    with pytest.raises(PermissionError) as told:
        Objects(s3).put("a", tmp_path)
    assert told.value.filename == s3


@pytest.mark.parametrize("url", ["s3://", "gs://bucket", "http://host/x"])
def test_other_urls_are_refused(url):
    assert is_url(url)
    with pytest.raises(UsageError, match=r"Name a folder, or s3://BUCKET/PREFIX"):
        Objects(url)


def test_folders_are_no_urls(tmp_path):
    assert not any(map(is_url, ("processed", tmp_path, "C:\\x", "a:b")))


def test_without_the_extra_it_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(objects_module, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"s3://x needs obstore.*pip install '.\[cluster\]'"):
        Objects("s3://x")
    with pytest.raises(UsageError, match="needs distributed"):
        check_installed("distributed", "a cluster")

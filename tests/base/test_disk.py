"""New files: whole or not there, written by many threads at a time, and never through a link."""

import gc
import os
import stat
import subprocess
import sys
import threading
import tracemalloc

import pytest
from native_logs import FAULTS, log_text
from stored import merge_all

from pipeline.base import disk
from pipeline.base.disk import new_file, read_result, replacing, result_files, write_result
from pipeline.base.errors import StoreError
from pipeline.intake.ingest import ingest


def test_threads_may_write_one_file(tmp_path):
    """Each content is as long as no other, so that torn ones are seen."""
    contents = [bytes([65 + k]) * (200_000 + k) for k in range(8)]
    failed, seen = [], set()
    start = threading.Barrier(len(contents) + 1)

    def write(content):
        start.wait()
        try:
            for _ in range(10):
                with replacing(tmp_path / "file") as stream:
                    stream.write(content)
        except OSError as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    start.wait()
    while any(thread.is_alive() for thread in threads):
        if (tmp_path / "file").exists():
            seen.add((tmp_path / "file").read_bytes())
    for thread in threads:
        thread.join()
    assert failed == []
    assert seen | {(tmp_path / "file").read_bytes()} <= set(contents)
    assert os.listdir(tmp_path) == ["file"]


def abandoned(folder, name):
    """The temporary file of a writer that was killed."""
    killed = new_file(folder, name=name)
    file = killed.__enter__()
    file.stream.close()
    KILLED.append(killed)
    return file.path


KILLED = []
"""Keeps writers from being ended by the collector, which would clean up."""


@pytest.mark.parametrize("fails", ["nothing", "scandir", "unlink"])
def test_what_killed_writers_left_is_removed_by_a_later_one(tmp_path, monkeypatch, fails):
    *killed, young = (abandoned(tmp_path, name).name for name in ("a", "line\nbreak", "b" * 300, "a"))
    others = [".a.tmp", ".a.0123.tmp", "a.0123456789abcdef.tmp", ".a.0123456789abcdef.tmp~", "a.html"]
    for name in others:
        (tmp_path / name).touch()
    (tmp_path / ".folder.0123456789abcdef.tmp").mkdir()
    for name in os.listdir(tmp_path):
        if name != young:
            os.utime(tmp_path / name, (0, 0))

    plain = os.unlink

    def failing(path):
        if fails == "scandir" or os.path.basename(path) in killed:
            raise PermissionError
        plain(path)

    with monkeypatch.context() as patch:
        if fails != "nothing":
            patch.setattr(disk.os, fails, failing)
        with replacing(tmp_path / "new"):
            pass
    left = {"new", young, *others, ".folder.0123456789abcdef.tmp", *(killed if fails != "nothing" else ())}
    assert set(os.listdir(tmp_path)) == left


def test_no_file_is_written_through_a_link(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").write_text("kept")
    monkeypatch.setattr(disk.secrets, "token_hex", lambda _: "0")
    (tmp_path / ".file.0.tmp").symlink_to("elsewhere")
    with pytest.raises(FileExistsError), replacing(tmp_path / "file"):
        pass
    (tmp_path / "processed").mkdir()
    (tmp_path / "processed" / disk.LOCK_FILE).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="symbolic links"), disk.writing(tmp_path / "processed"):
        pass
    assert (tmp_path / "elsewhere").read_text() == "kept"


def test_a_kept_result_is_named_by_its_content_and_a_damaged_one_is_none(tmp_path):
    assert read_result(tmp_path, "x", ".json") is None
    other = write_result(tmp_path, "x-y", ".json", b"{1}")
    first, second = (write_result(tmp_path, "x", ".json", content) for content in (b"{}", b"{2}"))
    assert not first.exists()
    assert result_files(tmp_path, "x", ".json") == [second]
    assert (read_result(tmp_path, "x", ".json"), read_result(tmp_path, "x-y", ".json")) == (b"{2}", b"{1}")
    second.write_bytes(b"{3}")
    assert read_result(tmp_path, "x", ".json") is None
    assert write_result(tmp_path, "x", ".json", b"{2}") == second
    assert read_result(tmp_path, "x", ".json") == b"{2}"
    assert other.exists()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no device that is always full")
def test_a_full_disk_is_named_and_nothing_is_left(tmp_path):
    """Bytes are collected before they are written, so that the disk is found full at any of three moments."""
    resource = pytest.importorskip("resource")
    code = "import resource, signal, sys; from pathlib import Path; from pipeline.base.disk import write_text\n"
    code += "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
    code += "write_text(Path(sys.argv[1]), 'x' * int(sys.argv[2]))"
    assert resource
    for size in (1001, 3_000_000):
        run = subprocess.run(
            [sys.executable, "-c", code, tmp_path / "file", str(size)], capture_output=True, text=True, check=False
        )
        assert run.returncode == 1
        assert f"File too large: '{tmp_path / 'file'}'" in run.stderr
        assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("modes", "found"), [((0o600,), {0o600}), ((0o644, 0o600), {0o600, 0o644}), ((0o640,), {0o640})]
)
def test_trials_are_read_by_whom_the_log_may_be_read(tmp_path, modes, found):
    """Logs of unlike modes lie in unlike files, before and after a merge; the mask of new files counts, too."""
    logs = tmp_path / "logs"
    logs.mkdir()
    former = os.umask(0o022)
    try:
        for number in range(4):
            (logs / f"{number}.csv").write_text(log_text(number))
            (logs / f"{number}.csv").chmod(modes[number % len(modes)])
            ingest([logs / f"{number}.csv"], tmp_path / "processed", jobs=1)
        merge_all(tmp_path / "processed")
    finally:
        os.umask(former)
    files = list((tmp_path / "processed" / "trials").rglob("*.parquet"))
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == found
    assert len(files) == len(found)


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o644, 0o400, 0o604, 0o755])
def test_a_record_in_quarantine_is_for_nobody_else(tmp_path, mode):
    (tmp_path / "logs").mkdir()
    log = tmp_path / "logs" / "bad.csv"
    log.write_text(FAULTS["text cell"][0])
    log.chmod(mode)
    assert len(ingest([tmp_path / "logs"], tmp_path / "processed", jobs=1).quarantined) == 1
    (folder,) = (tmp_path / "processed" / "quarantine").iterdir()
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}
    # the record quotes the log
    assert [name.partition("-")[0] for name in modes] == ["reason"]
    assert set(modes.values()) == {mode & 0o666}


def test_refused_logs_do_not_stay_in_memory(tmp_path):
    """An error holds the frames in which it was raised, and these the bytes of the log."""
    (tmp_path / "logs").mkdir()
    bad = FAULTS["no stiffness"][0] + "#" * 200_000
    for number in range(60):
        (tmp_path / "logs" / f"{number}.csv").write_text(bad.replace("300 ", f"{number} ") + str(number))
    ingest([tmp_path / "logs"], tmp_path / "first", jobs=1)  # what is made once
    gc.collect()
    gc.disable()
    tracemalloc.start()
    try:
        assert len(ingest([tmp_path / "logs"], tmp_path / "processed", jobs=1).quarantined) == 60
        left, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
        gc.enable()
    assert left < 60 * 200_000 / 10

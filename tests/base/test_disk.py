"""New files: whole or not there, written by many threads at a time, and never through a link."""

import gc
import os
import stat
import threading
import tracemalloc

import pytest
from native_logs import FAULTS, log_text

from pipeline.base import disk, lock
from pipeline.base.disk import NewFile, publish_all, remove_temporary, replacing
from pipeline.intake.ingest import ingest
from pipeline.intake.quarantine import RECORD_FILE


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


def test_what_is_left_over_is_removed_whoever_wrote_it(tmp_path):
    for name in ("a", "b" * 300):
        NewFile(tmp_path / "below", name)
    (tmp_path / "below" / ".a.123.tmp").write_text("of an earlier version")
    assert len(os.listdir(tmp_path / "below")) == 3
    remove_temporary(tmp_path)
    assert os.listdir(tmp_path / "below") == []


@pytest.mark.parametrize("fails", ["nothing", "scandir", "unlink"])
def test_what_killed_writers_left_is_removed_by_a_later_one(tmp_path, monkeypatch, fails):
    killed = [NewFile(tmp_path, name)._temporary.name for name in ("a", "line\nbreak", "b" * 300)]
    young = NewFile(tmp_path, "a")._temporary.name
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
    (tmp_path / "processed" / lock.LOCK_FILE).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="symbolic links"), lock.writing(tmp_path / "processed"):
        pass
    assert (tmp_path / "elsewhere").read_text() == "kept"


def test_groups_are_named_one_after_the_other_and_synced_together(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(disk, "sync_folder", lambda folder: calls.append(("synced", folder.name)))
    replaced = os.replace
    monkeypatch.setattr(disk.os, "replace", lambda old, new: calls.append(("named", new.name)) or replaced(old, new))
    first, second = ([(NewFile(tmp_path / kind / str(k), "x"), f"{kind}{k}") for k in range(3)] for kind in "ab")
    calls.clear()
    publish_all(first, second)
    kinds = [kind for kind, _ in calls]
    assert kinds == ["named"] * 3 + ["synced"] * 3 + ["named"] * 3 + ["synced"] * 3
    assert [name for kind, name in calls if kind == "named"] == ["a0", "a1", "a2", "b0", "b1", "b2"]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o644, 0o400, 0o604, 0o755])
def test_a_copy_in_quarantine_is_for_nobody_else(tmp_path, mode):
    (tmp_path / "logs").mkdir()
    log = tmp_path / "logs" / "bad.csv"
    log.write_text(FAULTS["text cell"][0])
    log.chmod(mode)
    assert len(ingest([tmp_path / "logs"], tmp_path / "processed", jobs=1).quarantined) == 1
    (folder,) = (tmp_path / "processed" / "quarantine").iterdir()
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}
    # the record quotes the log
    assert modes == {"bad.csv": mode & 0o666, RECORD_FILE: mode & 0o666}


def test_what_a_link_leads_to_is_copied_only_from_inside(tmp_path):
    secret = tmp_path / "secret.csv"
    secret.write_text(FAULTS["text cell"][0])
    logs = tmp_path / "logs"
    (logs / "deep").mkdir(parents=True)
    (logs / "a.csv").write_text(log_text())
    (logs / "deep" / "out.csv").symlink_to(secret)
    (logs / "deep" / "dots.csv").symlink_to("../../secret.csv")
    (logs / "deep" / "round.csv").symlink_to("../../logs/../secret.csv")
    (logs / "deep" / "in.csv").symlink_to("../a.csv")
    report = ingest([logs], tmp_path / "processed", jobs=1)
    assert (report.found, report.ingested, report.skipped) == (5, 1, 1)
    assert {refusal.code for refusal in report.quarantined} == {"link-outside"}
    text = "".join(path.read_text() for path in (tmp_path / "processed" / "quarantine").rglob("*") if path.is_file())
    assert "abc" not in text
    # a link that is given itself is the user's own choice
    (refusal,) = ingest([logs / "deep" / "out.csv"], tmp_path / "processed", jobs=1).quarantined
    assert refusal.code == "not-a-number"


def test_a_log_that_becomes_a_link_while_it_is_looked_at_is_not_followed(tmp_path, monkeypatch):
    from pipeline.base import regular_files

    (tmp_path / "secret").write_text("secret")
    (tmp_path / "log").symlink_to("secret")
    monkeypatch.setattr(regular_files.os.path, "islink", lambda path: False)
    with pytest.raises(OSError, match="symbolic links"):
        regular_files.open_regular(tmp_path / "log", str(tmp_path))


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


def test_a_record_is_small_whatever_the_lines_are(tmp_path):
    (tmp_path / "logs").mkdir()
    lines = FAULTS["no stiffness"][0].replace("\n", " " + "x" * 1000 + "\n")
    (tmp_path / "logs" / "a.csv").write_text(lines)
    assert len(ingest([tmp_path / "logs"], tmp_path / "processed", jobs=1).quarantined) == 1
    (record,) = (tmp_path / "processed" / "quarantine").rglob(RECORD_FILE)
    assert record.stat().st_size < 2000

"""Nothing is lost and nothing doubled: whichever call of the operating system fails, and whenever power is lost."""

import shutil
from collections import Counter
from pathlib import Path

import pytest
from failing_disk import FailingOs, after_power_loss, files_of, generator
from locks import is_free
from native_logs import short_log
from stored import check_whole, merge_all, stored_rows

from pipeline.base import disk
from pipeline.base.errors import StoreError
from pipeline.intake.ingest import ingest
from pipeline.store import batch_files


class Lab:
    """A store with two batches, and logs of which some are new, one has changed, and one is bad."""

    def __init__(self, folder: Path) -> None:
        self.logs, self.processed = folder / "logs", folder / "processed"
        self.logs.mkdir()
        self.write("a", 100)
        self.write("b", 200)
        self.ingest()
        self.write("c", 300)
        self.ingest()
        self.before = {str(self.logs / f"{name}.csv"): k for name, k in (("a", 100.0), ("b", 200.0), ("c", 300.0))}
        self.write("a", 150)
        self.write("d", 400)
        self.write("e", 500, "2")
        self.after = {
            str(self.logs / f"{name}.csv"): k
            for name, k in (("a", 150.0), ("b", 200.0), ("c", 300.0), ("d", 400.0), ("e", 500.0))
        }

    def write(self, name: str, stiffness: float, experiment: str = "1") -> None:
        (self.logs / f"{name}.csv").write_text(short_log(stiffness, experiment))

    def ingest(self, processed: Path | None = None):
        return ingest([self.logs], processed or self.processed, jobs=1, wait_s=0)

    def work(self, kind: str, processed: Path) -> None:
        if kind == "ingest":
            self.ingest(processed)
        else:
            merge_all(processed)

    def check_repaired(self, kind: str, processed: Path) -> None:
        """Whatever happened before: what is visible is right, and the same work once more completes all."""
        either = {path: k for path, k in self.after.items() if self.before.get(path) in (None, k)}
        stored = check_whole(processed, either if kind == "ingest" else self.after)
        assert stored >= set(self.before), "what was stored before is stored still"
        if kind == "ingest":
            report = self.ingest(processed)
            assert report.found == 5
        else:
            assert stored == set(self.after)
            self.work(kind, processed)
        assert check_whole(processed, self.after) == set(self.after)
        assert set(stored_rows(processed).values()) == {1}
        assert stored_rows(processed).total() == 5
        assert not list(processed.rglob("*.tmp"))


@pytest.fixture
def lab(tmp_path, monkeypatch):
    # so that a store of five logs goes through a merge, too
    monkeypatch.setattr(batch_files, "MOST_SMALL", 3)
    # no call fails, but none waits for the real disk either
    monkeypatch.setattr(disk, "os", FailingOs())
    return Lab(tmp_path)


def prepared(lab: Lab, kind: str) -> None:
    if kind == "merge":
        # several batches of an experiment
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(batch_files, "MOST_SMALL", 100)
            lab.ingest()


def recorded(lab: Lab, kind: str, monkeypatch, target: Path) -> list:
    """The calls of one undisturbed run, on a copy of the store."""
    shutil.copytree(lab.processed, target)
    failing = FailingOs()
    with monkeypatch.context() as patch:
        patch.setattr(disk, "os", failing)
        lab.work(kind, target)
    return failing.calls


@pytest.mark.sampled
@pytest.mark.parametrize("kind", ["ingest", "merge"])
def test_each_call_may_fail(lab, kind, monkeypatch, tmp_path):
    prepared(lab, kind)
    calls = recorded(lab, kind, monkeypatch, tmp_path / "clean")
    kinds = Counter(call[0] for call in calls)
    assert set(kinds) == {"create", "write", "sync file", "sync folder", "rename", "unlink"} | (
        {"mkdir"} if kind == "ingest" else set()
    )
    assert kinds["sync file"] == kinds["create"] - 1 == kinds["rename"], "but for the lock"
    for number in range(1, len(calls) + 1):
        target = tmp_path / str(number)
        shutil.copytree(lab.processed, target)
        with monkeypatch.context() as patch:
            patch.setattr(disk, "os", FailingOs(number))
            with pytest.raises((StoreError, OSError), match="No space left"):
                lab.work(kind, target)
        assert is_free(target)
        lab.check_repaired(kind, target)
        shutil.rmtree(target)


def lose_power(lab, kind, monkeypatch, tmp_path, chances, step):
    prepared(lab, kind)
    clean = tmp_path / "clean"
    calls = recorded(lab, kind, monkeypatch, clean)
    before = files_of(lab.processed)
    tried = 0
    for number in range(len(calls) + 1):
        for index, kept in enumerate(chances):
            if (number + index) % step:
                continue
            target = tmp_path / f"{number}-{index}"
            after_power_loss(before, calls[:number], clean, target, kept, generator(number, index))
            lab.check_repaired(kind, target)
            shutil.rmtree(target)
            tried += 1
    assert tried > 10


QUICK, MANY = (0.0, 0.5, 1.0), (0.0, 1.0, *[0.5] * 8)


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("kind", "chances", "step"), [("ingest", QUICK, 3), ("merge", QUICK, 1), ("ingest", MANY, 1), ("merge", MANY, 1)]
)
def test_power_may_fail_at_each_call(lab, kind, chances, step, monkeypatch, tmp_path):
    lose_power(lab, kind, monkeypatch, tmp_path, chances, step)


def test_the_model_of_lost_power_finds_a_missing_sync(lab, monkeypatch, tmp_path):
    """Without syncs of folders the removal of former files may be on the disk before the new ones are."""
    monkeypatch.setattr(disk, "sync_folder", lambda folder: None)
    with pytest.raises((AssertionError, StoreError)):
        lose_power(lab, "merge", monkeypatch, tmp_path, (0.5, 0.5), 1)

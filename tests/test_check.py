"""Damage to stored files is found, and what can be read of them is kept; the truth is the logs and plain pyarrow."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from failing_disk import FailingOs, generator
from native_logs import FAULTS, log_text

from pipeline.base import disk
from pipeline.base.errors import StoreError
from pipeline.base.seal import MARK, DamageError, verify
from pipeline.comparison.status import status
from pipeline.measured.stages import ExperimentStages
from pipeline.records import tables
from pipeline.store import trialstore
from pipeline.store.compaction import compact, find_orphans
from pipeline.store.ingest import ingest
from pipeline.store.repair_damage import check
from pipeline.store.storage import load_batch, read_trials

TRIALS, ROWS = 12, 400


@dataclass
class Lab:
    """A store of two experiments, one of several groups of rows, with a stage and a refused log."""

    logs: Path
    processed: Path

    def file(self, tree: str) -> Path:
        return next(iter(sorted((self.processed / tree / "bench" / "1").glob("*.parquet"))))

    def values(self) -> dict[str, tuple[float, ...]]:
        """Every stored number of each trial, by its id; what is not there is left out."""
        found = {}
        for experiment in ("1", "2"):
            table = read_trials(self.processed, "bench", experiment)
            batch = load_batch(self.processed, table)
            for i, trial in enumerate(batch.trial_id):
                samples = (batch.time[i], batch.command[i], batch.position[i])
                found[trial] = (batch.stiffness[i], *(float(x) for part in samples for x in part[~np.isnan(part)]))
        return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Lab, dict[str, tuple[float, ...]]]:
    folder = tmp_path_factory.mktemp("check")
    lab = Lab(folder / "logs", folder / "processed")
    lab.logs.mkdir()
    for number in range(TRIALS):
        (lab.logs / f"{number:02d}.csv").write_text(log_text(100.0 + number, rows=ROWS, seed=71))
    (lab.logs / "other.csv").write_text(log_text(7.0, experiment="2", rows=ROWS, seed=72))
    (lab.logs / "bad.csv").write_text(FAULTS["text cell"][0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trialstore, "GROUP_ROWS", 4 * ROWS)
        ingest([lab.logs], lab.processed, jobs=1)
    ExperimentStages(lab.processed, "bench", "1", read_trials(lab.processed, "bench", "1")).table("response")
    return lab, lab.values()


@pytest.fixture
def lab(whole, tmp_path, monkeypatch) -> Lab:
    """A copy of that store, whose logs stand where they stood."""
    monkeypatch.setattr(disk, "os", FailingOs())
    shutil.copytree(whole[0].processed, tmp_path / "processed")
    logs = tmp_path / "logs"
    shutil.copytree(whole[0].logs, logs)
    return Lab(whole[0].logs, tmp_path / "processed")


@pytest.fixture
def without_logs(lab) -> Lab:
    """The same as of a lab whose logs are gone: moved to a folder that no trial names."""
    away = lab.logs.with_name("gone")
    lab.logs.rename(away)
    yield Lab(away, lab.processed)
    away.rename(lab.logs)


def flip(data: bytes) -> bytes:
    at = len(data) // 2
    return data[:at] + bytes([data[at] ^ 0x41]) + data[at + 1 :]


KINDS: dict[str, Callable[[bytes], bytes | None]] = {
    "flip": flip,
    "cut": lambda data: data[: 2 * len(data) // 3],
    "zeros": lambda data: data[: len(data) // 4] + bytes(len(data) // 4) + data[len(data) // 2 :],
    "empty": lambda data: b"",
    "missing": lambda data: None,
}


def damage(file: Path, kind: str) -> None:
    content = KINDS[kind](file.read_bytes())
    if content is None:
        file.unlink()
    else:
        file.write_bytes(content)


def readable(file: Path, footer: bytes, trials: pa.Table) -> set[str]:
    """Ids of the trials whose needed columns pyarrow reads, with checksums, by the footer as it was written."""
    content = file.read_bytes() if file.exists() else b""
    content = content[: len(content)].ljust(10**6, b"\0") + footer
    whole = set(trials.column("trial_id").to_pylist())
    with pq.ParquetFile(BytesIO(content), page_checksum_verification=True) as source:
        first = 0
        for group in range(source.num_row_groups):
            rows = source.metadata.row_group(group).num_rows
            for name in ("time_s", "command", "position"):
                try:
                    source.read_row_group(group, columns=[name])
                except (pa.ArrowException, OSError):
                    inside = [first <= at < first + rows for at in trials.column("first_row").to_pylist()]
                    whole -= set(trials.filter(pa.array(inside)).column("trial_id").to_pylist())
            first += rows
    return whole


def footer_of(file: Path) -> bytes:
    data = file.read_bytes()
    return data[-8 - int.from_bytes(data[-8:-4], "little") :]


@pytest.mark.parametrize("tree", ["samples", "trials", "stages"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("with_logs", [True, False], ids=["logs", "no logs"])
def test_nothing_that_can_be_read_is_lost(whole, lab, request, tree, kind, with_logs):
    if not with_logs:
        lab = request.getfixturevalue("without_logs")
    truth = whole[1]
    table = read_trials(lab.processed, "bench", "1")
    footer = footer_of(lab.file("samples"))
    file = lab.file(tree)
    damage(file, kind)
    can_be_read = readable(lab.file("samples"), footer, table) if tree == "samples" and file.exists() else set(truth)
    if tree == "samples" and not file.exists():
        can_be_read = set()
    if tree == "stages" and kind == "missing":
        assert check(lab.processed).damage == ()
        return
    before = {path: path.read_bytes() for path in lab.processed.rglob("*") if path.is_file() and path.name != ".lock"}
    told = check(lab.processed)
    assert before == {p: p.read_bytes() for p in before}, "a check changes nothing"
    (found,) = told.damage
    assert found.file.endswith(file.relative_to(lab.processed).as_posix()) or tree == "trials"
    report = check(lab.processed, repair=True)
    assert report.damage == told.damage
    values = lab.values()
    assert {trial: values[trial] for trial in values} == {trial: truth[trial] for trial in values}
    lost = {one.trial_id for one in report.damage[0].lost if one.whole}
    assert lost | set(values) == set(truth)
    assert not lost & set(values)
    if with_logs or tree != "samples" or kind == "flip":
        assert lost == set()
    else:
        assert lost <= set(truth) - can_be_read
        aside = [path.name for path in (lab.processed / "damaged").rglob("*") if path.is_file()]
        assert len(aside) == 2 + (kind != "missing"), "both files of the batch, and what was lost"
    if tree == "stages":
        assert not file.exists()
    assert check(lab.processed, repair=True).damage == ()
    for path in lab.processed.rglob("*.parquet"):
        assert verify(path)

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
from failing_disk import FailingOs, after_power_loss, files_of, generator
from native_logs import FAULTS, log_text

from pipeline.base import disk
from pipeline.base.errors import StoreError
from pipeline.base.json_seal import DamageError
from pipeline.base.seal import MARK, find_seal, mended, sealed, verify
from pipeline.intake import trialstore
from pipeline.intake.compaction import compact, find_orphans
from pipeline.intake.ingest import ingest
from pipeline.loop.loop import Loop
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.records import table_files, tables
from pipeline.repair.check import look
from pipeline.repair.repair_damage import check
from pipeline.repair.salvage import groups_of
from pipeline.shell.status import status
from pipeline.store.samples import load_batch
from pipeline.store.storage import read_trials
from pipeline.theory.predictions import Predictions

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


@pytest.mark.parametrize("tree", ["samples", "trials", "stages", "theory", "quarantine"])
def test_a_changed_byte_anywhere_is_noticed(lab, tree):
    """Or harmless: the document says the same. So of every file that is stored, at seeded places and at both ends."""
    if tree == "theory":
        loop = Loop(0.0, 0.0, 1.0)
        Predictions(lab.processed / "theory").start([(loop, "overshoot")])
    files = [path for path in (lab.processed / tree).rglob("*") if path.is_file()]
    assert files
    rng = generator(5, len(tree))
    for file in files:
        data = file.read_bytes()
        places = {*range(12), *range(len(data) - 12, len(data)), *rng.integers(0, len(data), 60).tolist()}
        for at in sorted(place for place in places if 0 <= place < len(data)):
            file.write_bytes(data[:at] + bytes([data[at] ^ int(rng.integers(1, 256))]) + data[at + 1 :])
            findings = look(lab.processed, alone=True)
            if not (findings.batches or findings.others):
                assert tree in ("theory", "quarantine"), f"{file}: byte {at}"
                assert unsealed_values(file.read_bytes()) == unsealed_values(data)
        file.write_bytes(data)


def unsealed_values(data: bytes) -> list[object]:
    """What a document says but for its checksum, which may have lost its name."""
    return list(json.loads(data).values())[1:]


def test_readers_refuse_what_was_changed_outside_of_pages(lab):
    """The footer says which column is which: Parquet has no checksum of it."""
    file = lab.file("trials")
    data = file.read_bytes()
    at = data.rindex(b"pipeline.experiment")
    file.write_bytes(data[:at] + b"Q" + data[at + 1 :])
    assert pq.read_table(file, page_checksum_verification=True).num_rows == TRIALS, "plain pyarrow notices nothing"
    with pytest.raises(StoreError, match="pipeline check --repair"):
        read_trials(lab.processed, "bench", "1")
    assert check(lab.processed, repair=True).damage[0].remedy == "restore"
    assert file.read_bytes() == data


def test_a_file_that_lost_its_seal_is_not_taken_for_an_old_one(lab):
    file = lab.file("samples")
    file.write_bytes(file.read_bytes().replace(b"pl-seal1", b"pl-seaX1"))
    with pytest.raises(DamageError):
        verify(file)
    assert check(lab.processed, repair=True).damage[0].lost == ()


@pytest.mark.parametrize("kinds", [("missing", "flip"), ("empty", "cut"), ("zeros", "zeros"), ("missing", "zeros")])
def test_two_damages_at_once(whole, without_logs, kinds):
    """Trials and samples file both: what is told as lost and what is stored are all, and no number is wrong."""
    truth, lab = whole[1], without_logs
    files = lab.file("trials"), lab.file("samples")
    for file, kind in zip(files, kinds, strict=True):
        damage(file, kind)
    (found,) = check(lab.processed, repair=True).damage
    values = lab.values()
    assert values == {trial: truth[trial] for trial in values}
    if kinds[1] == "flip":
        assert set(values) == set(truth)
    elif found.remedy == "save":
        assert set(values) | {one.trial_id for one in found.lost} == set(truth)
    else:
        assert (found.remedy, len(values)) == ("set aside", 1)
    assert all(file.exists() for file in files) or list((lab.processed / "damaged").rglob("*.parquet.1"))
    assert check(lab.processed, repair=True).damage == ()


def test_a_lost_column_that_is_not_needed_costs_no_trial(without_logs):
    """Force is damaged over more than parity restores: trials stay, without it, and are named."""
    lab = without_logs
    file = lab.file("samples")
    table = pq.read_table(file)
    at = table.schema.get_field_index("force")
    force = pa.array(generator(77).normal(size=table.num_rows))
    table_files.write_table(file, table.set_column(at, table.schema.field(at), force))
    # a merge makes a batch whose two files know each other
    more = lab.processed.parent / "more.csv"
    more.write_text(log_text(55.0, rows=ROWS, seed=73))
    ingest([more], lab.processed, jobs=1)
    more.unlink()
    compact(lab.processed)
    before = lab.values()
    file = lab.file("samples")
    chunk = pq.read_metadata(file).row_group(0).column(at)
    start = chunk.dictionary_page_offset or chunk.data_page_offset
    data = bytearray(file.read_bytes())
    data[start + 600 : start + chunk.total_compressed_size - 600] = bytes(chunk.total_compressed_size - 1200)
    file.write_bytes(data)
    (found,) = check(lab.processed, repair=True).damage
    assert {one.columns for one in found.lost} == {("force",)}
    assert len(found.lost) >= TRIALS
    assert not any(one.whole for one in found.lost)
    assert lab.values() == before
    assert check(lab.processed).damage == ()


@pytest.fixture
def two_devices(tmp_path) -> Lab:
    lab = Lab(tmp_path / "logs", tmp_path / "processed")
    lab.logs.mkdir()
    for device in ("one", "two"):
        (lab.logs / f"{device}.csv").write_text(log_text(3.0, device=device))
    (lab.logs / "bad.csv").write_text(FAULTS["text cell"][0])
    (lab.logs / "short.csv").write_text(FAULTS["header only"][0])
    ingest([lab.logs], lab.processed, jobs=1)
    return lab


@pytest.mark.parametrize("part", ["trials/one", "quarantine"])
def test_a_fault_stays_with_its_experiment(two_devices, part):
    lab = two_devices
    file = next(path for path in (lab.processed / part).rglob("*") if path.suffix in (".parquet", ".json"))
    file.write_bytes(b"x" + file.read_bytes()[1:-4])
    (lab.logs / "new.csv").write_text(log_text(9.0, device="two"))
    report = ingest([lab.logs], lab.processed, jobs=1)
    (named,) = report.damaged
    assert str(file) in named
    assert "pipeline check --repair" in named
    assert read_trials(lab.processed, "two").num_rows == 2
    assert (report.found, len(report.quarantined)) == (5, 2)
    if part == "quarantine":
        # its log was refused again, and with it the record made anew
        assert status(lab.processed).damaged == ()
        return
    found = status(lab.processed)
    assert found.damaged == (named,)
    assert {e.device: e.trials for e in found.experiments} == {"one": 1, "two": 2}, "its log was ingested again"
    assert check(lab.processed, repair=True).damage[0].remedy == "restore"
    assert ingest([lab.logs], lab.processed, jobs=1).damaged == ()
    assert read_trials(lab.processed).num_rows == 3


def test_compact_removes_nothing_that_it_could_not_read(two_devices):
    lab = two_devices
    for device in ("one", "two"):
        (lab.logs / f"{device}-2.csv").write_text(log_text(4.0, device=device))
    ingest([lab.logs], lab.processed, jobs=1)
    file = min((lab.processed / "samples" / "one").rglob("*.parquet"))
    data = bytearray(file.read_bytes())
    data[data.rindex(b"pipeline.experiment")] ^= 1
    file.write_bytes(data)
    with pytest.raises(StoreError, match=file.name):
        compact(lab.processed)
    assert len(list(lab.processed.glob("trials/one/**/*.parquet"))) == 2
    assert len(list(lab.processed.glob("trials/two/**/*.parquet"))) == 1, "the other device's batches are merged"


def test_samples_whose_trials_file_is_lost_are_no_left_overs(two_devices):
    lab = two_devices
    for file in lab.processed.rglob("trials/one/**/*.parquet"):
        file.unlink()
    assert find_orphans(lab.processed) == []
    compact(lab.processed)
    assert check(lab.processed, repair=True).damage[0].remedy == "restore"
    assert read_trials(lab.processed, "one").num_rows == 1


def test_a_store_of_an_earlier_version_is_checked_by_its_pages(two_devices):
    lab = two_devices
    for file in lab.processed.rglob("*.parquet"):
        table = pq.read_table(file)
        pq.write_table(table.replace_schema_metadata(without_mark(table.schema.metadata)), file, **table_files.WRITING)
    report = check(lab.processed)
    assert (report.unsealed, report.damage) == (4, ())
    file = next(lab.processed.glob("samples/one/**/*.parquet"))
    chunk = pq.read_metadata(file).row_group(0).column(3)
    data = bytearray(file.read_bytes())
    data[(chunk.dictionary_page_offset or chunk.data_page_offset) + chunk.total_compressed_size - 3] ^= 1
    file.write_bytes(data)
    (found,) = check(lab.processed, repair=True).damage
    assert (found.read_again, found.lost) == (1, ())
    assert read_trials(lab.processed).num_rows == 2


def without_mark(metadata: dict[bytes, bytes]) -> dict[bytes, bytes]:
    return {key: value for key, value in metadata.items() if key != MARK.encode()}


@pytest.mark.parametrize(
    ("kind", "step"), [("cut", 7), *(pytest.param(kind, 1, marks=pytest.mark.slow) for kind in ("cut", "zeros"))]
)
def test_a_repair_may_end_at_any_call(whole, without_logs, kind, step, monkeypatch, tmp_path):
    """By a full disk, or a loss of power: nothing more is lost, and the next one completes it."""
    truth, lab = whole[1], without_logs
    damage(lab.file("samples"), kind)
    clean = Lab(lab.logs, tmp_path / "clean")
    shutil.copytree(lab.processed, clean.processed)
    failing = FailingOs()
    with monkeypatch.context() as patch:
        patch.setattr(disk, "os", failing)
        check(clean.processed, repair=True)
    kept = clean.values()
    assert kept
    assert kept == {trial: truth[trial] for trial in kept}
    before = files_of(lab.processed)
    for number in range(1, len(failing.calls) + 1, step):
        full = Lab(lab.logs, tmp_path / f"full-{number}")
        shutil.copytree(lab.processed, full.processed)
        with monkeypatch.context() as patch:
            patch.setattr(disk, "os", FailingOs(number))
            with pytest.raises(StoreError, match="No space left"):
                check(full.processed, repair=True)
        dark = Lab(lab.logs, tmp_path / f"dark-{number}")
        after_power_loss(before, failing.calls[:number], clean.processed, dark.processed, 0.5, generator(3, number))
        for other in (full, dark):
            check(other.processed, repair=True)
            assert other.values() == kept
            assert check(other.processed, repair=True).damage == ()
            shutil.rmtree(other.processed)


@pytest.mark.parametrize("seed", range(3))
def test_pages_behind_a_damaged_one_are_read(tmp_path, seed):
    """Zeros at three places cost the pages that they touch, of 20,480 rows at most, and no value is wrong."""
    rows, width = 400_000, 20_480
    rng = generator(91, seed)
    noise = rng.normal(size=rows)
    columns = {
        "trial_id": pa.array(np.repeat([f"{k:04d}" for k in range(rows // 1000)], 1000)),
        "time_s": np.tile(np.arange(1000) * 1e-3, rows // 1000),
        "command": np.round(noise, 2),
        "position": noise,
        "force": pa.array(noise, mask=rng.random(rows) < 0.3),
        **dict.fromkeys(("velocity", "raw_time"), pa.nulls(rows, pa.float64())),
        "raw_count": pa.nulls(rows, pa.int64()),
    }
    file = tmp_path / "samples.parquet"
    table_files.write_table(file, tables.to_arrow("samples", columns))
    footer, data = footer_of(file), bytearray(file.read_bytes())
    group = pq.read_metadata(file).row_group(0)
    for index in range(2, 5):
        chunk = group.column(index)
        start = chunk.data_page_offset
        for at in rng.integers(start, start + chunk.total_compressed_size // 2, 3).tolist():
            data[at : at + 500] = bytes(500)
    (found,) = groups_of(bytes(data), footer)
    truth = pq.read_table(file)
    for name, (values, known) in found.columns.items():
        assert values.filter(pa.array(known)).equals(truth.column(name).combine_chunks().filter(pa.array(known)))
    assert found.columns["time_s"][1].all()
    for name in ("command", "position", "force"):
        assert 0 < rows - found.columns[name][1].sum() <= 6 * width + rows // 4
    assert rows - found.columns["position"][1].sum() <= 6 * width


@pytest.mark.parametrize("size", [700, 30_000, 500_000, 1_100_000, 9_000_000])
def test_a_lost_sector_is_restored(size):
    """Of files of half a megabyte and more: 4096 bytes in a row anywhere; of smaller ones a block of 256 bytes."""
    rng = generator(15, size)
    stretch = 4096 if size >= 500_000 else 256
    footer = b"the footer" * 30
    data = sealed(rng.bytes(size) + footer + len(footer).to_bytes(4, "little") + b"PAR1", b"annex" * 9)
    for at in [0, len(data) - stretch, *rng.integers(0, size - stretch, 8).tolist()]:
        at = at // stretch * stretch if stretch == 256 else at
        for damaged in (bytes(stretch), rng.bytes(stretch)):
            broken = data[:at] + damaged + data[at + stretch :]
            # the seal itself has no parity: what it covers is whole then
            assert mended(broken) == data or find_seal(BytesIO(broken)) is None
    assert len(data) - size < 2000 + 0.02 * size

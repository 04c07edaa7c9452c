"""`pipeline bundle`: one file with all behind a report, verified where nothing of the lab is left."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from labs import compare
from typer.testing import CliRunner

from pipeline.base.errors import DeviceError, StoreError, UsageError
from pipeline.device_data.devices import device_file
from pipeline.intake.ingest import ingest
from pipeline.shell.bundle import bundle, verify_bundle
from pipeline.shell.cli import app
from pipeline.shell.verify import lines_of, verify
from pipeline.store.corrections import delete

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_process")]

PROFILE = 'name = "bench"\nformat = "native"\nfiles = ["*.log"]\n'


@dataclass(frozen=True)
class Bench:
    """A lab with a device file and a profile of its own; half of its logs end in .log, read by that profile."""

    folder: Path
    devices: Path
    profile: Path

    @property
    def report(self) -> Path:
        return self.folder / "bench.html"

    @property
    def logs(self) -> Path:
        return self.folder / "raw"


@pytest.fixture(scope="module")
def bench(tmp_path_factory, falcon) -> Bench:
    folder = tmp_path_factory.mktemp("bench")
    lab = Bench(folder, folder / "devices", folder / "bench.toml")
    lab.profile.write_text(PROFILE)
    lab.devices.mkdir()
    text = device_file("falcon").read_text().replace('name = "falcon"', 'name = "bench"', 1)
    (lab.devices / "any.toml").write_text(text)
    lab.logs.mkdir()
    for number, log in enumerate(sorted(falcon.raw.rglob("*.csv"))[::2]):
        text = log.read_text().replace("# device: falcon", "# device: bench")
        (lab.logs / f"{log.stem}{('.csv', '.log')[number % 2]}").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PIPELINE_DEVICES", str(lab.devices))
        ingest([lab.logs], folder / "processed")
        ingest([lab.logs], folder / "processed", lab.profile)
        compare("bench", folder / "processed", criteria=("settle_2pct",), report=lab.report)
        bundle(lab.report)
    return lab


@pytest.fixture(scope="module")
def away(bench, tmp_path_factory) -> Path:
    """The bundle alone in a folder, with the lab's files out of reach."""
    folder = tmp_path_factory.mktemp("away")
    shutil.copy(bench.report.with_suffix(".zip"), folder)
    return folder / "bench.zip"


def changed(file: Path, target: Path, name: str, change) -> Path:
    """A copy of a bundle in which one entry is another."""
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.namelist():
            content = old.read(entry)
            new.writestr(entry, change(content) if entry.endswith(name) else content)
    return target


def test_it_holds_page_document_trials_and_device_and_has_the_same_bytes_again(bench, tmp_path, monkeypatch):
    monkeypatch.setenv("PIPELINE_DEVICES", str(bench.devices))
    before = bench.report.with_suffix(".zip").read_bytes()
    again = bundle(bench.report)
    assert again.trials == len(list(bench.logs.iterdir())) == 90
    assert Path(again.bundle).read_bytes() == before
    with zipfile.ZipFile(again.bundle) as one:
        names = one.namelist()
        assert one.read("devices/bench.toml") == (bench.devices / "any.toml").read_bytes()
    assert {"README.txt", "bench.html", "bench.json"} <= set(names)
    assert sum(name.startswith("processed/trials/bench/1/") for name in names) == 1


def test_it_holds_where_no_file_of_the_lab_is_left(bench, away, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    kept = bench.folder.rename(bench.folder.with_name("moved"))
    try:
        result = CliRunner().invoke(app, ["verify", str(away), "--json"])
    finally:
        kept.rename(bench.folder)
    found = json.loads(result.stdout)
    assert result.exit_code == 0, found
    assert found["equal"]
    assert found["notes"] == []
    assert found["checked"]["cells"] > 100
    assert found["report"] == str(away)
    assert list(tmp_path.iterdir()) == []


def test_a_changed_sample_or_document_in_it_is_named(away, tmp_path):
    def another(content: bytes) -> bytes:
        table = pq.read_table(io.BytesIO(content))
        position = table.column("position").to_pylist()
        position[12][34] += 1e-9
        index = table.schema.get_field_index("position")
        field = table.schema.field(index)
        stream = io.BytesIO()
        pq.write_table(table.set_column(index, field, pa.array(position, field.type)), stream)
        return stream.getvalue()

    found = verify_bundle(changed(away, tmp_path / "sample.zip", ".parquet", another))
    assert not found.equal
    assert [problem.problem for problem in found.logs] == ["its samples differ from those of the report"]
    stable = b'"stable": '
    two = changed(away, tmp_path / "json.zip", "bench.json", lambda text: text.replace(stable, stable + b"1", 1))
    assert [d.kind for d in verify_bundle(two).differences] == ["value"]


def test_a_missing_device_file_is_one_sentence(bench, monkeypatch):
    monkeypatch.delenv("PIPELINE_DEVICES", raising=False)
    with pytest.raises(DeviceError, match=r"device 'bench': the report uses its device file, which was not found"):
        verify(bench.report, bench.folder / "processed", [bench.profile])
    with pytest.raises(DeviceError, match="which was not found"):
        bundle(bench.report)


def test_another_device_file_is_named_before_what_differs_with_it(bench, tmp_path, monkeypatch):
    text = (bench.devices / "any.toml").read_text()
    (tmp_path / "other.toml").write_text(text.replace('title = "', 'title = "Other ', 1))
    monkeypatch.setenv("PIPELINE_DEVICES", str(tmp_path))
    found = verify(bench.report, bench.folder / "processed", [bench.profile])
    assert lines_of(found)[0].startswith("device bench: its device file differs from the one that the report used")


def test_what_a_bundle_needs_and_is_not_there_is_named(bench, tmp_path, monkeypatch):
    monkeypatch.setenv("PIPELINE_DEVICES", str(bench.devices))
    lone = Path(shutil.copy(bench.report, tmp_path / "lone.html"))
    with pytest.raises(UsageError, match=r"lone.json: the file is missing.*A bundle needs this document"):
        bundle(lone)
    shutil.copy(bench.report.with_suffix(".json"), tmp_path / "lone.json")
    shutil.copytree(bench.folder / "processed", tmp_path / "processed")
    monkeypatch.setattr("pipeline.shell.bundle.stored_place", lambda *_: tmp_path / "processed")
    log = sorted(bench.logs.glob("*.csv"))[5]
    delete(tmp_path / "processed", str(log))
    with pytest.raises(
        StoreError, match=r"its stored data have changed since the report was written. Ingest its log again"
    ):
        bundle(lone)
    assert not (tmp_path / "lone.zip").exists()


def test_other_files_are_no_bundle(tmp_path):
    (tmp_path / "x.zip").write_text("no zip")
    with pytest.raises(UsageError, match="cannot be read as a zip"):
        verify_bundle(tmp_path / "x.zip")
    with zipfile.ZipFile(tmp_path / "y.zip", "w") as archive:
        archive.writestr("a.txt", "a")
    with pytest.raises(UsageError, match=r"expected one report \(.html\) at the top of a bundle, found 0"):
        verify_bundle(tmp_path / "y.zip")

"""A backup, written beside a running server, is the same lab elsewhere; one that is not whole restores nothing."""

import json
import shutil
import zipfile

import pytest
from served import form, serving

from pipeline.base.errors import StoreError, UsageError
from pipeline.service.backup import LIST, backup, restore
from pipeline.service.database import Database
from pipeline.service.settings import Settings


def settings_of(folder, **options):
    return Settings(folder / "processed", folder / "reports", wait_s=200.0, **options)


def test_restored_elsewhere_all_is_as_before(kept, compared, tmp_path):
    file, told, token, logs = kept
    settings = settings_of(tmp_path / "elsewhere")
    restore(settings, file)
    assert Database(settings.data).role_of(token) == "viewer"
    with serving(settings) as client:
        assert {path: client.get(path).content for path in told if not path.startswith("jobs")} == {
            path: content for path, content in told.items() if not path.startswith("jobs")
        }
        jobs = {job["id"]: job for job in client.get("jobs?limit=1000").content["items"]}
        assert [jobs[job["id"]]["result"] for job in told["jobs?limit=1000"]["items"]] == [
            job["result"] for job in told["jobs?limit=1000"]["items"]
        ]
        for kind, empty in (("notes", {"text": ""}), ("tags", {"tags": []})):  # it was made without them
            client.ask("PUT", f"experiments/falcon/1/{kind}", document=empty)
        again = client.ask("POST", "comparisons", document=compared[0])
        assert again.status == 200
        answer = client.ask("POST", "logs", **form(logs)).content
        assert {one["state"] for one in answer["files"]} == {"skipped"}


def test_nothing_is_overwritten(kept, tmp_path):
    settings = settings_of(tmp_path)
    settings.reports.mkdir()
    (settings.reports / "mine.html").write_text("mine")
    with pytest.raises(UsageError, match=r"reports: is not empty"):
        restore(settings, kept[0])
    assert [path.name for path in tmp_path.rglob("*")] == ["reports", "mine.html"]


def changed(file, target, change):
    """A copy of an archive with other entries: `change` takes and returns name and content of each."""
    with zipfile.ZipFile(file) as source, zipfile.ZipFile(target, "w") as archive:
        for entry in source.infolist():
            for name, content in change(entry.filename, source.read(entry)):
                archive.writestr(name, content)
    return target


def renamed(name):
    """Name the first table otherwise, in the list as well."""

    def change(old, content):
        if old == LIST:
            document = json.loads(content)
            document["files"] = {
                name if key.startswith("processed/trials/") else key: v for key, v in document["files"].items()
            }
            content = json.dumps(document).encode()
        return [(name if old.startswith("processed/trials/") else old, content)]

    return change


DAMAGES = {
    "is damaged": lambda name, content: [(name, content[:-1] + b"?" if name.endswith(".parquet") else content)],
    "other files than it lists": lambda name, content: [] if name.endswith(".parquet") else [(name, content)],
    "no backup of this program": lambda name, content: [] if name == LIST else [(name, content)],
    "none of this version": lambda name, content: [(name, b"{}" if name == LIST else content)],
}
OUTSIDE = ("../outside", "processed/../../outside", "/outside", "processed/..\\outside", "elsewhere/x", "processed//x")


@pytest.mark.parametrize("why", DAMAGES)
def test_a_damaged_archive_restores_nothing(kept, tmp_path, why):
    file = changed(kept[0], tmp_path / "changed.zip", DAMAGES[why])
    with pytest.raises(StoreError, match=why):
        restore(settings_of(tmp_path / "new"), file)
    assert not any(path.is_file() for path in (tmp_path / "new").rglob("*"))


@pytest.mark.parametrize("name", OUTSIDE)
def test_no_name_leads_out(kept, tmp_path, name):
    file = changed(kept[0], tmp_path / "changed.zip", renamed(name))
    with pytest.raises(StoreError, match="leads out"):
        restore(settings_of(tmp_path / "new"), file)
    assert not (tmp_path / "outside").exists()


@pytest.mark.parametrize("part", [0.3, 0.999])
def test_a_part_of_an_archive_is_none(kept, tmp_path, part):
    content = kept[0].read_bytes()
    (tmp_path / "part.zip").write_bytes(content[: int(part * len(content))])
    with pytest.raises(StoreError, match="no whole backup"):
        restore(settings_of(tmp_path / "new"), tmp_path / "part.zip")


def test_an_archive_is_its_owner_s_alone(kept):
    """It holds the secrets of the database."""
    assert kept[0].stat().st_mode & 0o777 == 0o600


def test_a_backup_does_not_hold_itself(kept, tmp_path):
    settings = settings_of(tmp_path)
    with pytest.raises(UsageError, match="nothing to keep"):
        backup(settings, tmp_path / "lab.zip")
    restore(settings, kept[0])
    with pytest.raises(UsageError, match="Choose another folder"):
        backup(settings, settings.reports / "lab.zip")


def test_a_full_disk_is_told_before(kept, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1000}))
    with pytest.raises(UsageError, match="do not fit"):
        restore(settings_of(tmp_path), kept[0])
    assert list(tmp_path.iterdir()) == []

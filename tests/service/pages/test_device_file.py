"""The file of a device in the service: shown, edited with its mistakes named, uploaded, removed, used from then on."""

import shutil

import pytest
from served import Browser, form, page, serving

from pipeline.base.provenance import USER_FOLDER_VARIABLE, schema_folder
from pipeline.service import device_files
from pipeline.service.settings import Settings

SHIPPED = (schema_folder() / "devices" / "falcon.toml").read_text("utf-8")


@pytest.fixture
def lab(falcon, tmp_path, monkeypatch):
    monkeypatch.delenv(USER_FOLDER_VARIABLE, raising=False)
    shutil.copytree(falcon.processed, tmp_path / "processed")
    settings = Settings(tmp_path / "processed", tmp_path / "reports", wait_s=240.0, renew=False)
    monkeypatch.setenv(USER_FOLDER_VARIABLE, "")  # put back after what the service sets
    device_files.use_folder(settings)
    with serving(settings) as client:
        yield client


def test_a_file_is_shown_changed_and_used_by_theory(lab):
    assert lab.get("devices/falcon/file").content["file"] == SHIPPED
    before = lab.get("theory/boundary?device=falcon").content["stiffness_max"]
    lighter = SHIPPED.replace("mass = 0.58", "mass = 0.29", 1)
    assert lighter != SHIPPED
    assert lab.ask("PUT", "devices/falcon/file", document={"file": lighter}).status == 200
    assert lab.get("devices/falcon/file").content["file"] == lighter
    assert lab.get("theory/boundary?device=falcon").content["stiffness_max"] == pytest.approx(before / 2, rel=0.1)
    assert lab.ask("DELETE", "devices/falcon/file").status == 204
    assert lab.get("theory/boundary?device=falcon").content["stiffness_max"] == before
    assert lab.ask("DELETE", "devices/falcon/file").status == 404
    noted = str(lab.get("audit").content["items"])
    assert "kept a device file" in noted
    assert "removed a device file" in noted


def test_a_wrong_file_is_refused_and_nothing_is_kept(lab):
    for text, word in (
        (SHIPPED.replace("mass = 0.58", 'mass = "heavy"', 1), "heavy"),
        (SHIPPED.replace('name = "falcon"', 'name = "other"', 1), "falcon"),
        ("not TOML [", "TOML"),
    ):
        answer = lab.ask("PUT", "devices/falcon/file", document={"file": text})
        assert answer.status == 422
        assert word in str(answer.content), word
        assert "processed-service" not in str(answer.content)
    assert lab.get("devices/falcon/file").content["file"] == SHIPPED


def test_the_page_edits_uploads_and_downloads(lab):
    browser, at = Browser(lab), "/devices/falcon/file"
    assert "the shipped file" in page(lab, at)
    wrong = form([], form=browser.token(at), file=SHIPPED.replace("mass = 0.58", "mass = -1", 1))
    answer = browser.ask("POST", at, wrong["body"], wrong["headers"])
    assert answer.status == 422
    assert b"mass = -1" in answer.content, "what was typed is not lost"
    assert b"found -1" in answer.content
    changed = SHIPPED.replace("mass = 0.58", "mass = 0.6", 1)
    right = form([], form=browser.token(at), file=changed)
    assert browser.ask("POST", at, right["body"], right["headers"]).status == 303
    assert "the file of this lab is used" in page(lab, at)
    assert lab.get(f"{at}?download=true").content.decode() == changed
    forged = form([], form="0" * 64, file=changed)
    assert browser.ask("POST", at, forged["body"], forged["headers"]).status == 403


def test_a_device_without_a_file_gets_a_draft(lab):
    assert lab.get("devices/unheard/file").status == 404
    assert 'name = "x"' in device_files.draft("x", None)

"""Images of README and pages: each has a maker, and is not older than its sources."""

from __future__ import annotations

import json

import pytest
from places import ROOT, docs_script


@pytest.fixture(scope="module")
def docs():
    """docs/made_from.py, which knows the sources of each image."""
    return docs_script("made_from")


def test_every_image_has_sources_that_exist(docs) -> None:
    images = {path.relative_to(docs.IMAGES).as_posix() for path in docs.IMAGES.rglob("*.[ps][nv]g")}
    assert set(docs.MADE_FROM) == images
    patterns = {pattern for each in docs.MADE_FROM.values() for pattern in each}
    assert [pattern for pattern in patterns if not any(ROOT.glob(pattern))] == []


@pytest.mark.parametrize("script", sorted((ROOT / "docs").glob("make_*.py")), ids=lambda script: script.stem)
def test_every_maker_finds_what_it_imports(script) -> None:
    if script.stem == "make_screens":
        pytest.importorskip("playwright.sync_api")
    assert callable(docs_script(script.stem).main)


def test_no_image_is_stale(docs) -> None:
    made, now = json.loads(docs.FILE.read_text(encoding="utf-8")), docs.hashes()
    assert [image for image in now if made.get(image) != now[image]] == [], "run `make docs`"


def test_a_changed_source_makes_its_images_stale_and_no_others(docs, monkeypatch, tmp_path) -> None:
    before = docs.hashes()
    for file in {path for each in docs.MADE_FROM.values() for pattern in each for path in ROOT.glob(pattern)}:
        copy = tmp_path / file.relative_to(ROOT)
        if file.is_file():
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(file.read_bytes() + b"\n" * (file.name == "make_scatter.py"))
    monkeypatch.setattr(docs, "ROOT", tmp_path)
    assert {image for image, now in docs.hashes().items() if now != before[image]} == {"scatter.svg"}

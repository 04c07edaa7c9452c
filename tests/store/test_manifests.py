"""Manifests: of two writers the second notices, and what follows from others is kept of both."""

import json

import pytest

from pipeline.base.errors import StoreError
from pipeline.store import manifests
from pipeline.store.manifests import ConflictError, Manifest, advance, list_manifests, read_manifest
from pipeline.store.objects import Objects

NAME = "lwr/1"
TRIALS, MORE = "trials/lwr/1/000001-a.parquet", "trials/lwr/1/000002-b.parquet"
DELAY, MASS = "stages/lwr/1/delay.parquet", "stages/lwr/1/mass.parquet"


@pytest.fixture
def store(s3):
    return Objects(s3)


def test_what_is_put_is_read(store):
    assert read_manifest(store, NAME) == Manifest(NAME)
    done = advance(store, Manifest(NAME), {TRIALS: "x"})
    assert read_manifest(store, NAME) == done
    assert done.files == {TRIALS: "x"}
    advance(store, Manifest("store"), {"exclusions.parquet": "y"})
    assert list_manifests(store) == [NAME]


def test_of_two_that_store_trials_the_second_notices(store):
    base = advance(store, Manifest(NAME), {TRIALS: "x"})
    advance(store, base, {TRIALS: "x", MORE: "y"})
    with pytest.raises(ConflictError, match=r"lwr/1"):
        advance(store, base, {TRIALS: "z"})
    with pytest.raises(ConflictError):
        advance(store, Manifest(NAME), {TRIALS: "x"})
    assert read_manifest(store, NAME).files == {TRIALS: "x", MORE: "y"}


def test_stages_are_put_beside_what_others_stored(store):
    base = advance(store, Manifest(NAME), {TRIALS: "x", DELAY: "old"})
    advance(store, base, {TRIALS: "x", MORE: "y", DELAY: "old"})
    after = advance(store, base, {TRIALS: "x", DELAY: "new", MASS: "m"})
    assert after.files == {TRIALS: "x", MORE: "y", DELAY: "new", MASS: "m"}
    assert read_manifest(store, NAME) == after


def test_stages_of_others_are_no_conflict_for_trials(store):
    base = advance(store, Manifest(NAME), {TRIALS: "x"})
    advance(store, base, {TRIALS: "x", DELAY: "d"})
    after = advance(store, base, {MORE: "y"})
    assert after.files == {MORE: "y", DELAY: "d"}


def test_one_that_moves_on_all_the_time_ends_with_words(store, monkeypatch):
    base = advance(store, Manifest(NAME), {TRIALS: "x"})
    monkeypatch.setattr(manifests, "ADVANCES", 2)
    monkeypatch.setattr(Objects, "advance", lambda *_: None)
    with pytest.raises(StoreError, match=r"2 times in a row. Repeat the command"):
        advance(store, base, {TRIALS: "x", DELAY: "d"})


@pytest.mark.parametrize(("content", "words"), [(b'{"format": 2, "files": {}}', "format 2"), (b"{", "is damaged")])
def test_a_manifest_that_cannot_be_read_is_named(store, content, words):
    store.advance(f"manifests/{NAME}.json", content, None)
    with pytest.raises(StoreError, match=rf"manifests/lwr/1.json: .*{words}"):
        read_manifest(store, NAME)


@pytest.mark.parametrize("path", ["trials/../x", "/etc/x", "trials/lwr/2/x", "C:/x", "x\\y", "trials/lwr//x"])
@pytest.mark.parametrize("name", [NAME, "store"])
def test_a_manifest_names_files_of_its_own_alone(store, name, path):
    """It may have been written by anybody who can write to the store."""
    store.advance(f"manifests/{name}.json", json.dumps({"format": 1, "files": {path: "x"}}).encode(), None)
    with pytest.raises(StoreError, match=r"is damaged \(it names"):
        read_manifest(store, name)


def test_a_changed_byte_is_noticed(store):
    advance(store, Manifest(NAME), {TRIALS: "x"})
    content, etag = store.get(f"manifests/{NAME}.json")
    store.advance(f"manifests/{NAME}.json", content.replace(b'"x"', b'"y"'), etag)
    with pytest.raises(StoreError, match="is damaged"):
        read_manifest(store, NAME)

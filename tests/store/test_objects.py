"""An object store by its requests: what fails says what to do."""

import pytest
from clusters import free_port
from obstore.exceptions import PermissionDeniedError

from pipeline.base.errors import StoreError, UsageError
from pipeline.store import objects as objects_module
from pipeline.store.objects import Objects, check_installed, is_url


def test_names_below_a_url_are_listed_page_by_page(s3, tmp_path):
    store = Objects(s3 + "/")
    (tmp_path / "file").write_bytes(b"x")
    names = [f"x/{number:04d} %41 ä" for number in range(3)]
    for name in (*names, "y"):
        store.put(name, tmp_path / "file")
    assert sorted(name for name, _, _ in store.list("x/")) == names
    store.delete(names[:1])
    store.delete([])
    assert sorted(name for name, _, _ in store.list("x/")) == names[1:]
    assert store.get(names[0]) is None
    assert Objects(s3[:-1]).list("") == [], "another prefix that begins alike"


def test_a_store_that_is_gone_says_what_to_repeat(monkeypatch, server):
    monkeypatch.setattr(objects_module, "RETRIES", 1)
    for name, value in (server.env | {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{free_port()}"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(StoreError, match=r"s3://lab/x: the store does not answer.*AWS_ENDPOINT_URL.*repeat"):
        Objects("s3://lab/x").get("a")


def test_a_store_that_may_only_be_read_is_like_a_folder_that_may(s3, monkeypatch, tmp_path):
    def refuse(*_, **__):
        raise PermissionDeniedError("no")

    monkeypatch.setattr("obstore.store.S3Store.put", refuse)
    with pytest.raises(PermissionError) as told:
        Objects(s3).put("a", tmp_path)
    assert told.value.filename == s3


@pytest.mark.parametrize("url", ["s3://", "gs://bucket", "http://host/x"])
def test_other_urls_are_refused(url):
    assert is_url(url)
    with pytest.raises(UsageError, match=r"expected a folder, or s3://BUCKET/PREFIX"):
        Objects(url)


def test_folders_are_no_urls(tmp_path):
    assert not any(map(is_url, ("processed", tmp_path, "C:\\x", "a:b")))


def test_without_the_extra_it_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(objects_module, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"s3://x needs obstore.*pip install '.\[cluster\]'"):
        Objects("s3://x")
    with pytest.raises(UsageError, match="needs distributed"):
        check_installed("distributed", "a cluster")

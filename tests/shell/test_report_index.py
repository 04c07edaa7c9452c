"""The index page lists every report with what its document says, and what cannot be read with the reason."""

import base64
import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import pytest
from html_pages import Outline
from report_data import report_data

from pipeline.rendering.report.report import write
from pipeline.shell import report_index
from pipeline.shell.report_index import INDEX_FILE, INDEX_MARK, read_reports, render_index, write_index

ORIGIN = {"version": "0.1.0", "code": "0123456789abcdef"}


def falcon_report():
    data = report_data(full=False)
    return replace(data, result=data.result.model_copy(update={"provenance": ORIGIN}))


def lwr_report():
    data = falcon_report()
    named = {"device": "lwr", "title": "DLR light-weight robot, joint 5", "motion": "rotation"}
    return replace(data, result=data.result.model_copy(update=named))


def put(folder: Path, name: str, data, **changes) -> dict:
    """Write a report and its document; changes go into the document alone."""
    write(data, folder / f"{name}.html")
    document = json.loads(data.result.model_dump_json()) | changes
    (folder / f"{name}.json").write_text(json.dumps(document))
    return document


def page_of(folder: Path) -> Outline:
    return Outline((folder / INDEX_FILE).read_text(encoding="utf-8"))


def test_a_row_holds_what_the_document_says(tmp_path):
    document = put(tmp_path, "falcon", falcon_report())
    put(tmp_path, "lwr", lwr_report())
    assert write_index(tmp_path) == tmp_path / INDEX_FILE
    page = page_of(tmp_path)
    assert [link for link in page.links if "#" not in link] == ["./lwr.html", "./falcon.html"]
    row = next(row for row in page.rows if document["title"] in row[0])
    experiments = document["experiments"]
    assert document["summary"][0] in row[0]
    assert row[2] == f"{sum(e['trials'] for e in experiments):,}"
    assert row[6] == str(len(document["warnings"]))
    assert row[8].split()[0] == document["provenance"]["version"]


CENSORED = {"damping": 1.0, "stable": 700.0, "unstable": None, "censored": True}


def score(measured, theory, percent, bound=False):
    return {"stiffness": {"measured": measured, "theory": theory, "deviation_percent": percent, "lower_bound": bound}}


@pytest.mark.parametrize(
    ("scores", "boundary", "cells"),
    [
        ([score(14480.0, 13629.0, 6.24)], [], ["14480 N/m experiment 1", "13629 N/m", "+6.2"]),
        ([score(900.0, 1000.0, -10.0, True)], [], ["≥ 900 N/m experiment 1", "1000 N/m", "\N{MINUS SIGN}10.0"]),
        (
            [],
            [CENSORED],
            ["700 N/m experiment 1", "–", "–"],
        ),
        ([{"stiffness": None}], [], ["–", "–", "–"]),
    ],
)
def test_the_largest_stable_stiffness_and_what_is_missing(tmp_path, scores, boundary, cells):
    data = falcon_report()
    experiment = json.loads(data.result.model_dump_json())["experiments"][0]
    experiment |= {"experiment": "1", "scores": scores, "boundary": boundary}
    put(tmp_path, "falcon", data, experiments=[experiment], motion="translation")
    write_index(tmp_path)
    assert page_of(tmp_path).rows[-1][3:6] == cells


def test_many_experiments_are_named_by_their_ends():
    def names(*experiments):
        listed = [{"experiment": name, "trials": 1} for name in experiments]
        return report_index._row({"simulated": False, "motion": "rotation", "experiments": listed})["names"]

    assert names(*(f"delay-{d}" for d in range(2, 9))) == "delay-2 … delay-8 (7)"
    assert names("1", "2") == "1, 2"


def test_the_newest_log_is_the_end_of_the_range(tmp_path):
    times = "2026-11-21 05:00:00 UTC to 2026-11-21 06:00:00 UTC"
    put(tmp_path, "falcon", falcon_report(), provenance={"version": "9", "log files written": times})
    assert read_reports(tmp_path)[0][0].document["newest"] == "2026-11-21 06:00:00 UTC"


DAMAGES = {
    "no JSON": (lambda f: (f / "bad.json").write_text('{"device":'), "bad.json is not a document"),
    "another document": (lambda f: (f / "bad.json").write_text("[]"), "bad.json"),
    "an entry missing": (lambda f: (f / "bad.json").write_text('{"device": "a"}'), "title"),
    "no document": (lambda f: (f / "bad.json").unlink(), "bad.json is missing"),
    "an empty document": (lambda f: (f / "bad.json").write_text(""), "bad.json"),
    "a deep document": (lambda f: (f / "bad.json").write_text("[" * 100_000), "bad.json"),
    "a page that is cut": (lambda f: os.truncate(f / "bad.html", 20_000), "incomplete"),
    "an empty page": (lambda f: os.truncate(f / "bad.html", 0), "is empty"),
    "a pipe for a document": (lambda f: ((f / "bad.json").unlink(), os.mkfifo(f / "bad.json")), "is missing"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_reports_are_listed_with_the_reason(tmp_path, damage):
    put(tmp_path, "good", lwr_report())
    put(tmp_path, "bad", falcon_report())
    harm, words = DAMAGES[damage]
    harm(tmp_path)
    (good, bad), others = read_reports(tmp_path)
    assert (good.page, good.problem, others) == ("good.html", "", ())
    assert bad.page == "bad.html"
    assert words in bad.problem
    write_index(tmp_path)
    page = page_of(tmp_path)
    assert "./bad.html" in page.links
    assert bad.problem in page.text


def test_other_pages_are_named_by_their_title(tmp_path):
    (tmp_path / "accuracy.html").write_text("<html><head><title>Error against run time</title></head></html>")
    (tmp_path / "accuracy.json").write_text('{"rungs": []}')
    (tmp_path / "untitled.html").write_text("<p>")
    entries, others = read_reports(tmp_path)
    assert entries == ()
    assert [(page.page, page.title) for page in others] == [
        ("accuracy.html", "Error against run time"),
        ("untitled.html", "untitled.html"),
    ]
    write_index(tmp_path)
    assert "There is no report here yet" in page_of(tmp_path).text


def test_names_and_texts_of_logs_are_data(tmp_path):
    hostile = "<script>alert(1)</script>\"&'>"
    name = 'a b#?%41&"javascript:x<'
    put(tmp_path, name, falcon_report(), title=hostile, summary=[hostile], provenance={"version": hostile})
    put(tmp_path, "plain", lwr_report())
    (tmp_path / os.fsdecode(b"b\xff.html")).write_text("<title>bytes</title>")
    write_index(tmp_path)
    text = (tmp_path / INDEX_FILE).read_text(encoding="utf-8")
    assert text.count("<script") == 1  # our own, which the policy names
    page = Outline(text)
    assert any(hostile in row[0] for row in page.rows)
    links = [link for link in page.links if link != "#main"]
    assert all(link.startswith("./") for link in links)
    files = [unquote(link[2:].split("#")[0], errors="surrogateescape") for link in links]
    assert {os.fsencode(file) for file in files} == {
        file for file in os.listdir(os.fsencode(tmp_path)) if file.endswith(b".html") and file != INDEX_FILE.encode()
    }


def test_the_page_needs_no_network_and_runs_its_own_script_alone(tmp_path):
    put(tmp_path, "falcon", falcon_report())
    write_index(tmp_path)
    text = (tmp_path / INDEX_FILE).read_text(encoding="utf-8")
    script = text.partition("<script>")[2].partition("</script>")[0]
    own = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src &#39;none&#39;; script-src &#39;sha256-{own}&#39;;" in text
    assert "http://" not in text
    assert "https://" not in text
    assert "@media print" in text
    assert "prefers-color-scheme: dark" in text
    assert '<html lang="en">' in text


def test_equal_reports_give_equal_bytes_and_no_writing(tmp_path):
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        put(folder, "lwr", lwr_report())
        put(folder, "falcon", falcon_report())
        assert write_index(folder) is not None
    os.utime(tmp_path / "b" / "lwr.json", (1e9, 1e9))
    assert write_index(tmp_path / "b") is None
    pages = [(tmp_path / folder / INDEX_FILE) for folder in ("a", "b")]
    assert pages[0].read_bytes() == pages[1].read_bytes()
    before = pages[0].stat()
    assert write_index(tmp_path / "a") is None
    assert (pages[0].stat().st_ino, pages[0].stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_pages_of_others_are_never_replaced(tmp_path):
    assert write_index(tmp_path, only_renew=True) is None
    assert not (tmp_path / INDEX_FILE).exists()
    (tmp_path / INDEX_FILE).write_text("my home page")
    assert write_index(tmp_path) is None
    assert (tmp_path / INDEX_FILE).read_text() == "my home page"
    (tmp_path / INDEX_FILE).write_text(render_index(()))
    put(tmp_path, "lwr", lwr_report())
    assert write_index(tmp_path, only_renew=True) is not None
    assert "./lwr.html" in page_of(tmp_path).links
    assert INDEX_MARK in (tmp_path / INDEX_FILE).read_text()


def test_a_report_that_comes_meanwhile_is_not_lost(tmp_path, monkeypatch):
    put(tmp_path, "lwr", lwr_report())
    plain = report_index.read_reports
    seen = []

    def slow(folder):
        found = plain(folder)
        if not seen:
            seen.append(True)  # another process ends its report, and its index, after this one looked
            put(tmp_path, "falcon", falcon_report())
            monkeypatch.setattr(report_index, "read_reports", plain)
            write_index(folder)
        return found

    monkeypatch.setattr(report_index, "read_reports", slow)
    write_index(tmp_path)
    assert {"./lwr.html", "./falcon.html"} <= set(page_of(tmp_path).links)


WRITER = """
import os, sys
from pathlib import Path
from pipeline.shell.report_index import write_index
source, folder, name = map(Path, sys.argv[1:])
for ending in (".html", ".json"):
    os.link(source.with_suffix(ending), (folder / name).with_suffix(ending))
    write_index(folder)
"""


def test_several_processes_leave_a_complete_page(tmp_path):
    (tmp_path / "source").mkdir()
    (tmp_path / "reports").mkdir()
    put(tmp_path / "source", "lwr", lwr_report())
    arguments = [str(tmp_path / "source" / "lwr"), str(tmp_path / "reports")]
    command = [sys.executable, "-c", WRITER, *arguments]
    writers = [subprocess.Popen([*command, f"r{number}"]) for number in range(3)]
    assert [writer.wait(60) for writer in writers] == [0, 0, 0]
    page = page_of(tmp_path / "reports")
    assert [link for link in page.links if "#" not in link] == [f"./r{number}.html" for number in range(3)]
    assert "cannot be read" not in page.text

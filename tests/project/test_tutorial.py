"""The ten-minute path of docs/tutorial.md: its commands end as they say, and print what the page shows."""

import re
import shlex
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from places import ROOT, docs_script

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
SECTION = PAGE.split("## Ten minutes with your own files")[1].split("\n## ")[0]
NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")
BLOCK = re.compile(r"^```(\w+) ?(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def run(line, folder):
    """Run a command of the page; returns what it printed, where it ends as it is said to."""
    command, _, remark = line.partition(" # ")
    words = shlex.split(command)
    words = [sys.executable, *(["-m"] if words[0] == "pipeline" else []), *words[words[0] == "python" :]]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False, encoding="utf-8")
    expected = int(found[1]) if (found := re.search(r"status (\d)", remark)) else 0
    assert done.returncode == expected, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_the_ten_minute_path_prints_what_the_page_shows(tmp_path):
    printed = ""
    for language, name, content in BLOCK.findall(SECTION):
        if name == "session":
            continue
        if language == "sh":
            printed = "".join(run(line, tmp_path) for line in content.splitlines())
            last = printed
        elif name:
            Path(tmp_path, name).write_text(content, encoding="utf-8")
        else:
            shown = {" ".join(line.split()) for line in printed.splitlines()}
            for line in content.splitlines():
                words = " ".join(line.split())
                assert any(words in other for other in shown), (line, last)
    assert (tmp_path / "reports" / "bench.html").is_file()
    assert (tmp_path / "bench.toml").read_text(encoding="utf-8").startswith("# ")


@pytest.fixture(scope="module")
def made():
    """docs/make_tutorial.py, which runs the session and draws its pictures."""
    return docs_script("make_tutorial")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")
def test_the_session_and_its_pictures_are_those_of_the_page(made, tmp_path):
    made.write_logs(tmp_path)
    (shown,) = [content for _, name, content in BLOCK.findall(SECTION) if name == "session"]
    assert made.run_session(tmp_path) == shown
    for name, picture in made.pictures(tmp_path).items():
        stored = made.PICTURES[name].read_text(encoding="utf-8")
        words, numbers = zip(
            *((NUMBER.sub("0", text), NUMBER.findall(text)) for text in (picture, stored)), strict=True
        )
        assert words[0] == words[1], name
        # up to the last digits that are written
        assert list(map(float, numbers[0])) == pytest.approx(list(map(float, numbers[1])), abs=0.2, rel=1e-3), name


def test_the_pictures_of_the_session_are_small_and_on_the_page(made):
    for picture in made.PICTURES.values():
        assert f"](img/{picture.name})" in SECTION
        text = picture.read_text(encoding="utf-8")
        assert ElementTree.fromstring(text).tag.endswith("svg")
        assert len(text) < 40_000


def test_the_session_asks_and_ends_with_the_commands_that_repeat_it():
    (shown,) = [content for _, name, content in BLOCK.findall(SECTION) if name == "session"]
    assert shown.count("2 open questions. Enter accepts the proposal in brackets.") == 1
    assert "[mm]: mm\n" in shown
    assert shown.endswith("  pipeline ingest bare --profile bare.toml\n  pipeline compare --device bare\n")


def test_the_page_has_commands_files_and_outputs():
    kinds = [(language, bool(name)) for language, name, _ in BLOCK.findall(SECTION)]
    assert kinds.count(("sh", False)) >= 4
    assert kinds.count(("text", False)) >= 6
    assert kinds.count(("python", True)) == 2

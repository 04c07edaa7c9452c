"""The ten-minute path of docs/tutorial.md: its commands end as they say, and print what the page shows."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
SECTION = PAGE.split("## Ten minutes with your own files")[1].split("\n## ")[0]
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


def test_the_page_has_commands_files_and_outputs():
    kinds = [(language, bool(name)) for language, name, _ in BLOCK.findall(SECTION)]
    assert kinds.count(("sh", False)) >= 4
    assert kinds.count(("text", False)) >= 6
    assert kinds.count(("python", True)) == 2

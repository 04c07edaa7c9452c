"""The page of the explorer: one small file, plain scripts, and what `pipeline explore` writes."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

import pytest

from pipeline.device.loop import Loop
from pipeline.device_data.devices import known_devices
from pipeline.explorer import page
from pipeline.explorer.entries import device_entries, loop_entries

SCRIPTS = ("loop.mjs", "page.mjs")
LIMIT_LINES, LIMIT_BYTES, LIMIT_WIDTH = 1500, 250 * 1024, 185


def code_lines(name: str) -> list[str]:
    text = re.sub(r"^\s*/\*\*(?:(?!\*/).)*\*/\s*$", "", (page.FOLDER / name).read_text(), flags=re.M | re.S)
    return [line for line in text.splitlines() if line.strip() and not line.strip().startswith("//")]


def test_the_scripts_are_short():
    assert sum(len(code_lines(name)) for name in SCRIPTS) <= LIMIT_LINES


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_is_plain(name):
    """What a linter would refuse: old declarations, loose comparisons, code from text, markup from data."""
    text = "\n".join(code_lines(name))
    for pattern in (
        r"\bvar\s",
        r"[^=!]==[^=]",
        r"!=[^=]",
        r"\beval\b",
        r"\binnerHTML\b",
        r"console\.",
        r"debugger",
        r"\t",
        r" $",
    ):
        assert re.search(pattern, text, re.M) is None, pattern
    assert max(map(len, text.splitlines())) <= LIMIT_WIDTH
    assert (page.FOLDER / name).read_text().startswith("// @ts-check\n")


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_function_with_arguments_has_types(name):
    text = (page.FOLDER / name).read_text()
    for found in re.finditer(r"^(?:export )?function (\w+)\(([^)]+)\)", text, re.M):
        before = text[: found.start()].rstrip()
        assert before.endswith("*/"), found[1]
        assert "@param" in before[before.rindex("/**") :], found[1]


@pytest.mark.skipif(shutil.which("node") is None, reason="no Node: apt-get install nodejs")
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_can_be_read(name):
    done = subprocess.run(["node", "--check", str(page.FOLDER / name)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_module_has_no_access_to_a_page():
    text = "\n".join(code_lines("loop.mjs"))
    assert "export function boundary(" in text
    assert re.search(r"\b(document|window|location|fetch|import)\b", text) is None


def test_the_page_is_one_small_file():
    whole = page.page(device_entries(known_devices().values()))
    assert len(whole.encode()) <= LIMIT_BYTES
    assert re.search(r"(?:src|href)=|https?:|@import|url\((?!#)", whole.replace("href: URL", "")) is None
    assert len(re.findall(r"<script>", whole)) == 1


def test_a_name_cannot_end_the_script():
    whole = page.panel([{"label": "</script><b>", "loop": {}}])
    assert "</script><b>" not in whole
    assert json.loads(re.search(r">(\[.*\])<", whole)[1])[0]["label"] == "</script><b>"


def test_entries_of_a_loop_give_it_again():
    loop = Loop(
        0.5, 3.0, 0.001, 2.5, velocity={"kind": "butterworth", "order": 2, "cutoff_hz": 30.0},
        mode={"frequency_hz": 40.0, "damping_ratio": 0.02, "mass": 0.1}, operator={"mass": 0.1}, actuator_lag_s=0.001,
    )  # fmt: skip
    assert Loop(**loop_entries(loop)) == loop


def test_explore_writes_page_and_module(call, tmp_path):
    status, out, _ = call("explore", "--device", "falcon", "--experiment", "2", "--out", "f.html", "--json")
    assert status == 0
    assert json.loads(out) == {"files": ["f.html"]}
    entries = json.loads(re.search(r'id="explorer-entries">(.*?)</script>', (tmp_path / "f.html").read_text())[1])
    assert [entry["label"] for entry in entries] == ["Novint Falcon, 2"]
    status, _, _ = call("explore", "--module", "loop.mjs")
    assert status == 0
    assert (tmp_path / "loop.mjs").read_text() == page.module()
    assert not (tmp_path / "explore.html").exists()


def test_explore_refuses_what_is_not_known(call, tmp_path):
    status, _, error = call("explore", "--device", "flacon")
    assert status == 1
    assert "Did you mean falcon?" in error
    assert list(tmp_path.iterdir()) == []
    status, _, error = call("explore", "--device", "falcon", "--experiment", "9")
    assert status == 1
    assert "it has 1, 2" in error


def test_explore_refuses_a_drive_whose_commands_are_no_forces(call, tmp_path):
    text = 'name = "bench"\nmotion = "translation in V"\nsampling_period_s = 0.001\nmass = 0.5\ndamping = 3.0\n'
    (tmp_path / "bench.toml").write_text(text + "delay_samples = 2\n", encoding="utf-8")
    status, _, error = call("explore", "--device", "bench.toml")
    assert status == 1
    assert "its commands are in V" in error
    assert "gain" in error

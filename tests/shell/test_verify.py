"""`pipeline verify`: a fresh report holds, and every change of a number, a log or a stored sample is named."""

from __future__ import annotations

import json
import random
import re
import shutil
from dataclasses import dataclass
from html import unescape
from pathlib import Path
from types import SimpleNamespace

import pyarrow as pa
import pytest
from labs import compare, make_lab
from stored import replace_table
from typer.testing import CliRunner

from pipeline.base.errors import StoreError, UsageError
from pipeline.device_data.devices import load_device
from pipeline.intake.ingest import ingest
from pipeline.records.results import ComparisonResult
from pipeline.records.table_files import read_table
from pipeline.rendering.report import report_parts
from pipeline.rendering.report.report_parts import take_apart
from pipeline.shell import verify
from pipeline.shell.cli import app

pytestmark = pytest.mark.usefixtures("one_process")

CRITERIA = ("settle_2pct", "overshoot")
"""Criteria of which theory finds the optimum quickly."""


@dataclass(frozen=True)
class Desk:
    """A report with the folders behind it."""

    folder: Path

    @property
    def report(self) -> Path:
        return self.folder / "report.html"

    @property
    def processed(self) -> Path:
        return self.folder / "processed"

    def logs(self) -> list[Path]:
        return sorted((self.folder / "raw").rglob("*.csv"))

    def page(self) -> str:
        return self.report.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Desk:
    desk = Desk(tmp_path_factory.mktemp("verify"))
    make_lab(desk.folder, load_device("falcon"), ("1",), ideal=True, coarsen=7)
    compare("falcon", desk.processed, criteria=CRITERIA, report=desk.report)
    return desk


@pytest.fixture
def desk(original, tmp_path) -> Desk:
    """A copy of report and store; the logs stay where they are."""
    shutil.copytree(original.processed, tmp_path / "processed")
    for name in ("report.html", "report.json"):
        shutil.copy(original.folder / name, tmp_path / name)
    return Desk(tmp_path)


@pytest.fixture(scope="module")
def verified(original) -> tuple[verify.Verification, str]:
    """What is found of the report as it is, and the page as it was computed anew."""
    kept: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verify, "take_apart", lambda page: kept.append(page) or take_apart(page))
        found = verify.verify(original.report, original.processed)
    return found, kept[-1]


@pytest.fixture
def recomputed(verified) -> str:
    """The page as it is computed anew, once for the tests that change only the page."""
    return verified[1]


@pytest.fixture
def quick(original, recomputed, monkeypatch):
    """Verification that takes the recomputed page from memory: the comparison of the pages is what is tested."""

    monkeypatch.setattr(verify, "_compare_again", page_again(original, recomputed))
    fresh = SimpleNamespace(problems=(), notes=(), read=1, kept=0)
    monkeypatch.setattr(verify, "read_again", lambda *_: fresh)


def page_again(original: Desk, page: str):
    """A comparison that writes this page, and has the document of the original one."""
    document = ComparisonResult.model_validate_json(original.report.with_suffix(".json").read_bytes())

    def compare_again(report, request, store, target):
        target.write_text(page, encoding="utf-8")
        return document

    return compare_again


def another_digit(text: str, number: int) -> str:
    """The text with one of its digits raised by one."""
    places = [m.start() for m in re.finditer(r"\d", text)]
    place = places[number % len(places)]
    return text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :]


def change_cell(page: str, name: str, number: int) -> str:
    """The page with one digit of the text of a cell changed; the markup around it is left as it is."""
    rows = {row[1]: row for row in re.finditer(r'<tr data-row="([^"]*)">', page)}
    row = rows[max((row for row in rows if name.startswith(f"{row}/")), key=len)]
    cell = re.escape(name[len(row[1]) + 1 :])
    head = re.compile(rf'<t[dh][^>]*data-cell="{cell}"[^>]*>').search(page, row.end(), page.index("</tr", row.end()))
    assert head is not None, name
    end = page.index("</t", head.end())
    inner = page[head.end() : end]
    texts = [m for m in re.finditer(r"(?:^|>)([^<]*\d[^<]*)", inner) if re.search(r"\d", unescape(m[1]))]
    chosen = texts[number % len(texts)]
    start = head.end() + chosen.start(1)
    stop = head.end() + chosen.end(1)
    return page[:start] + another_digit(page[start:stop], number) + page[stop:]


def change_text(page: str, name: str, text: str) -> str:
    """The page with the whole text of a cell changed."""
    row, _, cell = name.rpartition("/")
    start = page.index(f'<tr data-row="{row}"')
    place = re.compile(rf'data-cell="{re.escape(cell)}"[^>]*>([^<]*)').search(page, start)
    assert place is not None
    return page[: place.start(1)] + text + page[place.end(1) :]


def change_stored_sample(desk: Desk) -> None:
    """Add a nanometre to one stored sample, in a file that is valid in itself."""
    file = next((desk.processed / "trials").rglob("*.parquet"))
    table = read_table(file)
    position = table.column("position").to_pylist()
    position[12][345] += 1e-9
    index = table.schema.get_field_index("position")
    field = table.schema.field(index)
    replace_table(file, table.set_column(index, field, pa.array(position, field.type)))


def test_a_fresh_report_holds(original, verified):
    found, _ = verified
    assert found.equal, found
    assert found.differences == ()
    assert found.logs == ()
    assert found.checked["cells"] == len(take_apart(original.page()).cells) > 100
    assert found.checked["values"] > 300
    assert any("all equal" in line for line in verify.lines_of(found))


def test_one_digit_changed_in_each_of_twenty_random_cells_is_named(desk, quick):
    page = desk.page()
    cells = {n: t for n, t in take_apart(page).cells.items() if re.search(r"\d", t) and '"' not in n and "&" not in n}
    free = sorted(filter(report_parts.is_free_cell, cells))
    chosen = [*random.Random(3).sample(sorted(cells.keys() - free), 16), *random.Random(3).sample(free, 4)]
    for number, name in enumerate(chosen):
        changed = change_cell(page, name, number)
        desk.report.write_text(changed, encoding="utf-8")
        found = verify.verify(desk.report, desk.processed)
        assert not found.equal
        assert [d.name for d in found.differences if d.kind == "cell"] == [name]
        assert found.differences[0].found == take_apart(changed).cells[name]


def test_rounding_is_allowed_only_in_a_page_that_is_as_it_was_written(original, desk, recomputed, quick, monkeypatch):
    """Another processor computes another last digit; so does a hand."""
    page = desk.page()
    cells = take_apart(page).cells
    name = next(n for n, t in cells.items() if re.fullmatch(r"\d+\.\d+", t) and not report_parts.is_free_cell(n))
    digits = cells[name].replace(".", "")
    last = f"{cells[name][:-1]}{'8' if digits[-1] == '9' else int(digits[-1]) + 1}"
    far = f"{cells[name][:-1]}{(int(digits[-1]) + 5) % 10}"

    def elsewhere(text):
        """The page as computed anew has another number in that cell."""
        monkeypatch.setattr(verify, "_compare_again", page_again(original, change_text(recomputed, name, text)))
        return verify.verify(desk.report, desk.processed)

    assert elsewhere(last).equal
    assert [d.name for d in elsewhere(far).differences] == [name]
    desk.report.write_text(page.replace('<html lang="en">', '<html lang="en" class="x">'), encoding="utf-8")
    assert [d.name for d in elsewhere(last).differences] == [name]


def test_changes_outside_the_cells_are_told(desk, quick):
    page = desk.page()
    drawing = re.search(r"<svg\b.*?</svg>", page, re.DOTALL)[0]
    for changed in (
        page.replace(drawing, another_digit(drawing, -1)),
        page.replace('lang="en"', 'lang="en" class="x"'),
    ):
        assert changed != page
        desk.report.write_text(changed, encoding="utf-8")
        found = verify.verify(desk.report, desk.processed)
        assert [d.name for d in found.differences] == ["page"]
        assert not found.equal


@pytest.mark.slow
def test_a_number_of_the_first_screen_is_held_against_the_logs_whatever_the_page_says_of_itself(desk, quick):
    page = desk.page()
    line = re.search(r"stability limit at least [\d.]+", page)[0]
    own, forged = report_parts.page_digest(page), page.replace(line, another_digit(line, 0))
    desk.report.write_text(forged.replace(own, report_parts.page_digest(forged)), encoding="utf-8")
    (difference,) = verify.verify(desk.report, desk.processed).differences
    assert difference.kind == "sentence"
    assert line in difference.expected


def test_a_broken_document_beside_the_page_is_named(desk, quick):
    path = desk.report.with_suffix(".json")
    path.write_text(path.read_text(encoding="utf-8")[:-2], encoding="utf-8")
    (difference,) = verify.verify(desk.report, desk.processed).differences
    assert (difference.name, difference.kind) == ("document", "value")
    assert str(path) in difference.found


@pytest.mark.slow
def test_a_changed_value_of_the_json_document_is_named(desk):
    path = desk.report.with_suffix(".json")
    document = json.loads(path.read_text(encoding="utf-8"))
    document["experiments"][0]["boundary"][3]["stable"] += 1
    path.write_text(json.dumps(document), encoding="utf-8")
    found = verify.verify(desk.report, desk.processed)
    assert [d.name for d in found.differences] == ["json/experiments/0/boundary/3/stable"]


@pytest.mark.slow
def test_one_changed_sample_of_a_log_names_the_log_and_the_numbers_that_change_with_it(original, desk):
    log = original.logs()[40]
    before = log.read_bytes()
    try:
        rows = before.decode().splitlines()
        time, command, position = rows[-60].split(",")
        rows[-60] = f"{time},{command},{float(position) + 0.02!r}"
        log.write_text("\n".join(rows) + "\n")
        found = verify.verify(desk.report, desk.processed)
    finally:
        log.write_bytes(before)
    assert not found.equal
    assert [p.path for p in found.logs] == [str(log)]
    assert "has changed" in found.logs[0].problem
    assert len(found.logs[0].expected or "") == len(found.logs[0].found or "") == 64
    assert found.differences, "a step of 20 mm at the end of a response changes a count or an estimate"


@pytest.mark.slow
def test_without_logs_a_changed_stored_sample_is_told_of_its_experiment(original, desk):
    trials = next((desk.processed / "trials").rglob("*.parquet"))
    table = read_table(trials)
    paths = pa.array([f"/gone{path}" for path in table.column("source_path").to_pylist()])
    index = table.schema.get_field_index("source_path")
    replace_table(trials, table.set_column(index, table.schema.field(index), paths))
    assert verify.verify(desk.report, desk.processed).equal
    change_stored_sample(desk)
    found = verify.verify(desk.report, desk.processed)
    assert [p.path for p in found.logs] == ["experiment 1"]
    assert found.notes == ("72 trials: stored samples were used, because the logs no longer exist",)


@pytest.mark.slow
def test_logs_that_came_later_are_left_out(original, desk, tmp_path):
    extra = tmp_path / "later" / "one.csv"
    extra.parent.mkdir()
    text = original.logs()[40].read_text()
    extra.write_text(text.replace("# stiffness: ", "# stiffness: 1", 1))
    report = ingest([extra], desk.processed)
    assert report.ingested == 1, report
    found = verify.verify(desk.report, desk.processed)
    assert found.equal
    assert found.notes == ("experiment 1: 1 trials were stored after the report and are not used",)


@pytest.mark.slow
def test_nothing_stored_is_trusted_and_nothing_is_changed(original, desk):
    """Stages and optima in the store are replaced by nonsense: the numbers still hold, and the nonsense stays."""
    for stage in (desk.processed / "stages").rglob("settling-*.parquet"):
        table = read_table(stage)
        index = table.schema.get_field_index("settle_2pct")
        wrong = pa.array([7] * table.num_rows, table.schema.field(index).type)
        replace_table(stage, table.set_column(index, table.schema.field(index), wrong))
    before = {p: p.stat().st_mtime_ns for p in desk.processed.rglob("*")}
    assert verify.verify(desk.report, desk.processed).equal
    assert {p: p.stat().st_mtime_ns for p in desk.processed.rglob("*")} == before


def test_other_files_and_folders_are_refused_with_what_to_do(desk, tmp_path):
    other = tmp_path / "other.html"
    other.write_text("<html></html>")
    with pytest.raises(UsageError, match="expected a report by `pipeline compare`"):
        verify.verify(other)
    with pytest.raises(UsageError, match="--processed"):
        verify.verify(desk.report, tmp_path / "nowhere")
    with pytest.raises(UsageError, match="cannot be read"):
        verify.verify(tmp_path / "none.html")


def test_a_store_of_another_device_is_refused_with_what_to_do(original, desk, tmp_path):
    log = tmp_path / "raw" / "one.csv"
    log.parent.mkdir()
    log.write_text(original.logs()[40].read_text().replace("# device: falcon", "# device: other", 1))
    ingest([log], tmp_path / "others")
    with pytest.raises(StoreError, match=r"none of its logs are in .*--processed"):
        verify.verify(desk.report, tmp_path / "others")


def test_command_exits_with_status_1_and_names_the_cell(desk, quick):
    runner = CliRunner()
    arguments = ["verify", str(desk.report), "--processed", str(desk.processed)]
    assert runner.invoke(app, arguments).exit_code == 0
    name = "D.1/settle_2pct/experiment_1/cost"
    desk.report.write_text(change_cell(desk.page(), name, 0), encoding="utf-8")
    result = runner.invoke(app, arguments)
    assert result.exit_code == 1
    assert f"{name}: recomputed" in result.stdout
    result = runner.invoke(app, [*arguments, "--json"])
    document = json.loads(result.stdout)
    assert [d["name"] for d in document["differences"]] == [name]
    assert document["equal"] is False

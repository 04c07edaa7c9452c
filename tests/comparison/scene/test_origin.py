"""What logs say of themselves is kept, counted, and shown as text."""

from __future__ import annotations

import pytest
from labs import compare
from native_logs import log_text

from pipeline.comparison.scene.origin import MOST_VALUES
from pipeline.intake.ingest import ingest
from pipeline.rendering.report.report_parts import take_apart

HOSTILE = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("headers")
    (folder / "logs").mkdir()
    for n in range(9):
        extra = {"firmware": "1.2" if n < 6 else "1.3", "recorded": f"2026-03-01T10:0{n}", "grease": HOSTILE}
        text = log_text(stiffness=300.0 + n, seed=n, extra=extra if n else {"firmware": "1.2"})
        (folder / f"logs/{n}.csv").write_text(text)
    assert ingest([folder / "logs"], folder / "p").ingested == 9
    return compare("bench", folder / "p", criteria=["overshoot"], report=folder / "r.html")


def test_header_lines_are_counted_with_their_values(outcome):
    lines = {line.key: line for line in outcome.result.experiments[0].header}
    assert sorted(lines) == ["firmware", "grease", "recorded"]
    assert lines["firmware"].values == {"1.2": 6, "1.3": 3}
    assert (lines["firmware"].trials, lines["firmware"].different) == (9, 2)
    assert (lines["recorded"].trials, lines["recorded"].different) == (8, 8)
    assert len(lines["recorded"].values) == MOST_VALUES
    assert next(iter(lines["recorded"].values)) == "2026-03-01T10:01"


def test_a_report_shows_them_as_text(outcome):
    page = outcome.report.read_text(encoding="utf-8")
    assert HOSTILE not in page
    cells = take_apart(page).cells
    assert cells["header/1/firmware/values"] == "1.2 (6); 1.3 (3)"
    assert cells["header/1/grease/values"] == f"{HOSTILE} (8)"
    assert cells["header/1/recorded/values"].endswith("; 4 more")

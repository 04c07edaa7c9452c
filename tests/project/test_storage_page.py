"""docs/storage.md: its examples run on a store and read what is in it."""

import re
from pathlib import Path

import pytest
from native_logs import log_text
from places import ROOT

from pipeline.intake.ingest import ingest
from pipeline.store.samples import load_batch
from pipeline.store.storage import read_trials

PAGE = (ROOT / "docs" / "storage.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda text: text.split()[1].split(".")[0])
def test_examples_read_what_is_stored(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(4):
        Path(f"{number}.csv").write_text(log_text(100.0 * number, experiment="1" if number < 3 else "2"))
        # four batches, so that a folder has several files
        ingest([Path(f"{number}.csv")], Path("processed"), jobs=1)
    names: dict = {}
    exec(compile(block, "docs/storage.md", "exec"), names)
    trials = read_trials(Path("processed"), "bench", "1")
    batch = load_batch(Path("processed"), trials)
    peaks = dict(zip(batch.trial_id, batch.position.max(axis=1).tolist(), strict=True))
    table = names.get("table")
    if "unit" in names:
        assert names["unit"] == "m"
        assert dict(zip(names["trials"].column("trial_id").to_pylist(), names["peak"], strict=True)) == peaks
    elif "pl" in names:
        assert dict(table.select("trial_id", "peak").iter_rows()) == peaks
    else:
        assert dict(zip(table["trial_id"], table["peak"], strict=True)) == peaks
        assert sorted(table["stiffness"]) == [0.0, 100.0, 200.0]
        assert "pd" not in names or len(names["samples"]) == batch.rows.sum()


def test_each_way_is_shown():
    for word in ("pandas", "polars", "duckdb", "pyarrow"):
        assert any(word in block for block in BLOCKS)

"""One bad cell in one of 26 logs: that log is refused by name, and the others tell what they tell alone."""

import json
import shutil

import pytest
from typer.testing import CliRunner

from pipeline.device_data.devices import load_device
from pipeline.shell.cli import app
from pipeline.simulation.sweep import run_sweep, write_sweep

CELLS = {
    "a stray bit": (2, 200, 3.4e38),
    "within the range of readings": (2, 120, 700.0),
    "a clock of years": (0, -1, 1e12),
}
"""Column (time, command, position), row and what stands there."""


def compared(raw, processed):
    runner = CliRunner()
    ingested = runner.invoke(app, ["ingest", str(raw), "--processed", str(processed), "--jobs", "1", "--json"])
    refused = [one["path"] for one in json.loads(ingested.stdout)["quarantined"]]
    found = runner.invoke(app, ["compare", "--device", "falcon", "--processed", str(processed), "--json"])
    assert found.exit_code == 0, found.output
    return refused, json.loads(found.stdout)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unusable")
    write_sweep(run_sweep(load_device("falcon"), "1", coarsen=14, duration_s=0.3, seed=61), folder / "all")
    (folder / "raw").mkdir()
    kept = sorted((folder / "all").rglob("*.csv"))[:26]
    for log in kept:
        shutil.copy(log, folder / "raw" / log.name)
    bad = folder / "raw" / kept[13].name
    text = bad.read_text(encoding="utf-8")
    bad.unlink()
    _, without = compared(folder / "raw", folder / "without")
    return folder, bad.name, text, without


@pytest.mark.slow
@pytest.mark.sampled
@pytest.mark.parametrize("what", CELLS)
def test_a_bad_cell_takes_its_own_log_alone(what, logs, tmp_path):
    folder, name, text, without = logs
    column, row, value = CELLS[what]
    shutil.copytree(folder / "raw", tmp_path / "raw")
    lines = text.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("time_s")) + 1
    at = row if row < 0 else first + row
    cells = lines[at].split(",")
    cells[column] = repr(value)
    lines[at] = ",".join(cells)
    (tmp_path / "raw" / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    refused, found = compared(tmp_path / "raw", tmp_path / "processed")
    assert refused == [str(tmp_path / "raw" / name)]
    for key in ("estimates", "boundary", "optimum", "causes", "loop"):
        assert found["experiments"][0][key] == without["experiments"][0][key], key

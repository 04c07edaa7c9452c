"""What is given is stored, refused with its reason, or said to be gone: from the command line and by REST."""

import json
import os
import random
import shutil
import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from native_logs import FAULTS, log_text, with_cell
from served import serving

from pipeline.intake.quarantine import list_quarantine
from pipeline.service.settings import Settings
from pipeline.store.storage import read_trials

NAMED = """
name = "named"
format = "delimited"
files = ["*.csv"]
delimiter = ","
decimal = "."
name_pattern = "K(?P<stiffness>[0-9.]+)_B(?P<damping>[0-9.]+)"
step_at = "command edge"
columns.time = { name = "t", unit = "s" }
columns.command = { name = "f", unit = "N", sign = 1 }
columns.position = { name = "x", unit = "m", sign = 1 }
constants = { device = "DEVICE", experiment = "1", motion = "translation", step = 8, sampling_period_s = 0.001 }
"""


def run(*words, cwd=None, **more):
    """Run a command as a user would; returns status, what it printed, and what it said beside."""
    command = [sys.executable, "-m", "pipeline", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=300, **more)
    return done.returncode, done.stdout, done.stderr


def ingest(*words, processed):
    """Status and document of ``ingest --json``."""
    status, out, said = run("ingest", *words, "--processed", processed, "--json")
    assert out, said
    return status, json.loads(out)


def counts(document):
    return document["found"], document["ingested"], document["skipped"], len(document["quarantined"])


@pytest.fixture
def still():
    """A log without names of its conditions: a device that does not move, so that any K and B give these samples."""
    return "t,f,x\n" + "".join(f"{0.001 * k},{8.0 * (k > 2)},0\n" for k in range(30))


@pytest.fixture
def server(tmp_path):
    with serving(Settings(tmp_path / "processed", tmp_path / "reports")) as client:
        yield client


@pytest.fixture
def take(processed):
    """Call it with words of ``ingest``; returns status and document."""
    return lambda *words: ingest(*words, processed=processed)


@pytest.fixture(params=["ingest", pytest.param("push", marks=pytest.mark.slow)])
def give(request, logs, processed):
    """Call it: the logs are ingested, or pushed to a server; returns status and document."""
    if request.param == "ingest":
        return lambda: ingest(logs, processed=processed)

    def push():
        port = request.getfixturevalue("server").port
        status, out, said = run("push", logs, "--to", f"http://127.0.0.1:{port}", "--json")
        assert out, said
        return status, json.loads(out)

    return push


def stored(processed, column):
    return sorted(read_trials(processed).column(column).to_pylist())


# what was refused is not known


def test_what_was_refused_is_refused_again_and_taken_under_a_name_that_a_profile_claims(give, logs):
    (logs / "good.csv").write_text(log_text(700))
    (logs / "bad.csv").write_text("a,b\n1,2\n")
    (logs / "run1.txt").write_text(log_text(800))
    first, second = give(), give()
    assert (first[0], counts(first[1])) == (3, (3, 1, 0, 2))
    assert (second[0], counts(second[1])) == (3, (3, 0, 1, 2))
    assert first[1]["quarantined"] == second[1]["quarantined"]
    (logs / "run1.txt").rename(logs / "run1.csv")
    assert counts(give()[1]) == (3, 1, 1, 1)


def test_an_upload_that_no_profile_claimed_is_taken_under_a_name_that_one_does(server):
    text = log_text(700).encode()
    _, first = server.upload([("run1.txt", text)])
    assert [refusal["code"] for refusal in first["result"]["quarantined"]] == ["no-profile"]
    answer, second = server.upload([("run1.csv", text)])
    assert [file["state"] for file in answer["files"]] == ["queued"]
    assert counts(second["result"]) == (1, 1, 0, 0)
    _, third = server.upload([("run1.csv", text)])
    assert counts(third["result"]) == (1, 0, 1, 0)


def test_an_upload_is_refused_again_with_its_reason_and_is_once_in_quarantine(server):
    bad = FAULTS["text cell"][0].encode()
    documents = [server.upload([("bad.csv", bad)])[1]["result"] for _ in range(3)]
    assert [counts(document) for document in documents] == [(1, 0, 0, 1)] * 3
    assert len({document["quarantined"][0]["reason"] for document in documents}) == 1
    assert {document["quarantined"][0]["path"] for document in documents} == {"bad.csv"}
    assert len(list_quarantine(server.settings.processed)) == 1


def pair(name, times, position):
    """Both files of a pendulum's log."""
    table = pd.DataFrame({"time": times, "torque": 0.9, "position": position, "velocity": 0.1})
    files = {"measured": table, "desired": table[["time", "torque"]]}
    return [(f"{name}__data_{which}.csv", of.to_csv(index=False).encode()) for which, of in files.items()]


@pytest.mark.slow
def test_the_other_file_of_a_pair_is_not_left_out_for_being_like_that_of_another(server):
    times, rng = np.arange(2.0, 3.0, 0.005), np.random.default_rng(6)
    for name in ("one", "two"):
        _, job = server.upload(pair(name, times, np.cumsum(rng.random(len(times))) * 1e-3))
        assert job["result"]["quarantined"] == []
        assert job["result"]["ingested"] == 1


def test_the_other_file_of_a_pair_is_gone(take, logs):
    times = np.arange(0.0, 1.0, 0.005)
    for name, data in pair("one", times, times**2):
        (logs / name).write_bytes(data)
    assert take(logs)[1]["ingested"] == 1
    (logs / "one__data_desired.csv").unlink()
    status, document = take(logs)
    assert (status, len(document["quarantined"]), document["changed"]) == (3, 1, [])


# two profiles that claim one log


@pytest.fixture
def rigs(tmp_path, logs, take, still):
    """Call it with the name of a profile and more words: its ingest of a log that the old one has taken."""
    (logs / "K300_B2.csv").write_text(still)
    for name in ("old", "new"):
        (tmp_path / f"{name}.toml").write_text(NAMED.replace('"named"', f'"{name}"').replace("DEVICE", f"{name}_rig"))

    def take_by(name, *words):
        return take(logs, "--profile", tmp_path / f"{name}.toml", *words)

    assert take_by("old")[0] == 0
    return take_by


@pytest.mark.slow
def test_a_log_of_another_device_is_refused_and_keeps_its_trials(rigs, processed):
    for _ in range(2):
        status, document = rigs("new")
        assert (status, counts(document)) == (3, (1, 0, 0, 1))
        (refusal,) = document["quarantined"]
        assert {"old_rig", "new_rig"} <= set(refusal["reason"].replace("'", " ").split())
        assert "--replace" in refusal["reason"]
        assert document["changed"] == [], "no byte changed"
        assert stored(processed, "device") == ["old_rig"]
    # the one that has it is not told that it lost it
    status, document = rigs("old")
    assert (status, counts(document)) == (0, (1, 0, 1, 0))


def test_it_is_replaced_where_that_is_asked_for_and_said(rigs, processed):
    status, document = rigs("new", "--replace")
    assert (status, counts(document)) == (0, (1, 1, 0, 0))
    (change,) = document["changed"]
    assert "1 trial" in change["outcome"]
    assert "old_rig" in change["outcome"]
    assert stored(processed, "device") == ["new_rig"]


# names that tell


def test_equal_samples_under_names_that_tell_other_gains_are_other_trials(tmp_path, logs, take, still, processed):
    (tmp_path / "lab.toml").write_text(NAMED.replace("DEVICE", "rig"))

    def taken():
        status, document = take(logs, "--profile", tmp_path / "lab.toml")
        return status, counts(document), stored(processed, "stiffness")

    for k in (100, 200, 300):
        (logs / f"K{k}_B2.csv").write_text(still)
    assert taken() == (0, (3, 3, 0, 0), [100, 200, 300])
    (logs / "K400_B2.csv").write_text(still)
    assert taken() == (0, (4, 1, 3, 0), [100, 200, 300, 400])
    # a copy whose name tells the same is a copy; one that is corrected moves its trial alone
    shutil.copy(logs / "K200_B2.csv", logs / "K200_B2_again.csv")
    assert taken() == (0, (5, 0, 5, 0), [100, 200, 300, 400])
    (logs / "K200_B2_again.csv").unlink()
    (logs / "K200_B2.csv").rename(logs / "K250_B2.csv")
    assert taken()[2] == [100, 250, 300, 400]


def test_nothing_is_said_of_a_log_that_may_not_be_read_for_once(take, logs):
    if os.geteuid() == 0:
        pytest.skip("root may read everything")
    (logs / "a.csv").write_text(log_text(700))
    take(logs)
    os.utime(logs / "a.csv", (1e9, 1e9))
    (logs / "a.csv").chmod(0)
    assert take(logs)[1]["changed"] == []


# readings that are none


@pytest.mark.parametrize("value", ["3.4e38", "1e20", "9.97e36", "-1e308", "2e6"])
@pytest.mark.parametrize("column", [1, 2])
@pytest.mark.sampled
def test_one_such_cell_refuses_its_log_alone(take, logs, value, column):
    if column == 1 and value == "2e6":
        pytest.skip("2000 kN is much, and can be")
    for k in range(5):
        (logs / f"{k}.csv").write_text(log_text(700 + k))
    row = random.Random(value + str(column)).randrange(12, 36)
    cells = log_text(800).split("\n")[row - 1].split(",")
    cells[column] = value
    (logs / "bad.csv").write_text(with_cell(log_text(800), row, ",".join(cells)))
    status, document = take(logs)
    assert (status, counts(document)) == (3, (6, 5, 0, 1))
    (refusal,) = document["quarantined"]
    assert (refusal["code"], refusal["row"]) == ("out-of-range", row)
    assert ("command", "position")[column - 1] in refusal["reason"]


@pytest.mark.parametrize("kind", ["parquet", "feather"])
def test_two_columns_of_one_name_are_refused(take, tmp_path, kind):
    rng = np.random.default_rng(8)
    values = [np.arange(30) * 0.001, 8.0 * (np.arange(30) > 2), rng.random(30), rng.random(30)]
    table = pa.Table.from_arrays([pa.array(v) for v in values], names=["t", "f", "x", "x"])
    file = tmp_path / f"K300_B2.{kind}"
    if kind == "parquet":
        pq.write_table(table, file)
    else:
        # Feather's own writer refuses such names, Arrow's does not
        with pa.ipc.new_file(file, table.schema) as stream:
            stream.write_table(table)
    text = NAMED.replace("DEVICE", "rig").replace('"delimited"', f'"{kind}"').replace("*.csv", "*.*")
    text = text.replace('delimiter = ","\n', "").replace('decimal = "."\n', "")
    (tmp_path / "lab.toml").write_text(text)
    status, document = take(file, "--profile", tmp_path / "lab.toml")
    assert (status, counts(document)) == (3, (1, 0, 0, 1))
    assert "'x'" in document["quarantined"][0]["reason"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_flipped_bit_in_what_can_be_computed_anew_is_computed_anew(take, logs, processed, seed):
    for k in range(3):
        (logs / f"{k}.csv").write_text(log_text(700 + k))
    take(logs)
    words = ("compare", "--device", "bench", "--processed", processed, "--json")
    status, whole, _ = run(*words)
    assert status == 0
    rng = random.Random(seed)
    for file in sorted((processed / "stages").rglob("*.parquet")):
        data = bytearray(file.read_bytes())
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        file.write_bytes(data)
    status, again, said = run(*words)
    assert (status, again) == (0, whole), said
    assert run("check", "--processed", processed)[0] == 0

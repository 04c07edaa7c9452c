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

from pipeline.intake.kept import list_quarantine
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
def push(server, tmp_path):
    def push_folder(folder):
        status, out, said = run("push", folder, "--to", f"http://127.0.0.1:{server.port}", "--json")
        assert out, said
        return status, json.loads(out)

    return push_folder


class TestRefusedIsNotKnown:
    def test_an_upload_that_no_profile_claimed_is_taken_under_a_name_that_one_does(self, server):
        text = log_text(700).encode()
        _, first = server.upload([("run1.txt", text)])
        assert [refusal["code"] for refusal in first["result"]["quarantined"]] == ["no-profile"]
        answer, second = server.upload([("run1.csv", text)])
        assert [file["state"] for file in answer["files"]] == ["queued"]
        assert counts(second["result"]) == (1, 1, 0, 0)
        _, third = server.upload([("run1.csv", text)])
        assert counts(third["result"]) == (1, 0, 1, 0)

    def test_what_was_refused_is_refused_again_with_its_reason_and_once_in_quarantine(self, server):
        bad = FAULTS["text cell"][0].encode()
        documents = [server.upload([("bad.csv", bad)])[1]["result"] for _ in range(3)]
        assert [counts(document) for document in documents] == [(1, 0, 0, 1)] * 3
        assert len({document["quarantined"][0]["reason"] for document in documents}) == 1
        assert {document["quarantined"][0]["path"] for document in documents} == {"bad.csv"}
        assert len(list_quarantine(server.settings.processed)) == 1

    @pytest.mark.slow
    def test_push_ends_alike_each_time(self, push, tmp_path):
        folder = tmp_path / "logs"
        folder.mkdir()
        (folder / "good.csv").write_text(log_text(700))
        (folder / "bad.csv").write_text("a,b\n1,2\n")
        first, second = push(folder), push(folder)
        assert (first[0], counts(first[1])) == (3, (2, 1, 0, 1))
        assert (second[0], counts(second[1])) == (3, (2, 0, 1, 1))
        assert first[1]["quarantined"] == second[1]["quarantined"]

    @pytest.mark.slow
    def test_push_of_a_renamed_log_takes_it(self, push, tmp_path):
        folder = tmp_path / "logs"
        folder.mkdir()
        (folder / "run1.txt").write_text(log_text(700))
        status, document = push(folder)
        assert (status, counts(document)) == (3, (1, 0, 0, 1))
        (folder / "run1.txt").rename(folder / "run1.csv")
        status, document = push(folder)
        assert (status, counts(document)) == (0, (1, 1, 0, 0))

    @pytest.mark.slow
    def test_the_other_file_of_a_pair_is_not_left_out_for_being_like_that_of_another(self, server):
        times = np.arange(2.0, 3.0, 0.005)
        desired = pd.DataFrame({"time": times, "torque": 0.9})
        rng = np.random.default_rng(6)
        for name in ("one", "two"):
            measured = pd.DataFrame({"time": times, "position": np.cumsum(rng.random(len(times))) * 1e-3})
            measured["torque"], measured["velocity"] = 0.9, 0.1
            pair = [
                (f"{name}__data_measured.csv", measured.to_csv(index=False).encode()),
                (f"{name}__data_desired.csv", desired.to_csv(index=False).encode()),
            ]
            _, job = server.upload(pair)
            assert job["result"]["quarantined"] == []
            assert job["result"]["ingested"] == 1

    def test_ingest_refuses_again_and_takes_what_was_renamed(self, tmp_path):
        logs, processed = tmp_path / "logs", tmp_path / "processed"
        logs.mkdir()
        (logs / "run1.txt").write_text(log_text(700))
        first, second = ingest(logs, processed=processed), ingest(logs, processed=processed)
        assert first == second
        assert (first[0], counts(first[1])) == (3, (1, 0, 0, 1))
        (logs / "run1.txt").rename(logs / "run1.csv")
        assert counts(ingest(logs, processed=processed)[1]) == (1, 1, 0, 0)


class TestTwoThatClaimOneLog:
    @pytest.fixture
    def rigs(self, tmp_path, still):
        logs = tmp_path / "logs"
        logs.mkdir()
        (logs / "K300_B2.csv").write_text(still)
        for name in ("old", "new"):
            (tmp_path / f"{name}.toml").write_text(
                NAMED.replace('"named"', f'"{name}"').replace("DEVICE", f"{name}_rig")
            )
        assert ingest(logs, "--profile", tmp_path / "old.toml", processed=tmp_path / "processed")[0] == 0
        return tmp_path

    def devices(self, folder):
        return read_trials(folder / "processed").column("device").to_pylist()

    @pytest.mark.slow
    def test_a_log_of_another_device_is_refused_and_keeps_its_trials(self, rigs):
        for _ in range(2):
            status, document = ingest(rigs / "logs", "--profile", rigs / "new.toml", processed=rigs / "processed")
            assert (status, counts(document)) == (3, (1, 0, 0, 1))
            (refusal,) = document["quarantined"]
            assert {"old_rig", "new_rig"} <= set(refusal["reason"].replace("'", " ").split())
            assert "--replace" in refusal["reason"]
            assert document["changed"] == [], "no byte changed"
            assert self.devices(rigs) == ["old_rig"]
        # the one that has it is not told that it lost it
        status, document = ingest(rigs / "logs", "--profile", rigs / "old.toml", processed=rigs / "processed")
        assert (status, counts(document)) == (0, (1, 0, 1, 0))

    def test_it_is_replaced_where_that_is_asked_for_and_said(self, rigs):
        status, document = ingest(
            rigs / "logs", "--profile", rigs / "new.toml", "--replace", processed=rigs / "processed"
        )
        assert (status, counts(document)) == (0, (1, 1, 0, 0))
        (change,) = document["changed"]
        assert "1 trial" in change["outcome"]
        assert "old_rig" in change["outcome"]
        assert self.devices(rigs) == ["new_rig"]


class TestNamesThatTell:
    @pytest.fixture
    def lab(self, tmp_path, still):
        (tmp_path / "lab.toml").write_text(NAMED.replace("DEVICE", "rig"))
        (tmp_path / "logs").mkdir()
        for k in (100, 200, 300):
            (tmp_path / "logs" / f"K{k}_B2.csv").write_text(still)
        return tmp_path

    def stored(self, lab):
        return sorted(read_trials(lab / "processed").column("stiffness").to_pylist())

    def run(self, lab):
        return ingest(lab / "logs", "--profile", lab / "lab.toml", processed=lab / "processed")

    def test_equal_samples_under_names_that_tell_other_gains_are_other_trials(self, lab, still):
        status, document = self.run(lab)
        assert (status, counts(document), self.stored(lab)) == (0, (3, 3, 0, 0), [100, 200, 300])
        (lab / "logs" / "K400_B2.csv").write_text(still)
        assert counts(self.run(lab)[1]) == (4, 1, 3, 0)
        assert self.stored(lab) == [100, 200, 300, 400]

    def test_a_copy_whose_name_tells_the_same_is_a_copy(self, lab):
        self.run(lab)
        shutil.copy(lab / "logs" / "K200_B2.csv", lab / "logs" / "K200_B2_again.csv")
        assert (counts(self.run(lab)[1]), self.stored(lab)) == ((4, 0, 4, 0), [100, 200, 300])

    def test_a_name_that_is_corrected_moves_its_trial_alone(self, lab):
        self.run(lab)
        (lab / "logs" / "K200_B2.csv").rename(lab / "logs" / "K250_B2.csv")
        self.run(lab)
        assert self.stored(lab) == [100, 250, 300]


class TestChanged:
    def test_nothing_is_said_of_a_log_that_may_not_be_read_for_once(self, tmp_path):
        if os.geteuid() == 0:
            pytest.skip("root may read everything")
        logs, processed = tmp_path / "logs", tmp_path / "processed"
        logs.mkdir()
        (logs / "a.csv").write_text(log_text(700))
        ingest(logs, processed=processed)
        os.utime(logs / "a.csv", (1e9, 1e9))
        (logs / "a.csv").chmod(0)
        assert ingest(logs, processed=processed)[1]["changed"] == []

    def test_the_other_file_of_a_pair_is_gone(self, tmp_path):
        logs, processed = tmp_path / "logs", tmp_path / "processed"
        logs.mkdir()
        times = np.arange(0.0, 1.0, 0.005)
        table = pd.DataFrame({"time": times, "torque": 0.9, "position": times**2, "velocity": 2 * times})
        table.to_csv(logs / "one__data_measured.csv", index=False)
        table.to_csv(logs / "one__data_desired.csv", index=False)
        assert ingest(logs, processed=processed)[1]["ingested"] == 1
        (logs / "one__data_desired.csv").unlink()
        status, document = ingest(logs, processed=processed)
        assert (status, len(document["quarantined"]), document["changed"]) == (3, 1, [])


class TestReadingsThatAreNone:
    @pytest.mark.parametrize("value", ["3.4e38", "1e20", "9.97e36", "-1e308", "2e6"])
    @pytest.mark.parametrize("column", [1, 2])
    @pytest.mark.sampled
    def test_one_such_cell_refuses_its_log_alone(self, tmp_path, value, column):
        rng = random.Random(value + str(column))
        logs = tmp_path / "logs"
        logs.mkdir()
        for k in range(5):
            (logs / f"{k}.csv").write_text(log_text(700 + k))
        if column == 1 and value == "2e6":
            pytest.skip("2000 kN is much, and can be")
        row = rng.randrange(12, 36)
        cells = log_text(800).split("\n")[row - 1].split(",")
        cells[column] = value
        (logs / "bad.csv").write_text(with_cell(log_text(800), row, ",".join(cells)))
        status, document = ingest(logs, processed=tmp_path / "processed")
        assert (status, counts(document)) == (3, (6, 5, 0, 1))
        (refusal,) = document["quarantined"]
        assert (refusal["code"], refusal["row"]) == ("out-of-range", row)
        assert ("command", "position")[column - 1] in refusal["reason"]


class TestColumnsOfOneName:
    @pytest.mark.parametrize("kind", ["parquet", "feather"])
    def test_two_of_one_name_are_refused(self, tmp_path, kind):
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
        status, document = ingest(file, "--profile", tmp_path / "lab.toml", processed=tmp_path / "processed")
        assert (status, counts(document)) == (3, (1, 0, 0, 1))
        assert "'x'" in document["quarantined"][0]["reason"]


class TestEnds:
    @pytest.fixture
    def store(self, tmp_path):
        (tmp_path / "logs").mkdir()
        for k in range(3):
            (tmp_path / "logs" / f"{k}.csv").write_text(log_text(700 + k))
        ingest(tmp_path / "logs", processed=tmp_path / "processed")
        return tmp_path / "processed"

    @pytest.mark.slow
    @pytest.mark.parametrize("seed", range(3))
    def test_a_flipped_bit_in_what_can_be_computed_anew_is_computed_anew(self, store, seed):
        words = ("compare", "--device", "bench", "--processed", store, "--json")
        status, whole, _ = run(*words)
        assert status == 0
        rng = random.Random(seed)
        for file in sorted((store / "stages").rglob("*.parquet")):
            data = bytearray(file.read_bytes())
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            file.write_bytes(data)
        status, again, said = run(*words)
        assert (status, again) == (0, whole), said
        assert run("check", "--processed", store)[0] == 0
